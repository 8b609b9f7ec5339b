"""How frames are stored: element types, full scales and the shapes of planes."""

import numpy as np
import pytest

from tikernels import PixelFormat, ShapeError


@pytest.mark.parametrize(
    ("format", "dtype", "white", "rgb"),
    [
        (PixelFormat("rgb"), np.uint8, 255, np.uint8),
        (PixelFormat("rgb", bits=10), np.uint16, 1023, np.float32),
        (PixelFormat("rgb", bits=16), np.uint16, 65535, np.uint16),
        (PixelFormat("rgb", bits=32), np.float32, 1, np.float32),
        (PixelFormat("rgb", bits=10, shift=6), np.uint16, 1023 * 64, np.float32),
        (PixelFormat("bayer"), np.uint8, 255, np.float32),
        (PixelFormat("bayer", bits=12), np.uint16, 4095, np.float32),
        (PixelFormat("yuv", bits=10, shift=6), np.uint16, 65472, np.float32),
    ],
)
def test_types_and_full_scale(format, dtype, white, rgb):
    """Levels that fill their type stay what they are; all others become floats."""
    assert (format.dtype, format.white_level, format.rgb_dtype) == (dtype, white, rgb)


def test_planes():
    assert PixelFormat("rgb", channels="bgr0").plane_shapes(5, 7) == ((5, 7, 4),)
    assert PixelFormat("bayer").plane_shapes(5, 7) == ((5, 7),)
    assert PixelFormat("yuv").plane_shapes(5, 7) == ((5, 7), (5, 7), (5, 7))
    # Chroma samples cover what is left at the border.
    assert PixelFormat("yuv", subsampling=(2, 2)).plane_shapes(5, 7) == ((5, 7), (3, 4), (3, 4))
    assert PixelFormat("yuv", subsampling=(4, 1)).plane_shapes(5, 7) == ((5, 7), (5, 2), (5, 2))
    # Of the first ones pixels are missing.
    assert PixelFormat("yuv", subsampling=(2, 2), origin=(1, 1)).plane_shapes(6, 6) == ((6, 6), (4, 4), (4, 4))


@pytest.mark.parametrize(
    ("faulty", "message"),
    [
        ({"layout": "grey"}, "layout is 'grey': choose rgb, bayer, yuv"),
        ({"layout": "rgb", "bits": 7}, "bits is 7: choose 8, 9"),
        ({"layout": "bayer", "bayer": "rgbg"}, "bayer is 'rgbg'"),
        ({"layout": "yuv", "subsampling": (3, 1)}, r"subsampling is \(3, 1\)"),
        ({"layout": "yuv", "subsampling": (2, 1), "origin": (0, 1)}, r"origin is \(0, 1\): give less than the"),
        ({"layout": "rgb", "channels": "rrg"}, "channels is 'rrg': name r, g and b once"),
        ({"layout": "bayer", "bits": 32}, "bayer pixels of 32 bits: only RGB may be floats"),
    ],
)
def test_impossible_formats(faulty, message):
    with pytest.raises(ShapeError, match=message):
        PixelFormat(**faulty)
