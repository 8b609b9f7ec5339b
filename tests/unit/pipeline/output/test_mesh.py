"""Triangle meshes in memory."""

from typing import Any

import numpy as np
import pytest

from pipeline.output.mesh import Mesh, vertex_normals


def test_normals_of_a_plane() -> None:
    sheet = Mesh(np.array([[0, 0, 5], [1, 0, 5], [0, 1, 5], [9, 9, 9]], np.float32), np.array([[0, 1, 2]], np.int32))
    np.testing.assert_array_equal(vertex_normals(sheet), [[0, 0, 1]] * 4)


def test_a_mesh_that_has_normals_keeps_them(mesh: Mesh) -> None:
    assert vertex_normals(mesh) is mesh.normals


@pytest.mark.parametrize(
    "wrong",
    [
        {"vertices": np.zeros((3, 2), np.float32)},
        {"vertices": np.zeros((3, 3))},
        {"vertices": np.full((3, 3), np.nan, np.float32)},
        {"faces": np.array([[0, 1, 3]], np.int32)},
        {"faces": np.array([[0, 1, -1]], np.int32)},
        {"colors": np.zeros((2, 3), np.uint8)},
        {"properties": {"sigma_mm": np.zeros(2, np.float32)}},
        {"properties": {"sigma mm": np.zeros(3, np.float32)}},
        {"properties": {"x": np.zeros(3, np.float32)}},
        {"properties": {"nx": np.zeros(3, np.float32)}},
        {"properties": {"flags": np.zeros(3, np.float32)}},
        {"normals": np.zeros((3, 2), np.float32)},
        {"flags": np.zeros(3, np.int32)},
        {"unit": "m"},
    ],
)
def test_arrays_that_do_not_fit_are_refused(wrong: dict[str, Any]) -> None:
    right = {"vertices": np.zeros((3, 3), np.float32), "faces": np.array([[0, 1, 2]], np.int32)}
    with pytest.raises(ValueError, match=next(iter(wrong)).removesuffix("ies")):
        Mesh(**(right | wrong))
