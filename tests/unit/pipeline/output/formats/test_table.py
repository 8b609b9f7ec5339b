"""Axes, headings and numbers as text."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.output.formats import Heading, text_rows
from pipeline.output.formats.table import OPTICAL, Y_UP, Z_UP, in_camera_frame, placed


@pytest.mark.parametrize(
    ("axes", "right", "down", "away"),
    [
        (OPTICAL, (1, 0, 0), (0, 1, 0), (0, 0, 1)),
        (Y_UP, (1, 0, 0), (0, -1, 0), (0, 0, -1)),
        (Z_UP, (1, 0, 0), (0, 0, -1), (0, 1, 0)),
    ],
)
def test_directions_are_where_the_text_says(axes, right, down, away):
    np.testing.assert_array_equal(axes.from_camera(np.eye(3)), [right, down, away])
    assert np.linalg.det(axes.from_camera(np.eye(3))) == 1  # turned, never mirrored
    np.testing.assert_array_equal(axes.to_camera(axes.from_camera(np.eye(3))), np.eye(3))
    words = axes.directions.split(", ")
    for letter, word in zip("xyz", words, strict=True):
        direction = {"right": right, "down": down, "up": np.negative(down), "away": away, "towards": np.negative(away)}
        assert word.startswith(letter)
        assert direction[word.split()[1]]["xyz".index(letter)] == 1


@pytest.mark.parametrize("axes", [OPTICAL, Y_UP, Z_UP])
def test_a_mesh_comes_back(mesh, axes):
    turned = placed(mesh, axes, 0.001)
    assert turned.vertices.dtype == np.float32 and turned.normals.dtype == np.float32
    back = in_camera_frame(turned, axes, 1000.0)
    np.testing.assert_allclose(back.vertices, mesh.vertices, rtol=1e-6)
    np.testing.assert_array_equal(back.normals, mesh.normals)
    assert placed(replace(mesh, normals=None), axes, 1.0).normals is None


def test_remarks_are_lines_with_a_mark():
    assert Heading("a", {"unit": "mm", "axes": "x right"}).comments("#") == "# unit mm\n# axes x right\n"


def test_a_table_is_a_row_a_line():
    assert text_rows("v %d %.1f\n", np.array([[1, 2.25], [3, 4]])) == "v 1 2.2\nv 3 4.0\n"
    assert text_rows("v %d\n", np.empty((0, 1))) == ""
