"""Smoothing along the stripes: pairs, slopes, steps."""

import numpy as np
import pytest
import reference

import tikernels
from tikernels import runtime
from tikernels.phase.smoothing import MEAN_QUALITY, RATE_ACROSS, RATE_ALONG, measure_rates, smooth_phase
from tikernels.phase.wrapped_phase import NO_PHASE, STEP_PHASE


def noisy(true: np.ndarray, noise: float, seed: int = 1) -> np.ndarray:
    return reference.wrapped(true + noise * np.random.default_rng(seed).standard_normal(true.shape))


@pytest.mark.parametrize("smoothing_px", [1, 3, 5, 9, 33])
@pytest.mark.parametrize("period_px, noise", [(12.0, 0.03), (12.0, 0.3), (5.5, 0.03)])
def test_as_the_twin(arch, smoothing_px, period_px, noise):
    true = reference.ramp(61, 113, period_px, tilt=0.03) + 2.0 * (np.arange(113) > 60)
    phase = noisy(true, noise)
    mask = np.random.default_rng(2).random(phase.shape) > 0.1
    found = tikernels.smooth_along_stripes(phase, mask, smoothing_px)
    difference = np.abs(reference.wrapped_difference(found, reference.smooth_along_stripes(phase, mask, smoothing_px)))
    # Float32 leaves 1e-6 rad; a pixel at a threshold may fall to either side of it.
    assert np.count_nonzero(difference > 1e-5) <= 1


@pytest.mark.parametrize("tilt", [0.0, 0.1, -0.25])
def test_a_slope_is_kept(arch, tilt):
    """Pairs leave no bias on a plane: 1e-5 rad is what float32 leaves of many cycles."""
    true = reference.ramp(40, 60, 12.0, tilt)
    found = tikernels.smooth_along_stripes(reference.wrapped(true), np.ones(true.shape, bool), 9)
    assert np.abs(reference.wrapped_difference(found, true)).max() < 1e-5


def test_the_noise_falls(arch):
    """Five samples of equal noise: its standard deviation falls by sqrt(5)."""
    true = reference.ramp(80, 120, 12.0, tilt=0.02)
    found = tikernels.smooth_along_stripes(noisy(true, 0.05), np.ones(true.shape, bool), 5)
    left = reference.wrapped_difference(found, true)[:, 2:-2].std()
    assert left == pytest.approx(0.05 / np.sqrt(5), rel=0.05)


def test_a_step_stays_sharp(arch):
    """Surfaces 2 rad (15 mm) apart do not mix: each keeps its own phase to the last pixel."""
    true = reference.ramp(48, 60) + 2.0 * (np.arange(60) >= 30)
    found = tikernels.smooth_along_stripes(reference.wrapped(true), np.ones(true.shape, bool), 9)
    assert np.abs(reference.wrapped_difference(found, true)).max() < 1e-5


def test_a_pixel_between_two_surfaces_is_left_alone(arch):
    true = reference.ramp(48, 60) + 2.4 * (np.arange(60) >= 30)
    true[:, 30] -= 1.2  # half of each surface
    phase = noisy(true, 0.02)
    found = tikernels.smooth_along_stripes(phase, np.ones(true.shape, bool), 5)
    np.testing.assert_array_equal(found[:, 30], phase[:, 30])


def test_outside_the_mask_nothing_changes(arch):
    phase = noisy(reference.ramp(33, 47), 0.1)
    mask = np.random.default_rng(3).random(phase.shape) > 0.3
    np.testing.assert_array_equal(tikernels.smooth_along_stripes(phase, np.zeros_like(mask)), phase)
    expected = tikernels.smooth_along_stripes(phase, mask)
    phase[~mask] = np.nan
    found = tikernels.smooth_along_stripes(phase, mask)
    assert np.isnan(found[~mask]).all()
    np.testing.assert_array_equal(found[mask], expected[mask])


