"""Planes and spheres, and how far points are from them."""

import numpy as np
import pytest

from pipeline.errors import RenderError
from pipeline.output.pictures.color_meaning import plane_deviation, sphere_deviation

RNG = np.random.default_rng(1)


def test_a_plane_with_outliers():
    x, y = RNG.uniform(-50, 50, (2, 2000))
    points = np.stack([x, y, 600 + 0.3 * x - 0.1 * y + RNG.normal(0, 0.02, 2000)], axis=1)
    points[:100, 2] -= 40
    deviation = plane_deviation(points, points)
    assert np.std(deviation[100:]) == pytest.approx(0.02 / np.sqrt(1 + 0.09 + 0.01), rel=0.1)
    # Nearer to the camera is above 0.
    assert deviation[:100].mean() == pytest.approx(40 / np.sqrt(1.1), rel=0.01)


def test_a_part_of_a_sphere_with_outliers():
    directions = RNG.normal((0, 0, -3), 1, (2000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    points = (10, 20, 700) + directions * (50 + RNG.normal(0, 0.01, (2000, 1)))
    points[:60] += (0, 0, 30)
    deviation = sphere_deviation(points, points)
    assert abs(deviation[60:].mean()) < 0.003 and np.std(deviation[60:]) == pytest.approx(0.01, rel=0.1)
    middle = np.array([[10, 20, 700 - 51.0]])
    assert sphere_deviation(points, middle) == pytest.approx(1, abs=0.01), "outside is above 0"


def test_too_few_or_flat():
    with pytest.raises(RenderError, match="a plane cannot be fitted to 2 points: use other colours"):
        plane_deviation(np.zeros((2, 3)), np.zeros((2, 3)))
    flat = np.array([[0, 0, 5], [1, 0, 5], [0, 1, 5], [1, 1, 5], [2, 1, 5.0]])
    with pytest.raises(RenderError, match="the surface is flat"):
        sphere_deviation(flat, flat)
