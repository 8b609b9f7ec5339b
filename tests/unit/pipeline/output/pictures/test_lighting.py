"""Light on a surface."""

import numpy as np

from pipeline.output.pictures.viewpoint import CLAY, Viewpoint, lit_colors

EYE = Viewpoint(position=(0, 0, 0), focal_point=(0, 0, 100))
PLACES = np.array([[0, 0, 100]] * 3, np.float32)


def normals(*directions):
    return np.array([np.array(d) / np.linalg.norm(d) for d in directions], np.float32)


def test_light_comes_from_the_upper_left():
    lit = lit_colors(PLACES, normals((-0.5, -0.5, -1), (0, 0, -1), (0.5, 0.5, -1)), CLAY.astype(np.uint8), EYE)
    assert lit[0, 0] > lit[1, 0] > lit[2, 0] > 40
    assert lit.max() <= 255


def test_the_back_of_a_surface_is_lit_as_its_front():
    directions = normals((-0.5, -0.5, -1), (0, 0, -1), (0.5, 0.5, -1))
    clay = CLAY.astype(np.uint8)
    np.testing.assert_allclose(lit_colors(PLACES, -directions, clay, EYE), lit_colors(PLACES, directions, clay, EYE))


def test_colours_that_mean_something_stay_themselves():
    colors = np.array([[200, 20, 20], [20, 200, 20], [20, 20, 200]], np.uint8)
    lit = lit_colors(PLACES, normals(*3 * [(0.4, 0.6, -1)]), colors, EYE)
    assert (lit.argmax(axis=1) == [0, 1, 2]).all()
    assert lit.max(axis=1).min() > 110
