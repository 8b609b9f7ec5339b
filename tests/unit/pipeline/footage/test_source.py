"""What all sources share: what users say of pixels, and which frames may lie in one store."""

from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.errors import FootageError
from pipeline.footage.footage import StoredAs, other_than_first, turned
from pipeline.footage.picture_tags import upright
from tikernels.raw.development import develop
from tikernels.raw.pixel_format import PixelFormat
from tikernels.runtime import to_host

YUV = PixelFormat("yuv", 10, 6, subsampling=(2, 2))


def test_what_the_user_says_wins_and_the_rest_stays():
    said = StoredAs(siting="centre", full_range=True).applied_to(YUV)
    assert (said.siting, said.full_range, said.bits, said.shift) == ("centre", True, 10, 6)
    assert StoredAs().applied_to(YUV) == YUV
    assert StoredAs(bits=12).applied_to(PixelFormat("rgb", 16)).bits == 12


@pytest.mark.parametrize(("bits", "format"), [(12, YUV), (12, PixelFormat("rgb")), (8, PixelFormat("rgb", 16))])
def test_bits_that_the_values_do_not_have(bits, format):
    with pytest.raises(FootageError, match=rf"bits is {bits}, but its values have {format.bits}"):
        StoredAs(bits=bits).applied_to(format)


@pytest.mark.parametrize(
    ("format", "size_px", "difference"),
    [
        (PixelFormat("rgb"), (64, 48), None),
        (PixelFormat("rgb", channels="bgr0"), (64, 48), None),
        (PixelFormat("rgb"), (64, 40), "it is 64x40 rgb, the first is 64x48 rgb"),
        (PixelFormat("rgb", 16), (64, 48), "it is of 16 bits, the first is of 8 bits"),
        (PixelFormat("bayer"), (64, 48), "it is 64x48 bayer, the first is 64x48 rgb"),
    ],
)
def test_frames_of_one_store_share_size_kind_and_levels(format, size_px, difference):
    source = SimpleNamespace(format=PixelFormat("rgb"), size_px=(64, 48))
    assert other_than_first(format, size_px, source) == difference


def test_frames_of_one_store_are_subsampled_alike():
    source = SimpleNamespace(format=PixelFormat("yuv", subsampling=(2, 2)), size_px=(64, 48))
    other = PixelFormat("yuv", subsampling=(2, 1))
    assert "subsampled by 2x1, the first is subsampled by 2x2" in other_than_first(other, (64, 48), source)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize(
    "format",
    [
        PixelFormat("yuv", subsampling=(2, 2), siting="left"),
        PixelFormat("yuv", subsampling=(2, 1), siting="centre"),
        PixelFormat("yuv", subsampling=(4, 1), siting="top-left"),
        PixelFormat("rgb"),
        PixelFormat("bayer", bayer="gbrg"),
    ],
    ids=lambda format: format.layout + str(format.subsampling),
)
def test_turned_planes_are_the_turned_picture(cpu, format, orientation):
    """Its samples of chroma sit elsewhere then, and where the size is odd the first ones lack a pixel."""
    rng = np.random.default_rng(2)
    planes = tuple(rng.integers(0, 256, shape).astype(np.uint8) for shape in format.plane_shapes(21, 31))
    across = "horizontal" if orientation < 5 else "vertical"  # along which a mosaic's colours are interpolated
    picture = upright(np.array(to_host(develop(planes, format, stripes="horizontal"))), orientation)
    np.testing.assert_allclose(
        to_host(develop(*turned(planes, format, orientation), stripes=across)), picture, atol=1e-6
    )
