"""Repeated chroma is found in RGB where it is, nowhere else, and undone."""

from dataclasses import replace

import numpy as np
import pytest
import reference

from tikernels.raw.pixel_format import PixelFormat
from tikernels.raw.repeated_chroma import RepeatedChroma, find_repeated_chroma, undo_repeated_chroma

SHAPE = (96, 112)


def fringes(noise=0.006, level=0.75):
    """Return encoded RGB of slanted fringes of 12 px on a surface whose colour changes, 0..1."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    phase = 2 * np.pi * (y + 0.3 * x + 6 * np.sin(x / 17)) / 12
    waves = 0.55 + 0.4 * np.cos(phase[..., None] - 2 * np.pi / 3 * np.array([1, 0, -1]))
    color = np.stack([0.9 + 0.1 * np.sin(x / 9), 0.8 + 0.1 * np.sin(y / 7), 0.8 + 0 * x], axis=-1)
    return np.clip(level * color * waves + np.random.default_rng(5).normal(0, noise, waves.shape), 0, 1)


def repeated(rgb, pixels, matrix="bt601", **jpeg):
    """Return encoded RGB as a library makes it of the planes, and as interpolation makes it."""
    format = PixelFormat("yuv", subsampling=pixels, matrix=matrix, **jpeg)
    luma, *chroma = reference.subsample_chroma(rgb, format)
    full = [np.repeat(np.repeat(plane, pixels[1], axis=0), pixels[0], axis=1) for plane in chroma]
    as_library = reference.convert_chroma([luma, *full], replace(format, subsampling=(1, 1)))
    return as_library, reference.convert_chroma([luma, *chroma], format)


def levels(rgb, dtype):
    return rgb.astype(dtype) if dtype is np.float32 else np.rint(np.iinfo(dtype).max * rgb).astype(dtype)


def white(dtype):
    return 1.0 if dtype is np.float32 else float(np.iinfo(dtype).max)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize(
    ("pixels", "matrix", "corner"),
    [
        ((2, 2), "bt601", (0, 0)),
        ((2, 2), "bt709", (1, 0)),
        ((2, 2), "bt2020", (0, 1)),
        ((1, 2), "bt709", (0, 1)),
        ((2, 1), "bt601", (1, 0)),
    ],
)
def test_it_is_found_and_undone(cpu, pixels, matrix, corner, dtype):
    """A part of a picture may begin within a pair; what remains are two roundings of chroma, and its rim."""
    columns, rows = corner
    faulty, right = (rgb[rows:, columns:] for rgb in repeated(fringes(), pixels, matrix))
    image = levels(faulty, dtype)
    found = find_repeated_chroma(image, white(dtype))
    assert found == RepeatedChroma(pixels, corner, matrix, "left")
    undone = undo_repeated_chroma(image, white(dtype), found)
    assert undone.dtype == dtype
    inside = np.s_[8:-8, 8:-8]
    error = np.sqrt(((undone / white(dtype) - right)[inside] ** 2).mean())
    assert error < 1 / 255
    assert error < 0.1 * np.sqrt(((faulty - right)[inside] ** 2).mean())


def test_clipped_values_do_not_hide_it(cpu):
    faulty, _ = repeated(fringes(level=1.6), (2, 2))
    image = levels(faulty, np.uint8)
    assert ((image == 0) | (image == 255)).any(axis=2).mean() > 0.2
    assert find_repeated_chroma(image, 255.0) == RepeatedChroma((2, 2), (0, 0), "bt601", "left")


def test_the_levels_of_luma_show_where_the_samples_sat():
    """JPEG uses all of 256 and averages about the middle, video 220 of them and about the left pixel."""
    faulty, _ = repeated(fringes(), (2, 2), full_range=True, siting="centre")
    assert find_repeated_chroma(levels(faulty, np.uint8), 255.0).siting == "centre"


def smooth(rgb):
    """Return RGB whose chroma is a straight line between samples, as careful libraries make it."""
    luma, *chroma = reference.subsample_chroma(rgb, PixelFormat("yuv", subsampling=(1, 2), siting="centre"))
    places = (np.arange(SHAPE[0]) - 0.5) / 2
    full = [
        np.stack([np.interp(places, np.arange(len(plane)), column) for column in plane.T], axis=1) for plane in chroma
    ]
    return reference.convert_chroma([luma, *full], PixelFormat("yuv"))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize(
    "rgb",
    {
        "plain": fringes(),
        "without noise": fringes(noise=0),
        "dark": fringes(level=0.03),
        "saturated": fringes(level=2.5),
        "grey": np.repeat(fringes().mean(axis=2, keepdims=True), 3, axis=2),
        "black": np.zeros((*SHAPE, 3)),
        "one edge": np.where(np.arange(SHAPE[1])[:, None] < 51, [0.2, 0.5, 0.7], [0.6, 0.5, 0.1]) * np.ones((96, 1, 1)),
        "enlarged": np.repeat(np.repeat(fringes()[:48, :56], 2, axis=0), 2, axis=1),
        "interpolated": smooth(fringes()),
        "too small": repeated(fringes(), (2, 2))[0][:20, :20],
    }.values(),
)
def test_it_is_found_nowhere_else(rgb, dtype):
    assert find_repeated_chroma(levels(rgb, dtype), white(dtype)) is None
