"""Pixels at a rim whose light is another surface's are left out, and no others."""

import numpy as np
import pytest

import tikernels
from tikernels import runtime
from tikernels.unwrapping.rim_pixels import leave_out_strangers

SHAPE = (60, 80)


def surfaces() -> tuple[np.ndarray, np.ndarray]:
    """Return modulation and surfaces: a bright wall, a dim body before it, and nothing between them further down."""
    noise = 1 + 0.1 * np.random.default_rng(2).standard_normal(SHAPE)
    region = np.ones(SHAPE, np.int32)
    region[:, 40:] = 2
    region[40:, 36:44] = 0
    return (np.where(region == 2, 20, 80) * noise).astype(np.float32), region


def left(modulation: np.ndarray, region: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the unwrapped phase, the mask and the surfaces that are left."""
    unwrapped = np.where(region > 0, np.float32(1), np.float32(np.nan))
    out = (unwrapped, (region > 0).astype(np.uint8), region.copy())
    leave_out_strangers(modulation, out)
    return tuple(runtime.to_host(part) for part in out)


def test_a_surface_keeps_its_own(arch):
    modulation, region = surfaces()
    unwrapped, mask, kept = left(modulation, region)
    np.testing.assert_array_equal(kept, region)
    np.testing.assert_array_equal(mask, region > 0)
    np.testing.assert_array_equal(np.isfinite(unwrapped), region > 0)


def test_what_was_claimed_by_the_wrong_side_is_left_out(arch):
    """Two columns of the body that the wall has claimed, and two px of the wall that the body has."""
    modulation, region = surfaces()
    claimed = region.copy()
    claimed[10:20, 40:42] = 1
    claimed[25:27, 39] = 2
    strange = claimed != region
    unwrapped, mask, kept = left(modulation, claimed)
    assert (mask[strange] == 0).all()
    assert (kept == np.where(strange, 0, region)).all()
    assert np.isnan(unwrapped[strange]).all()
    assert np.isfinite(unwrapped[(region > 0) & ~strange]).all()


def test_a_shadow_within_a_surface_is_no_stranger(arch):
    """Dim, but far from any other surface; and beside one that is brighter still."""
    modulation, region = surfaces()
    modulation[20:30, 10:20] *= 0.3
    modulation[:, 38:40] *= 0.3
    region[:, 40:] = 0
    region[:, 44:] = 2
    modulation[:, 40:] = 200
    np.testing.assert_array_equal(left(modulation, region)[2], region)


def test_other_shapes_are_refused(cpu):
    modulation, region = surfaces()
    out = (np.zeros(SHAPE, np.float32), np.ones(SHAPE, np.uint8), region)
    with pytest.raises(tikernels.ShapeError, match="mask has shape"):
        leave_out_strangers(modulation, (out[0], out[1][1:], out[2]))
    with pytest.raises(tikernels.ShapeError, match="region"):
        leave_out_strangers(modulation, (out[0], out[1], region.astype(np.int64)))
