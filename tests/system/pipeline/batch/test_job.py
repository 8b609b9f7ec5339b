"""What is to be decoded of footage: which frames, and which part of them."""

import numpy as np
import pytest

from pipeline.batch import job as jobs
from pipeline.batch.job import Crop, chains, join_ranges
from pipeline.errors import SettingsError
from tikernels import runtime
from tikernels.raw.development import develop
from tikernels.raw.pixel_format import PixelFormat

pytestmark = pytest.mark.usefixtures("cpu")


def test_which_frames_are_decoded_for_which(monkeypatch):
    monkeypatch.setattr(jobs, "CHAIN_FRAMES", 4)
    assert list(chains(range(0, 14), {5, 6, 12})) == [(range(4, 7), {5, 6}), (range(12, 13), {12})]
    assert list(chains(range(9, 40, 3), {15})) == [(range(12, 16, 3), {15})]
    assert list(chains(range(0, 14), set())) == []
    assert list(join_ranges([range(0, 4), range(4, 8), range(12, 13)])) == [range(0, 8), range(12, 13)]
    assert list(join_ranges([])) == []


@pytest.mark.parametrize(
    "format",
    [
        PixelFormat("yuv", subsampling=(2, 2)),
        PixelFormat("yuv", subsampling=(2, 1), origin=(1, 0)),
        PixelFormat("bayer", bayer="grbg"),
        PixelFormat("rgb", channels="bgr0"),
    ],
)
def test_a_region_is_cut_out_of_the_planes(format):
    """It develops into what the whole frame has there, except for its rim, where neighbours are missing."""
    rng = np.random.default_rng(3)
    planes = tuple(rng.integers(0, 256, shape).astype(np.uint8) for shape in format.plane_shapes(48, 64))
    odd = int(format.layout == "yuv")  # it may begin within a sample of chroma
    region, rim = Crop(8 + odd, 4 + odd, 41, 31), 12
    region.check((64, 48), format)
    part = runtime.to_host(develop(*region.of(planes, format)))
    whole = runtime.to_host(develop(planes, format))[region.y :, region.x :][:31, :41]
    inside = np.s_[rim:-rim, rim:-rim]
    np.testing.assert_array_equal(part[inside], whole[inside])
    if format.layout == "bayer":
        with pytest.raises(SettingsError, match="within a cell of this footage's mosaic"):
            Crop(7, 4, 41, 31).check((64, 48), format)
