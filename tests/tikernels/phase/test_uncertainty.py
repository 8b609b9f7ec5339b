"""Standard deviations: as NumPy computes them, and as the errors really are."""

import numpy as np
import pytest

from tikernels import runtime
from tikernels.phase.uncertainty import OFF, PARTLY, WHOLE, compare_rows, phase_sigma

SHAPE = (41, 67)
AVERAGED = 0.2  # of the variance, after smoothing over five px


def case(seed=1):
    """Return a precision and what the smoothing of each pixel rests on."""
    rng = np.random.default_rng(seed)
    precision = (1e3 + 4e3 * rng.random(SHAPE)).astype(np.float32)
    neighbours = rng.choice(np.array([OFF, PARTLY, WHOLE], np.uint8), SHAPE, p=(0.1, 0.2, 0.7))
    return precision, neighbours


def expected_sigma(precision, neighbours, empty, scatter):
    """Return the fit's sigma, of which smoothing averages all but the model's 3 %, and 0.025 rad beside nothing."""
    variance = (np.where(neighbours == WHOLE, AVERAGED, 1) + 0.03) / precision
    return np.where(neighbours == OFF, np.nan, np.sqrt(scatter**2 * variance + 0.025**2 * empty))


def test_as_the_twin(arch):
    precision, neighbours = case()
    empty = np.random.default_rng(2).random(SHAPE).astype(np.float32)
    out = phase_sigma(precision, neighbours, empty, AVERAGED, 1.3)
    expected = expected_sigma(precision, neighbours, empty, 1.3)
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
    ratio = runtime.to_host(compare_rows(phase, precision, neighbours, AVERAGED, step, every))
    assert np.isnan(ratio[:5, :3]).all() and np.isfinite(ratio[:, 3:]).all()
    assert np.median(ratio[:, 3:]) / 0.6745 == pytest.approx(1, abs=0.02)
