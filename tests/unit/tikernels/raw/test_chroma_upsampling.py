"""Luma and subsampled chroma to RGB."""

from itertools import product

import numpy as np
import pytest
import reference

import tikernels
from tikernels.raw.chroma_upsampling import chroma_taps, convert_chroma
from tikernels.raw.pixel_format import PixelFormat
from tikernels.runtime import to_host

# A twentieth of an 8-bit grey level.
TOLERANCE = 2e-4
STORED = [
    PixelFormat("yuv", subsampling=subsampling, origin=origin, siting=siting, matrix=matrix, full_range=full_range)
    for subsampling, origin, siting, matrix, full_range in (
        ((2, 2), (0, 0), "left", "bt709", False),
        ((2, 2), (1, 0), "centre", "bt601", True),
        ((2, 2), (0, 0), "top-left", "bt2020", False),
        ((2, 2), (1, 1), "bottom-right", "bt2020", False),
        ((2, 1), (1, 0), "right", "bt601", False),
        ((2, 1), (0, 0), "centre", "bt709", True),
        ((1, 2), (0, 1), "left", "bt601", False),
        ((4, 1), (0, 0), "left", "bt601", False),
        ((4, 4), (3, 2), "centre", "bt601", False),
        ((1, 1), (0, 0), "left", "bt709", True),
    )
]


def random_planes(format, height, width):
    rng = np.random.default_rng(1)
    levels = (2**format.bits - 1) << format.shift
    return tuple(
        rng.integers(0, levels + 1, shape).astype(format.dtype) for shape in format.plane_shapes(height, width)
    )


@pytest.mark.parametrize("size", [(17, 23), (1, 9), (6, 1)])
@pytest.mark.parametrize("format", STORED, ids=str)
def test_as_the_twin(arch, format, size):
    planes = random_planes(format, *size)
    rgb = convert_chroma(planes, format)
    np.testing.assert_allclose(to_host(rgb), reference.convert_chroma(planes, format), atol=TOLERANCE)


@pytest.mark.parametrize("bits, shift", [(10, 0), (10, 6), (16, 0)])
@pytest.mark.parametrize("full_range", [False, True])
def test_deep_planes_as_the_twin(arch, bits, shift, full_range):
    format = PixelFormat("yuv", bits, shift, subsampling=(2, 2), full_range=full_range)
    planes = random_planes(format, 11, 14)
    rgb = convert_chroma(planes, format)
    np.testing.assert_allclose(to_host(rgb), reference.convert_chroma(planes, format), atol=TOLERANCE)


@pytest.mark.parametrize(
    "matrix, levels",
    [("bt601", (81, 90, 240)), ("bt709", (63, 102, 240))],  # SMPTE colour bars at full amplitude: red
)
def test_red_is_red(arch, matrix, levels):
    planes = tuple(np.full((1, 1), level, np.uint8) for level in levels)
    rgb = to_host(convert_chroma(planes, PixelFormat("yuv", matrix=matrix)))
    np.testing.assert_allclose(rgb[0, 0], [1, 0, 0], atol=1 / 219)


@pytest.mark.parametrize("period_px", [8, 12, 24])
@pytest.mark.parametrize("siting", ["left", "centre", "top-left"])
@pytest.mark.parametrize("subsampling", [(2, 2), (2, 1)])
def test_a_fringe_in_the_chroma_comes_back_whole(arch, period_px, subsampling, siting):
    """The mean over two pixels takes 3.4 % of the modulation at 12 px; afterwards a sixth of that is missing."""
    format = PixelFormat("yuv", 16, subsampling=subsampling, siting=siting, full_range=True)
    y, x = np.mgrid[:48, :48]
    for phase, along in ((2 * np.pi / period_px * y, 0), (2 * np.pi / period_px * x, 1)):
        # Equal luma everywhere, so that blue has the fringe alone.
        chroma = 0.2 * np.cos(phase)
        rgb = np.stack([0.5 + 0 * chroma, 0.5 - 0.0722 / 0.7152 * 1.8556 * chroma, 0.5 + 1.8556 * chroma], axis=-1)
        planes = reference.subsample_chroma(rgb, format)
        back = to_host(convert_chroma(tuple(planes), format))
        inside = (slice(8, -8), slice(8, -8))
        error = np.abs(back - rgb)[inside].max() / np.abs(rgb - 0.5)[inside].max()
        assert error < {8: 0.06, 12: 0.008, 24: 0.001}[period_px], (along, error)


def test_taps_keep_a_level():
    for subsampling, site in product((1, 2, 4), (0, 0.5, 1)):
        for taps in chroma_taps(subsampling, site):
            assert sum(taps) == pytest.approx(1)


def test_what_lies_outside_is_cut(arch):
    rng = np.random.default_rng(3)
    planes = tuple(rng.integers(0, 256, (8, 8)).astype(np.uint8) for _ in range(3))
    rgb = to_host(convert_chroma(planes, PixelFormat("yuv")))
    assert rgb.min() == 0
    assert rgb.max() == 1


def test_menu(menu):
    format = PixelFormat("yuv")
    luma, blue, red = random_planes(format, 5, 7)

    def call(luma, blue, red, out=None):
        return (
            to_host(convert_chroma((luma, blue, red), format))
            if out is None
            else convert_chroma((luma, blue, red), format, out)
        )

    menu(call, np.empty((5, 7, 3), np.float32), luma=luma, blue=blue, red=red)


def test_planes_of_another_size(arch):
    format = PixelFormat("yuv", subsampling=(2, 2))
    planes = (np.zeros((4, 6), np.uint8), np.zeros((2, 3), np.uint8), np.zeros((2, 4), np.uint8))
    with pytest.raises(tikernels.ShapeError, match=r"red chroma has shape \(2, 4\), expected \(2, 3\)"):
        convert_chroma(planes, format)
