"""Standard deviations: as NumPy computes them, and as the errors really are."""

import numpy as np
import pytest
import reference

from tikernels import ShapeError, runtime
from tikernels.phase.uncertainty import OFF, PARTLY, WHOLE, compare_rows, estimate_phase_sigma, phase_sigma

SHAPE = (41, 67)
AVERAGED = 0.2  # of the variance, after smoothing over five px
NO_ERROR = np.zeros((30, 25), np.float32)  # by node, 8 px apart


def case(seed=1):
    """Return a precision and what the smoothing of each pixel rests on."""
    rng = np.random.default_rng(seed)
    precision = (1e3 + 4e3 * rng.random(SHAPE)).astype(np.float32)
    neighbours = rng.choice(np.array([OFF, PARTLY, WHOLE], np.uint8), SHAPE, p=(0.1, 0.2, 0.7))
    return precision, neighbours


def expected_sigma(precision, neighbours, empty, scatter, error=0.0):
    """Return the fit's sigma, of which smoothing averages all but the model's 3 %, and 0.025 rad beside nothing."""
    variance = (np.where(neighbours == WHOLE, AVERAGED, 1) + 0.03) / precision + error
    return np.where(neighbours == OFF, np.nan, np.sqrt(scatter**2 * variance + 0.025**2 * empty))


def test_as_the_twin(arch):
    precision, neighbours = case()
    empty = np.random.default_rng(2).random(SHAPE).astype(np.float32)
    error = (1e-4 * np.random.default_rng(5).random(SHAPE)).astype(np.float32)
    out = phase_sigma(precision, error, neighbours, empty, AVERAGED, 1.3)
    expected = expected_sigma(precision, neighbours, empty, 1.3, error)
    np.testing.assert_allclose(runtime.to_host(out), expected, rtol=1e-5)


def test_rows_that_differ_by_what_is_expected_have_a_ratio_of_one(arch):
    """Of a bent surface with that noise; the median of a normal distribution's size is 0.6745 sigma."""
    height, width = 400, 300
    precision, neighbours = np.full((height, width), 2500, np.float32), np.full((height, width), WHOLE, np.uint8)
    neighbours[:5, :7] = OFF
    sigma = expected_sigma(precision, neighbours, np.float32(0), 1)
    rows = np.arange(height)[:, None]
    noise = sigma * np.random.default_rng(3).standard_normal((height, width))
    phase = (0.1 * rows + 1e-4 * rows**2 + noise).astype(np.float32)
    step, every = 4, 3
    ratio = runtime.to_host(compare_rows(phase, precision, np.zeros_like(phase), neighbours, AVERAGED, step, every))
    assert np.isnan(ratio[:5, :3]).all() and np.isfinite(ratio[:, 3:]).all()
    assert np.median(ratio[:, 3:]) / 0.6745 == pytest.approx(1, abs=0.02)


@pytest.mark.parametrize("overrated", [1.0, 2.0])
def test_the_estimate_is_what_rows_really_differ_by(arch, overrated):
    """Of a plane with smoothed noise, to 5 %, whether the fit's precision is right or half as good as it says."""
    height, width, pairs, period_px = 240, 200, 2, 12.0
    noise = np.random.default_rng(4).standard_normal((height, width + 2 * pairs)) * 0.05
    smoothed = np.stack([noise[:, k : width + k] for k in range(2 * pairs + 1)]).mean(axis=0)
    phase = (reference.ramp(height, width, period_px, tilt=0.02) + smoothed).astype(np.float32)
    mask = np.ones((height, width), bool)
    mask[100:110, 50:60] = False
    phase[~mask] = np.nan
    precision = np.full((height, width), overrated**2 / 0.05**2, np.float32)
    sigma = runtime.to_host(estimate_phase_sigma(phase, precision, NO_ERROR, 8, mask, pairs, period_px))
    assert np.isnan(sigma[~mask]).all() and np.isfinite(sigma[mask]).all()
    assert np.median(sigma[mask]) == pytest.approx(smoothed.std(), rel=0.05)
    # Beside the hole fewer neighbours are averaged, and part of the model's window is empty.
    assert sigma[105, 49] > 1.5 * np.median(sigma[mask])


def test_an_error_of_the_model_widens_the_pixels_around_its_node(arch):
    """Smoothing does not average it."""
    height, width = 120, 160
    phase = reference.ramp(height, width, 12.0, tilt=0.02).astype(np.float32)
    noise = 0.02 * np.random.default_rng(6).standard_normal(phase.shape)
    phase, precision = (phase + noise).astype(np.float32), np.full(phase.shape, 1 / 0.02**2, np.float32)
    error = np.zeros((15, 20), np.float32)
    error[9:13, 15:18] = 0.1**2
    sigma = runtime.to_host(estimate_phase_sigma(phase, precision, error, 8, np.ones(phase.shape, bool), 0, 12.0))
    assert np.median(sigma[20:50, 20:80]) == pytest.approx(0.02, rel=0.1)
    assert np.median(sigma[80:96, 128:136]) == pytest.approx(0.1, rel=0.1)


def test_menu(menu):
    precision, neighbours = case()
    empty = np.random.default_rng(2).random(SHAPE).astype(np.float32)

    def measure(out=None, **inputs):
        found = phase_sigma(**inputs, averaged=AVERAGED, scatter=1.3, out=out)
        return runtime.to_host(found) if out is None else found

    fields = {"precision": precision, "error": 1e-4 * empty, "neighbours": neighbours, "empty": empty}
    menu(measure, np.empty(SHAPE, np.float32), **fields)


def test_too_few_rows_to_compare(arch):
    flat = np.ones((12, 5), np.float32)
    with pytest.raises(ShapeError, match="phase has 12 rows: four rows 4 px apart need 13"):
        compare_rows(flat, flat, flat, np.full((12, 5), WHOLE, np.uint8), AVERAGED, 4, 1)