def test_missing_values_are_as_if_masked(arch):
    phase = noisy(reference.ramp(33, 47), 0.1)
    mask = np.random.default_rng(4).random(phase.shape) > 0.1
    expected = tikernels.smooth_along_stripes(phase, mask)
    found = tikernels.smooth_along_stripes(np.where(mask, phase, np.float32(np.nan)), np.ones_like(mask))
    np.testing.assert_array_equal(found[mask], expected[mask])


@pytest.mark.parametrize("shape", [(1, 1), (1, 70), (70, 1), (2, 3)])
def test_slim_images(arch, shape):
    true = reference.ramp(*shape, tilt=0.05)
    found = tikernels.smooth_along_stripes(reference.wrapped(true), np.ones(shape, bool))
    assert np.abs(reference.wrapped_difference(found, true)).max() < 1e-5


def test_menu(menu):
    phase = noisy(reference.ramp(17, 23), 0.1)
    menu(
        lambda wrapped_phase, mask, out=None: tikernels.smooth_along_stripes(wrapped_phase, mask, out=out),
        np.empty_like(phase),
        wrapped_phase=phase,
        mask=np.random.default_rng(5).random(phase.shape) > 0.1,
    )


@pytest.mark.parametrize("smoothing_px", [-1, 0, 4, 35])
def test_impossible_windows(arch, smoothing_px):
    with pytest.raises(tikernels.ShapeError, match=f"smoothing_px is {smoothing_px}: take an odd number from 1 to 33"):
        tikernels.smooth_along_stripes(np.zeros((4, 4), np.float32), np.ones((4, 4), bool), smoothing_px)


def marked(phase: np.ndarray, mask: np.ndarray) -> np.ndarray:
    return np.where(mask, phase, np.float32(NO_PHASE)).astype(np.float32)


def test_the_decoders_smoothing_is_that_of_the_public_stage(arch):
    """Bit by bit where there is a phase, for a noise of which nothing is known; steps and the rest are marked."""
    true = reference.ramp(48, 60) + 2.4 * (np.arange(60) >= 30)
    true[:, 30] -= 1.2
    phase, mask = noisy(true, 0.02), np.random.default_rng(6).random((48, 60)) > 0.1
    seen = marked(phase, mask)
    found = runtime.to_host(smooth_phase(seen, np.zeros_like(phase), measure_rates(seen, seen), 2))
    public = tikernels.smooth_along_stripes(phase, mask, 5)
    smoothed = found < NO_PHASE
    assert smoothed.mean() > 0.8
    assert np.abs(reference.wrapped_difference(found, public)[smoothed]).max() < 1e-6
    assert (found[~mask] == NO_PHASE).all()
    assert (found[mask & ~smoothed] == STEP_PHASE).all()


def test_rates_are_those_of_a_plane(arch):
    """To 1e-6 rad a px, and the quality's mean over every eighth pixel."""
    phase = reference.wrapped(reference.ramp(64, 96, 12.0, tilt=0.03))
    quality = np.random.default_rng(7).random((64, 96), np.float32)
    last = runtime.to_host(measure_rates(phase, quality))[-1]
    assert last[RATE_ALONG] == pytest.approx(0.03, abs=2e-6)
    assert last[RATE_ACROSS] == pytest.approx(2 * np.pi / 12, abs=2e-6)
    assert last[MEAN_QUALITY] == pytest.approx(reference.usual_change(phase, quality)[2], rel=1e-5)


def test_menu_of_the_decoders_stages(menu):
    phase = marked(noisy(reference.ramp(17, 23), 0.1), np.ones((17, 23), bool))
    precision = np.full((17, 23), 400, np.float32)

    def rates(out=None, **inputs):
        found = measure_rates(**inputs, out=out)
        return runtime.to_host(found) if out is None else found

    menu(rates, np.empty((4, 5), np.float32), phase=phase, quality=precision)
    measured = np.array(rates(phase=phase, quality=precision))

    def smooth(out=None, **inputs):
        found = smooth_phase(**inputs, pairs=2, out=out)
        return runtime.to_host(found) if out is None else found

    menu(smooth, np.empty((17, 23), np.float32), phase=phase, precision=precision, rates=measured)
