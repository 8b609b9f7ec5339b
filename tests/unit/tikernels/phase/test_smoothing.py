"""Smoothing along the stripes and across them: pairs, slopes, relief, steps."""

import numpy as np
import pytest
import reference

import tikernels
from tikernels import runtime
from tikernels.phase.phase_change import measure_rates
from tikernels.phase.smoothing import Smoother, left_of_relief
from tikernels.phase.wrapped_phase import NO_PHASE, STEP_PHASE


def noisy(true: np.ndarray, noise: float, seed: int = 1) -> np.ndarray:
    return reference.wrapped(true + noise * np.random.default_rng(seed).standard_normal(true.shape))


def decoded(phase: np.ndarray, sigma: float, pairs: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Return what the decoder's smoothing makes of a phase of which all is valid, and its variance (rad^2)."""
    precision, mask = np.full(phase.shape, sigma**-2, np.float32), np.ones(phase.shape, np.uint8)
    phase = phase.astype(np.float32)
    smoother, rates = Smoother(*phase.shape, pairs), measure_rates(phase, precision)
    rows = runtime.to_host(smoother.along(phase, precision, rates)).copy()
    mask[rows > 50] = 0
    smoothed, variance = smoother.across(rows, mask, rates, wraps=True)
    return np.where(mask, runtime.to_host(smoothed), phase), runtime.to_host(variance)


def assert_as_the_twin(smoothing_px, period_px, noise):
    true = reference.ramp(61, 113, period_px, tilt=0.03) + 2.0 * (np.arange(113) > 60)
    phase = noisy(true, noise)
    mask = np.random.default_rng(2).random(phase.shape) > 0.1
    found = tikernels.smooth_phase(phase, mask, smoothing_px)
    difference = np.abs(reference.wrapped_difference(found, reference.smooth_phase(phase, mask, smoothing_px)))
    # Float32 leaves 1e-6 rad; a pixel at a threshold may fall to either side of it.
    assert np.count_nonzero(difference > 1e-5) <= 1


@pytest.mark.parametrize("smoothing_px", [1, 3, 7])
@pytest.mark.parametrize("period_px, noise", [(12.0, 0.03), (12.0, 0.3), (5.5, 0.03)])
def test_as_the_twin(arch, smoothing_px, period_px, noise):
    assert_as_the_twin(smoothing_px, period_px, noise)


@pytest.mark.parametrize("smoothing_px", [5, 15])
@pytest.mark.parametrize("period_px, noise", [(12.0, 0.03), (12.0, 0.3), (5.5, 0.03)])
def test_as_the_twin_over_other_lengths(cpu, smoothing_px, period_px, noise):
    """On the CPU only: software Vulkan compiles the longest loops for over a minute."""
    assert_as_the_twin(smoothing_px, period_px, noise)


@pytest.mark.parametrize("tilt", [0.0, 0.1, -0.25])
def test_a_slope_is_kept(arch, tilt):
    """Pairs leave no bias on a plane: 1e-5 rad is what float32 leaves of many cycles."""
    true = reference.ramp(40, 60, 12.0, tilt)
    found = tikernels.smooth_phase(reference.wrapped(true), np.ones(true.shape, bool), 7)
    assert np.abs(reference.wrapped_difference(found, true)).max() < 1e-5


@pytest.mark.parametrize("sigma", [0.03, 0.06, 0.1])
def test_the_noise_falls(arch, sigma):
    """To 0.27 of it, and what is left is said, as long as no pair is left out by chance."""
    true = reference.ramp(160, 200, 12.0, tilt=0.02)
    smoothed, variance = decoded(noisy(true, sigma), sigma)
    error = reference.wrapped_difference(smoothed, true)[5:-5, 5:-5]
    assert error.std() < 0.29 * sigma
    assert error.std() == pytest.approx(np.sqrt(variance[5:-5, 5:-5].mean()), rel=0.06)


@pytest.mark.parametrize("down", [False, True])
@pytest.mark.parametrize("amplitude", [0.5, 5.0])
@pytest.mark.parametrize("sigma", [0.03, 0.06])
def test_relief_is_kept(arch, down, amplitude, sigma):
    """Of waves 7.25 px long, 5 mm on the usual rig, four fifths are left, whether they are lost in the noise or not."""
    y, x = np.mgrid[:160, :200]
    wave = np.cos(2 * np.pi / 7.25 * (y if down else x))
    seen = []
    for seed in range(4):
        flat = reference.ramp(160, 200, 12.0)
        smoothed, _ = decoded(noisy(flat + amplitude * sigma * wave, sigma, seed), sigma)
        found = reference.wrapped_difference(smoothed, flat)[8:-8, 8:-8]
        seen.append(2 * np.mean(found * wave[8:-8, 8:-8]) / (amplitude * sigma))
    assert np.mean(seen) > 0.78


@pytest.mark.parametrize("down", [False, True])
@pytest.mark.parametrize("period_px", [4.0, 5.5, 7.25, 12.0])
def test_a_low_relief_is_kept_as_said(arch, down, period_px):
    y, x = np.mgrid[:160, :200]
    wave = np.exp(2j * np.pi / period_px * (y if down else x))
    flat = reference.ramp(160, 200, 12.0)
    smoothed, _ = decoded(noisy(flat + 0.01 * wave.real, 0.001), 0.03)
    found = reference.wrapped_difference(smoothed, flat)[8:-8, 8:-8]
    left = 2 * np.mean(found * wave[8:-8, 8:-8].conj()).real / 0.01
    assert left == pytest.approx(left_of_relief(3, np.array([period_px]))[0], abs=0.01)


@pytest.mark.parametrize("down", [False, True])
def test_a_small_step_blurs_two_pixels(arch, down):
    """Surfaces 0.7 rad (5 mm) apart: beyond the second pixel the error is less than 0.05 rad."""
    y, x = np.mgrid[:120, :120]
    for sigma in (0.03, 0.06, 0.1):
        true = reference.ramp(120, 120, 12.0) + 0.7 * ((y if down else x) >= 60)
        smoothed, _ = decoded(noisy(true, sigma), sigma)
        error = np.abs(reference.wrapped_difference(smoothed, true).mean(axis=1 if down else 0))
        assert np.delete(error, slice(58, 62)).max() < 0.05


def test_a_step_stays_sharp(arch):
    """Surfaces 2 rad (15 mm) apart do not mix: each keeps its own phase to the last pixel."""
    true = reference.ramp(48, 60) + 2.0 * (np.arange(60) >= 30)
    found = tikernels.smooth_phase(reference.wrapped(true), np.ones(true.shape, bool), 7)
    assert np.abs(reference.wrapped_difference(found, true)).max() < 1e-5


def test_a_pixel_between_two_surfaces_is_left_alone(arch):
    true = reference.ramp(48, 60) + 2.4 * (np.arange(60) >= 30)
    true[:, 30] -= 1.2  # half of each surface
    phase = noisy(true, 0.02)
    found = tikernels.smooth_phase(phase, np.ones(true.shape, bool), 5)
    np.testing.assert_array_equal(found[:, 30], phase[:, 30])


def test_outside_the_mask_nothing_changes(arch):
    phase = noisy(reference.ramp(33, 47), 0.1)
    mask = np.random.default_rng(3).random(phase.shape) > 0.3
    np.testing.assert_array_equal(tikernels.smooth_phase(phase, np.zeros_like(mask)), phase)
    expected = tikernels.smooth_phase(phase, mask)
    phase[~mask] = np.nan
    found = tikernels.smooth_phase(phase, mask)
    assert np.isnan(found[~mask]).all()
    np.testing.assert_array_equal(found[mask], expected[mask])


def test_missing_values_are_as_if_masked(arch):
    phase = noisy(reference.ramp(33, 47), 0.1)
    mask = np.random.default_rng(4).random(phase.shape) > 0.1
    expected = tikernels.smooth_phase(phase, mask)
    found = tikernels.smooth_phase(np.where(mask, phase, np.float32(np.nan)), np.ones_like(mask))
    np.testing.assert_array_equal(found[mask], expected[mask])


@pytest.mark.parametrize("shape", [(1, 1), (1, 70), (70, 1), (2, 3)])
def test_slim_images(arch, shape):
    true = reference.ramp(*shape, tilt=0.05)
    found = tikernels.smooth_phase(reference.wrapped(true), np.ones(shape, bool))
    assert np.abs(reference.wrapped_difference(found, true)).max() < 1e-5


def test_menu(menu):
    phase = noisy(reference.ramp(17, 23), 0.1)
    menu(
        lambda wrapped_phase, mask, out=None: tikernels.smooth_phase(wrapped_phase, mask, out=out),
        np.empty_like(phase),
        wrapped_phase=phase,
        mask=np.random.default_rng(5).random(phase.shape) > 0.1,
    )


@pytest.mark.parametrize("smoothing_px", [-1, 0, 4, 17])
def test_impossible_windows(arch, smoothing_px):
    with pytest.raises(tikernels.ShapeError, match=f"smoothing_px is {smoothing_px}: take an odd number from 1 to 15"):
        tikernels.smooth_phase(np.zeros((4, 4), np.float32), np.ones((4, 4), bool), smoothing_px)


def marked(phase: np.ndarray, mask: np.ndarray) -> np.ndarray:
    return np.where(mask, phase, np.float32(NO_PHASE)).astype(np.float32)


def test_whole_cycles_and_holes(arch):
    """Unwrapped phases as wrapped ones; where one was lost, or is a cycle off, its neighbours do without it."""
    true = reference.ramp(48, 60)
    seen, rng = marked(noisy(true, 0.02), np.ones((48, 60), bool)), np.random.default_rng(6)
    precision = np.full((48, 60), 2500, np.float32)
    rates = measure_rates(seen, precision)
    smoother = Smoother(48, 60, 2)
    rows = runtime.to_host(smoother.along(seen, precision, rates)).copy()
    mask = (rng.random((48, 60)) > 0.1).astype(np.uint8)
    whole = (rows + 2 * np.pi * np.rint((true - rows) / (2 * np.pi))).astype(np.float32)
    off = rng.random((48, 60)) < 0.05
    whole[off] += np.float32(2 * np.pi)
    unwrapped, variance = (np.array(runtime.to_host(a)) for a in smoother.across(whole, mask, rates))
    wrapped, _ = smoother.across(rows, mask & ~off, rates, wraps=True)
    wrapped = runtime.to_host(wrapped)
    np.testing.assert_array_equal(np.isnan(unwrapped), mask == 0)
    both = (mask != 0) & ~off
    assert np.abs(reference.wrapped_difference(unwrapped, wrapped)[both]).max() < 1e-4
    assert np.abs(unwrapped - true)[both].max() < 0.1
    assert (variance > 0).all() and (variance <= 1.001 / 2500).all()


def test_a_pixel_between_surfaces_has_only_itself(arch):
    true = reference.ramp(48, 60) + 2.4 * (np.arange(60) >= 30)
    true[:, 30] -= 1.2
    seen = marked(noisy(true, 0.02), np.ones((48, 60), bool))
    precision = np.full((48, 60), 2500, np.float32)
    rates = measure_rates(seen, precision)
    smoother = Smoother(48, 60, 3)
    rows = runtime.to_host(smoother.along(seen, precision, rates)).copy()
    assert (rows[:, 30] == STEP_PHASE).all() and (np.delete(rows, 30, axis=1) < NO_PHASE).all()
    # Should a surface claim one of them, it has its own phase, and its own variance.
    alone = np.zeros((48, 60), np.uint8)
    alone[20, 30] = 1
    smoothed, variance = smoother.across(seen, alone, rates, wraps=True)
    assert runtime.to_host(smoothed)[20, 30] == seen[20, 30]
    assert runtime.to_host(variance)[20, 30] == pytest.approx(1 / 2500)


def test_rows_count_by_how_sure_they_are(arch):
    """Every third row has five times the others' noise: they gain most, and cost their neighbours little."""
    true = reference.ramp(160, 200, 12.0)
    sigma = np.where(np.arange(160)[:, None] % 3 == 0, 0.1, 0.02)
    phase = reference.wrapped(true + sigma * np.random.default_rng(7).standard_normal(true.shape)).astype(np.float32)
    precision = np.broadcast_to(sigma**-2, phase.shape).astype(np.float32)
    smoother, rates = Smoother(160, 200, 3), measure_rates(phase, precision)
    rows = runtime.to_host(smoother.along(phase, precision, rates)).copy()
    found, variance = smoother.across(rows, (rows < 50).astype(np.uint8), rates, wraps=True)
    error = reference.wrapped_difference(runtime.to_host(found), true)[6:-6, 6:-6]
    said = np.sqrt(runtime.to_host(variance))[6:-6, 6:-6]
    for row in range(3):
        part = error[row::3][np.isfinite(error[row::3])]
        assert part.std() < 0.01
        assert 0.9 < np.sqrt(np.nanmean(said[row::3] ** 2)) / part.std() < 1.6


def test_menu_of_the_decoders_stages(menu):
    phase = marked(noisy(reference.ramp(17, 23), 0.1), np.ones((17, 23), bool))
    precision = np.full((17, 23), 400, np.float32)

    measured = np.array(runtime.to_host(measure_rates(phase, precision)))
    smoother = Smoother(17, 23, 2)

    def along(out=None, **inputs):
        found = smoother.along(**inputs, out=out)
        return runtime.to_host(found) if out is None else found

    menu(along, np.empty((17, 23), np.float32), phase=phase, precision=precision, rates=measured)
    mask = np.ones((17, 23), np.uint8)
    menu(
        lambda **inputs: runtime.to_host(smoother.across(**inputs)[0]),
        phase=phase,
        mask=mask,
        rates=measured,
    )
