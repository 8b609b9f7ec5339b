"""Outliers do not move them, and noise leaves no bias."""

import numpy as np
import pytest

from pipeline.robust import fit_sphere, robust_sigma


def test_a_tenth_of_outliers_widens_it_by_less_than_a_fifth():
    residuals = np.random.default_rng(0).normal(0, 0.3, 20000)
    assert robust_sigma(residuals) == pytest.approx(0.3, rel=0.02)
    residuals[::10] = 1e6
    assert 0.3 < robust_sigma(residuals) < 0.36


def test_a_cap_of_a_ball_has_its_radius_in_spite_of_noise_and_outliers():
    """Least squares of squared distances would find it too small by nine tenths of a millimetre."""
    rng = np.random.default_rng(0)
    z = rng.uniform(0.6, 1, 40000)
    around = rng.uniform(0, 2 * np.pi, z.size)
    ways = np.stack([*(np.sqrt(1 - z * z) * (np.cos(around), np.sin(around))), z], axis=1)
    points = (30 + rng.normal(0, 0.5, z.size))[:, None] * ways
    points[::20] += rng.uniform(5, 20, (2000, 3))
    centre, radius = fit_sphere(points + np.array([10, -20, 900]))
    assert radius == pytest.approx(30, abs=0.05) and centre == pytest.approx([10, -20, 900], abs=0.05)
