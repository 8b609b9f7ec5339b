"""The quadric around a pixel, against the twin: the kernel that fits it is `fit_surface`'s."""

import numpy as np
import reference
from support.linked_pixels import all_linked

from tikernels.depth.quadric import FARTHEST, measure_runs, precision_of
from tikernels.depth.surface_fit import fit_surface

SHAPE = (30, 34)


def test_a_plane_and_a_bowl_keep_value_and_slopes(arch):
    """To what float32 leaves of 800 mm; the prior takes 0.1 % of a bend where the window is cut off."""
    y, x = np.indices(SHAPE) - 15.0
    depth = 800 + 0.3 * x - 0.2 * y + 0.004 * x * x - 0.002 * x * y + 0.003 * y * y
    mask = np.ones(SHAPE, np.uint8)
    fitted = fit_surface(depth.astype(np.float32), np.full(SHAPE, 0.05, np.float32), mask, all_linked(SHAPE))
    inside = np.s_[12:-12, 12:-12]
    np.testing.assert_allclose(fitted.depth[inside], depth[inside], atol=3e-4)
    np.testing.assert_allclose(fitted.slope[inside][..., 0], (-0.2 - 0.002 * x + 0.006 * y)[inside], atol=3e-4)
    np.testing.assert_allclose(fitted.slope[inside][..., 1], (0.3 + 0.008 * x - 0.002 * y)[inside], atol=3e-4)


def test_runs_end_at_steps_and_at_the_farthest(arch):
    links = all_linked((4, 40))
    links[:, 19] &= 2
    left, right, above, below = measure_runs(links)
    np.testing.assert_array_equal(left[0, [0, 5, 19, 20, 25, 39]], [0, 5, FARTHEST, 0, 5, FARTHEST])
    np.testing.assert_array_equal(right[0, [0, 10, 19, 20, 39]], [FARTHEST, 9, 0, FARTHEST, 0])
    np.testing.assert_array_equal(above[:, 0], [0, 1, 2, 3])
    np.testing.assert_array_equal(below[:, 0], [3, 2, 1, 0])


def test_what_does_not_count_has_no_precision(cpu):
    precision = precision_of(np.array([[0.5, 0.0]], np.float32), np.array([[1, 0]], np.uint8))
    np.testing.assert_array_equal(precision, [[4, 0]])


def test_the_twin_continues_a_slope_to_a_rim():
    """At the corner of a step the window is a quarter; a plane stays a plane."""
    y, x = np.indices(SHAPE)
    depth, links = 0.3 * x - 0.1 * y, all_linked(SHAPE)
    value, down, right, variance = reference.fit_quadric(depth, np.ones(SHAPE), np.ones(SHAPE), links, (0, 0), 2)
    assert abs(value) < 1e-3 and abs(down + 0.1) < 1e-3 and abs(right - 0.3) < 1e-3 and variance > 1
