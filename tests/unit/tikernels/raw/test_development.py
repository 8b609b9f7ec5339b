"""From planes as they are stored to RGB."""

import numpy as np
import pytest

import tikernels
from tikernels.raw.chroma_upsampling import convert_chroma
from tikernels.raw.demosaicing import demosaic
from tikernels.raw.development import develop
from tikernels.raw.pixel_format import PixelFormat
from tikernels.runtime import to_host

RNG = np.random.default_rng(5)
RGB8 = RNG.integers(0, 256, (7, 9, 3)).astype(np.uint8)
RGB16 = RNG.integers(0, 65536, (7, 9, 3)).astype(np.uint16)


@pytest.mark.parametrize("image, bits", [(RGB8, 8), (RGB16, 16), (RGB8.astype(np.float32) / 255, 32)])
def test_rgb_is_not_copied(arch, image, bits):
    assert develop((image,), PixelFormat("rgb", bits)) is image


@pytest.mark.parametrize("channels", ["bgr", "bgr0", "0rgb", "rgb0"])
def test_channels_are_put_in_order(arch, channels):
    stored = np.stack([RGB8[..., "rgb".index(c)] if c != "0" else 0 * RGB8[..., 0] for c in channels], axis=-1)
    rgb = to_host(develop((stored,), PixelFormat("rgb", channels=channels)))
    np.testing.assert_array_equal(rgb, RGB8)
    assert rgb.dtype == np.uint8


@pytest.mark.parametrize("image, bits", [(RGB8, 8), (RGB16, 16)])
def test_planes_are_joined(arch, image, bits):
    planes = tuple(np.ascontiguousarray(image[..., i]) for i in (1, 2, 0))
    rgb = to_host(develop(planes, PixelFormat("rgb", bits, channels="gbr")))
    np.testing.assert_array_equal(rgb, image)
    assert rgb.dtype == image.dtype


def test_rows_may_be_padded(arch):
    padded = np.zeros((7, 16, 3), np.uint8)
    padded[:, :9] = RGB8
    rgb = to_host(develop((padded[:, :9],), PixelFormat("rgb", channels="bgr")))
    np.testing.assert_array_equal(rgb, RGB8[..., ::-1])


@pytest.mark.parametrize("bits", [10, 12])
def test_full_scale_is_one_where_it_is_not_the_types(arch, bits):
    white = np.full((2, 3, 3), 2**bits - 1, np.uint16)
    np.testing.assert_allclose(to_host(develop((white,), PixelFormat("rgb", bits))), 1, atol=1e-6)
    planes = tuple(white[..., i].copy() for i in range(3))
    np.testing.assert_allclose(to_host(develop(planes, PixelFormat("rgb", bits, channels="gbr"))), 1, atol=1e-6)


def test_each_layout_has_its_kernel(arch):
    mosaic = RNG.integers(0, 256, (8, 8)).astype(np.uint8)
    format = PixelFormat("bayer", bayer="gbrg")
    for stripes in ("horizontal", "vertical"):
        developed = to_host(develop((mosaic,), format, stripes=stripes))
        np.testing.assert_array_equal(developed, to_host(demosaic(mosaic, format, stripes)))
    planes = (mosaic, mosaic[::2, ::2], mosaic[1::2, 1::2])
    format = PixelFormat("yuv", subsampling=(2, 2))
    np.testing.assert_array_equal(to_host(develop(planes, format)), to_host(convert_chroma(planes, format)))


def test_out_is_used(arch):
    out = np.empty_like(RGB8)
    assert develop((RGB8,), PixelFormat("rgb", channels="bgr"), out=out) is out
    np.testing.assert_array_equal(out, RGB8[..., ::-1])


@pytest.mark.parametrize(
    "planes, format, message",
    [
        ((RGB8, RGB8), PixelFormat("rgb"), "rgb frame has 2 planes, expected 1 or 3"),
        ((RGB8[..., 0],), PixelFormat("yuv"), "yuv frame has 1 planes, expected 3"),
        ((RGB16,), PixelFormat("rgb"), "plane is uint16, expected uint8"),
        ((RGB8,), PixelFormat("rgb", channels="bgr0"), r"plane has shape \(7, 9, 3\), expected \(any, any, 4\)"),
    ],
)
def test_planes_that_are_not_as_said(arch, planes, format, message):
    with pytest.raises(tikernels.ShapeError, match=message):
        develop(planes, format)


@pytest.mark.parametrize(
    "wrong, message",
    [
        ({"layout": "hsv"}, "layout is 'hsv': choose rgb, bayer, yuv"),
        ({"layout": "rgb", "bits": 7}, "bits is 7"),
        ({"layout": "rgb", "channels": "rgx"}, "name r, g and b once"),
        ({"layout": "bayer", "bayer": "rgbg"}, "bayer is 'rgbg'"),
        ({"layout": "yuv", "subsampling": (3, 1)}, "subsampling is"),
        ({"layout": "yuv", "siting": "middle"}, "siting is 'middle'"),
        ({"layout": "yuv", "matrix": "ycgco"}, "matrix is 'ycgco'"),
        ({"layout": "yuv", "bits": 32}, "only RGB may be floats"),
    ],
)
def test_formats_that_no_kernel_reads(wrong, message):
    with pytest.raises(tikernels.ShapeError, match=message):
        PixelFormat(**wrong)
