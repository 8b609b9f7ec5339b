"""Pixels at rims that go on as their surface does are added to it, and no others."""

import numpy as np
import pytest

import tikernels
from tikernels import runtime
from tikernels.phase.phase_change import RATE_ACROSS, RATE_ALONG, rates_shape
from tikernels.phase.wrapped_phase import NO_PHASE
from tikernels.unwrapping.rim_growing import doubt_rims, grow_rims

SHAPE = (40, 64)
ACROSS = 0.5
SIGMA = 0.05
RIM = 50


def bending_surface() -> dict[str, np.ndarray]:
    """Return a surface that turns away to the right, of which pixels from column 40 on are in no region.

    It ends in column 50, and nothing is lit beyond.
    """
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    noise = SIGMA * np.random.default_rng(4).standard_normal(SHAPE)
    # As the rim of a ball: the depth goes as the root of the distance from the rim.
    bend = 2 * (np.sqrt(50.0) - np.sqrt(np.maximum(RIM - x, 0) + 1.0))
    true = ACROSS * y + bend
    lit = x < RIM
    known = x < 40
    wrapped = (true + noise + np.pi) % (2 * np.pi) - np.pi
    return {
        "true": true,
        "phase": np.where(lit, wrapped, NO_PHASE).astype(np.float32),
        "precision": np.full(SHAPE, SIGMA**-2, np.float32),
        "misfit": np.ones(SHAPE, np.float32),
        "brightness": (80 / (1 + bend)).astype(np.float32),
        "unwrapped": np.where(known, true, np.nan).astype(np.float32),
        "region": np.where(known, 1, 0).astype(np.int32),
    }


def grown(case: dict[str, np.ndarray]) -> tuple[np.ndarray, ...]:
    """Return unwrapped phase, mask and region after growing."""
    rates = np.zeros(rates_shape(SHAPE[0]), np.float32)
    rates[-1, RATE_ALONG], rates[-1, RATE_ACROSS] = 0, ACROSS
    region = case["region"].copy()
    out = (case["unwrapped"].copy(), (region > 0).astype(np.uint8), region)
    grow_rims(case["phase"], case["precision"], case["misfit"], case["brightness"], rates, out)
    return tuple(runtime.to_host(part) for part in out)


def test_a_rim_grows_by_its_own_phases(arch):
    case = bending_surface()
    unwrapped, mask, region = grown(case)
    added = (region > 0) & (case["region"] == 0)
    np.testing.assert_array_equal(mask != 0, region > 0)
    np.testing.assert_array_equal(np.isfinite(unwrapped), region > 0)
    # By six pixels, but where noise is more than what may be.
    assert added[:, 40:46].mean() > 0.9
    assert not added[:, 46:].any()
    assert np.abs(unwrapped - case["true"])[added].max() < 5 * SIGMA
    known = case["region"] > 0
    np.testing.assert_array_equal(unwrapped[known], case["unwrapped"][known])


def test_light_from_beyond_a_rim_is_doubted(arch):
    """By a tenth of the brightest pixel around that is on no surface, over the own brightness; not inside."""
    region = np.zeros(SHAPE, np.int32)
    region[:, :40] = 1
    brightness = np.full(SHAPE, 50, np.float32)
    brightness[10, 40] = 100
    variance = np.full(SHAPE, 0.01, np.float32)
    doubt_rims(brightness, region, variance)
    expected = np.full(SHAPE, 0.01)
    expected[:, 39] += 0.1**2
    expected[9:12, 39] = 0.01 + 0.2**2
    np.testing.assert_allclose(runtime.to_host(variance), expected, rtol=1e-5)


def test_whole_cycles_are_those_of_the_surface(arch):
    case = bending_surface()
    case["unwrapped"] += np.float32(6 * np.pi)
    unwrapped, _, region = grown(case)
    added = (region > 0) & (case["region"] == 0)
    assert np.abs(unwrapped - 6 * np.pi - case["true"])[added].max() < 5 * SIGMA


@pytest.mark.parametrize("what", ["phase", "misfit", "brightness", "dark"])
def test_what_does_not_go_on_is_left(arch, what):
    """Another surface's phase, a pixel that fits no phase, another brightness, and nothing at all.

    The pixel before goes on, but may see some of another surface.
    """
    case = bending_surface()
    stranger = np.s_[:, 41:]
    if what == "phase":
        case["phase"][stranger] -= np.where(case["phase"][stranger] < NO_PHASE, np.float32(2), np.float32(0))
    elif what == "misfit":
        case["misfit"][stranger] = 10
    elif what == "brightness":
        case["brightness"][stranger] *= 0.5
    else:
        case["phase"][stranger] = NO_PHASE
    region = grown(case)[2]
    assert (region[:, 40] == 0).all() if what == "phase" else (region[:, 40] == 1).mean() > 0.9
    assert (region[stranger] == 0).all()


def test_what_lies_beside_another_surface_is_left(arch):
    """It may have seen both; of a gap of three pixels the one in the middle belongs to none, and more at most."""
    case = bending_surface()
    case["region"][:, 43:] = 2
    case["unwrapped"][:, 43:] = (case["true"][:, 43:] + 20).astype(np.float32)
    region = grown(case)[2]
    assert (region[:, 40] == 1).mean() > 0.9
    assert (region[:, 42] == 0).all()


def test_a_single_pixel_tells_no_surface(arch):
    case = bending_surface()
    case["region"][:] = 0
    case["region"][20, :40] = 1
    case["unwrapped"][case["region"] == 0] = np.nan
    region = grown(case)[2]
    assert (region[:, 40:] == 0).all()


def test_other_shapes_are_refused(cpu):
    case = bending_surface()
    case["brightness"] = case["brightness"][1:]
    with pytest.raises(tikernels.ShapeError, match="brightness has shape"):
        grown(case)
    with pytest.raises(tikernels.ShapeError, match="variance has shape"):
        doubt_rims(np.zeros(SHAPE, np.float32), np.zeros(SHAPE, np.int32), np.zeros((4, 4), np.float32))
    case = bending_surface()
    case["misfit"] = case["misfit"].astype(np.float64)
    with pytest.raises(tikernels.ShapeError, match="misfit"):
        grown(case)
