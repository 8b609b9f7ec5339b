"""Distances from a mesh, by the library that draws; it needs no graphics for that."""

import numpy as np
import pytest
from support.drawn_surfaces import dome

from pipeline.errors import RenderError
from pipeline.output.mesh import Mesh
from pipeline.output.pictures.color_meaning import distance_from


def test_the_distance_from_a_ball_is_positive_outside():
    directions = np.random.default_rng(0).normal((0, 0, -4), 1, (200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for radius in (49.0, 50.0, 52.0):
        points = ((0, 0, 400) + radius * directions).astype(np.float32)
        np.testing.assert_allclose(distance_from(dome())(points), radius - 50, atol=0.03)  # its triangles' sagitta


def test_what_has_no_distance():
    for mesh in (dome("rad"), Mesh(dome().vertices, np.empty((0, 3), np.int32))):
        with pytest.raises(RenderError, match="--compare needs a mesh of triangles in mm"):
            distance_from(mesh)
