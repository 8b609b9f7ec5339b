"""Fewer triangles that tell the same."""

import numpy as np
import pytest

from pipeline.output.mesh import FILLED, SMOOTHED, Mesh
from pipeline.output.surface_mesh import decimate_mesh


def bowl(side=60):
    """Return a bowl, 0.5 mm a pixel, with a number, a normal and flags a vertex."""
    y, x = np.indices((side, side), np.float32) * np.float32(0.5)
    depth = 700 + 0.01 * ((x - 15) ** 2 + (y - 15) ** 2)
    vertices = np.stack([x, y, depth], axis=-1).reshape(-1, 3).astype(np.float32)
    first = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    faces = np.concatenate([first[:, None] + (0, side, 1), first[:, None] + (1, side, side + 1)]).astype(np.int32)
    flags = np.where(np.arange(side**2) % 7, SMOOTHED, SMOOTHED | FILLED).astype(np.uint8)
    numbers = np.arange(side**2, dtype=np.float32)
    return Mesh(vertices, faces, None, {"number": numbers}, normals=vertices / 700, flags=flags)


@pytest.mark.parametrize("budget", [3000, 300, 40])
def test_the_budget_is_kept_and_no_vertex_moves(budget):
    mesh = bowl()
    fewer = decimate_mesh(mesh, budget)
    assert 0.5 * budget < len(fewer.faces) <= budget
    kept = fewer.properties["number"].astype(int)
    assert len(set(kept)) == len(kept) == len(np.unique(fewer.faces))
    np.testing.assert_array_equal(fewer.vertices, mesh.vertices[kept])
    np.testing.assert_array_equal(fewer.normals, mesh.normals[kept])
    np.testing.assert_array_equal(fewer.flags, mesh.flags[kept])


def test_a_tenth_of_the_triangles_are_off_by_microns():
    """The bowl's sagitta over 2 mm, the longest edges then, is 0.01 mm."""
    fewer = decimate_mesh(bowl(), 700)
    x, y, z = fewer.vertices[fewer.faces].mean(axis=1).T
    assert np.abs(z - 700 - 0.01 * ((x - 15) ** 2 + (y - 15) ** 2)).max() < 0.1


def test_a_mesh_within_its_budget_stays_itself():
    mesh = bowl(4)
    assert decimate_mesh(mesh, 18) is mesh


@pytest.mark.parametrize("budget", [1, 3])
def test_a_budget_that_leaves_no_surface_is_kept_too(budget):
    assert len(decimate_mesh(bowl(), budget).faces) == budget


def test_no_triangles_are_no_budget():
    with pytest.raises(ValueError, match="max_triangles: got 0, expected 1 or more"):
        decimate_mesh(bowl(4), 0)
