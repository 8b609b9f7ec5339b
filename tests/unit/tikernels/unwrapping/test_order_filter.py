"""The in-place filter, in parallel and one pixel after the other."""

import numpy as np
import pytest
import reference

import tikernels


def random_map(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a noisy plane with whole cycles astray, ever more of them, and a mask with holes."""
    rng = np.random.default_rng(seed)
    shape = (int(rng.integers(35, 70)), int(rng.integers(35, 70)))
    true = reference.ramp(*shape, 12.0, tilt=0.05) + 0.3 * rng.standard_normal(shape)
    share = (0.02, 0.1, 0.3, 0.6)[seed % 4]
    astray = rng.choice([-2, -1, 1, 2], shape) * (rng.random(shape) < share)
    return (true + 2 * np.pi * astray).astype(np.float32), rng.random(shape) > 0.1


@pytest.mark.parametrize("stripes", ["horizontal", "vertical"])
@pytest.mark.parametrize("seed", range(8))
def test_as_the_sequential_filter(arch, seed, stripes):
    """The same orders at every single pixel, dense errors included."""
    phase, mask = random_map(seed)
    window_px = (11, 3, 21)[seed % 3]
    found = tikernels.correct_fringe_order(phase, mask, window_px, stripes)
    if stripes == "vertical":
        cycles = reference.correct_fringe_order(phase.T, mask.T, window_px).T
    else:
        cycles = reference.correct_fringe_order(phase, mask, window_px)
    np.testing.assert_array_equal(np.rint((found - phase) / (2 * np.pi)), cycles)
    assert (cycles != 0).any()
    np.testing.assert_array_equal(found[~mask], phase[~mask])


def test_a_plane_is_right_already(arch):
    """Within the window a plane's mean is its middle: nothing changes, not even at the rim of a shallow one."""
    phase = reference.ramp(45, 63, 30.0, tilt=0.02).astype(np.float32)
    np.testing.assert_array_equal(tikernels.correct_fringe_order(phase, np.ones(phase.shape, bool)), phase)


def test_lone_errors_are_taken_back(arch):
    """One pixel in fifty a cycle off: all of them come back, to the float32 rounding of 40 rad."""
    rng = np.random.default_rng(9)
    true = reference.ramp(80, 90, 12.0).astype(np.float32)
    astray = rng.choice([-1, 1], true.shape) * (rng.random(true.shape) < 0.02)
    astray[:6] = astray[-6:] = 0  # at the rim the window is one-sided, and half a cycle is 6 px away
    phase = (true + 2 * np.pi * astray).astype(np.float32)
    found = tikernels.correct_fringe_order(phase, np.ones(true.shape, bool))
    inner = np.s_[6:-6]
    np.testing.assert_allclose(found[inner], true[inner], atol=1e-4)


def test_outside_the_mask_nothing_changes(arch):
    phase, mask = random_map(1)
    expected = tikernels.correct_fringe_order(phase, mask)
    phase[~mask] = np.nan
    found = tikernels.correct_fringe_order(phase, mask)
    np.testing.assert_array_equal(found[mask], expected[mask])
    assert np.isnan(found[~mask]).all()
    np.testing.assert_array_equal(tikernels.correct_fringe_order(phase, np.zeros_like(mask)), phase)


@pytest.mark.parametrize("shape", [(1, 1), (1, 70), (70, 1), (2, 3)])
def test_slim_images(arch, shape):
    rng = np.random.default_rng(3)
    phase = (0.3 * rng.standard_normal(shape) + 2 * np.pi * (rng.random(shape) < 0.1)).astype(np.float32)
    mask = np.ones(shape, bool)
    cycles = reference.correct_fringe_order(phase, mask, 11)
    found = tikernels.correct_fringe_order(phase, mask)
    np.testing.assert_array_equal(np.rint((found - phase) / (2 * np.pi)), cycles)


def test_twice_the_same(arch):
    phase, mask = random_map(3)
    first, second = (tikernels.correct_fringe_order(phase, mask) for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_menu(menu):
    phase, mask = random_map(5)
    menu(tikernels.correct_fringe_order, np.empty_like(phase), unwrapped_phase=phase, mask=mask)


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"window_px": 10}, "window_px is 10: take an odd number from 3 to 31"),
        ({"window_px": 1}, "window_px is 1:"),
        ({"window_px": 33}, "window_px is 33:"),
        ({"stripes": "diagonal"}, "stripes is 'diagonal': choose horizontal or vertical"),
    ],
)
def test_impossible_arguments(arch, arguments, message):
    with pytest.raises(tikernels.ShapeError, match=message):
        tikernels.correct_fringe_order(np.zeros((4, 4), np.float32), np.ones((4, 4), bool), **arguments)
