"""Outliers do not move it."""

import numpy as np
import pytest

from pipeline.robust import robust_sigma


def test_a_tenth_of_outliers_widens_it_by_less_than_a_fifth():
    residuals = np.random.default_rng(0).normal(0, 0.3, 20000)
    assert robust_sigma(residuals) == pytest.approx(0.3, rel=0.02)
    residuals[::10] = 1e6
    assert 0.3 < robust_sigma(residuals) < 0.36
