"""Bayer mosaics to RGB."""

import numpy as np
import pytest
import reference
from support.array_forms import every_second, on_device, read_only

import tikernels
from tikernels.raw.demosaicing import demosaic
from tikernels.raw.pixel_format import BAYER_PATTERNS, PixelFormat
from tikernels.runtime import to_host


@pytest.mark.parametrize("size", [(17, 23), (9, 8), (32, 48)])
@pytest.mark.parametrize("stripes", ["horizontal", "vertical"])
@pytest.mark.parametrize("bayer", BAYER_PATTERNS)
def test_as_the_twin(arch, bayer, stripes, size):
    format = PixelFormat("bayer", 12, bayer=bayer)
    mosaic = np.random.default_rng(2).integers(0, 4096, size).astype(np.uint16)
    rgb = to_host(demosaic(mosaic, format, stripes))
    np.testing.assert_allclose(rgb, reference.demosaic(mosaic, format, stripes), atol=1e-6)


@pytest.mark.parametrize("period_px, largest", [(8, 0.03), (12, 0.002), (24, 0.0001)])
@pytest.mark.parametrize("stripes", ["horizontal", "vertical"])
def test_a_fringe_comes_back_whole(arch, stripes, period_px, largest):
    """The error of a fringe of amplitude 1; the mean of two rows would lose 0.13 of it at 12 px."""
    image = reference.fringes(reference.ramp(48, 60, period_px), modulation=0.4, background=0.5).astype(np.float64)
    if stripes == "vertical":
        image = image.transpose(1, 0, 2)
    format = PixelFormat("bayer", 16)
    mosaic = reference.mosaic(np.rint(65535 * image).astype(np.uint16), format.bayer)
    rgb = to_host(demosaic(mosaic, format, stripes))
    assert np.abs(rgb - image)[8:-8, 8:-8].max() < largest * 0.4 + 2 / 65535


@pytest.mark.parametrize("stripes", ["horizontal", "vertical"])
def test_a_slope_along_the_stripes_stays(arch, stripes):
    """Brightness may fall off along the stripes: a straight line is kept to rounding."""
    along = np.linspace(1000, 60000, 40)
    image = np.broadcast_to(along[None, :, None], (30, 40, 3)).astype(np.uint16)
    if stripes == "vertical":
        image = image.transpose(1, 0, 2)
    mosaic = reference.mosaic(image, "grbg")
    rgb = to_host(demosaic(mosaic, PixelFormat("bayer", 16, bayer="grbg"), stripes))
    inside = (slice(1, -1), slice(1, -1))
    np.testing.assert_allclose(65535 * rgb[inside], image[inside], atol=1)


def test_menu(arch):
    mosaic = np.random.default_rng(3).integers(0, 256, (9, 11)).astype(np.uint8)
    format = PixelFormat("bayer")
    expected = to_host(demosaic(mosaic, format))
    for variant in (every_second(mosaic), read_only(mosaic), on_device(mosaic)):
        np.testing.assert_array_equal(to_host(demosaic(variant, format)), expected)
    out = np.empty((9, 11, 3), np.float32)
    assert demosaic(mosaic, format, out=out) is out
    np.testing.assert_array_equal(out, expected)
    for bad in (mosaic.astype(np.uint16), mosaic[None], mosaic[:0], mosaic.tolist()):
        with pytest.raises(tikernels.ShapeError, match=r"has shape|is uint16, expected uint8|is empty|is a list"):
            demosaic(bad, format)
    for bad in (out.astype(np.float64), out[:-1], every_second(out), read_only(out)):
        with pytest.raises(tikernels.ShapeError):
            demosaic(mosaic, format, out=bad)


def test_too_small(arch):
    with pytest.raises(tikernels.ShapeError, match="at least 8x8"):
        demosaic(np.zeros((7, 9), np.uint8), PixelFormat("bayer"))


def test_unknown_stripes(arch):
    with pytest.raises(tikernels.ShapeError, match="stripes is 'diagonal'"):
        demosaic(np.zeros((8, 8), np.uint8), PixelFormat("bayer"), "diagonal")
