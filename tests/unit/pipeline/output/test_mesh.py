"""Meshes, grids and what they say of how they were made."""

import json
from typing import Any

import numpy as np
import pytest
from support.tilted_sheets import BLUE, HEIGHT, RED, WIDTH, tilted_grid

from pipeline.output.mesh import Mesh, RangeGrid, provenance_of, vertex_normals

ATTRIBUTES = {
    "colorphase_version": "1.2",
    "settings": {"stripes": "vertical", "code": None},
    "calibration_sha256": "ab",
}


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


def test_records_are_in_metres_with_packed_colors():
    records = tilted_grid().records()
    assert records.shape == (HEIGHT, WIDTH) and records.dtype.names == ("x", "y", "z", "rgb", "sigma_mm")
    np.testing.assert_allclose(records["z"], tilted_grid().depth / 1000, rtol=1e-6)
    packed = np.ascontiguousarray(records["rgb"]).view(np.uint32)
    assert packed[0, 0] == RED[0] << 16 | RED[1] << 8 | RED[2]
    assert packed[-1, 0] == BLUE[0] << 16 | BLUE[1] << 8 | BLUE[2]


def test_records_of_others_become_a_grid_again():
    """Of numbers of any kind, in any order, with gaps; what lies behind the camera, or nowhere, is none."""
    grid = tilted_grid()
    layout = np.dtype(
        {
            "names": ["intensity", "z", "y", "x", "rgba", "_"],
            "formats": ["u1", ">f8", ">f8", ">f8", "<u4", "u1"],
            "offsets": [0, 8, 16, 24, 40, 3],
            "itemsize": 48,
        }
    )
    records = np.zeros((HEIGHT, WIDTH), layout)
    for axis, name in enumerate("xyz"):
        records[name] = grid.points[..., axis] / 1000.0
    records["intensity"], records["rgba"] = 7, 0xFF000000 | RED[0] << 16 | RED[1] << 8 | RED[2]
    records["z"][0, 0], records["x"][0, 1] = -0.5, np.inf
    read = RangeGrid.of_records(records)
    expected = grid.points.copy()
    expected[0, :2] = np.nan
    np.testing.assert_allclose(read.points, expected, rtol=1e-6)
    assert (read.texture == RED).all() and read.properties.keys() == {"intensity"}
    assert (read.properties["intensity"] == 7).all()
    for wrong in (records[:1], records[["x", "y", "rgba"]]):
        with pytest.raises(ValueError, match=r"points are no grid|no x, y and z"):
            RangeGrid.of_records(wrong)


def test_a_frame_of_footage():
    said = provenance_of({**ATTRIBUTES, "footage": {"name": "film.mkv"}}, 12, 0.5)
    assert json.loads(said.pop("settings")) == {"stripes": "vertical"}
    assert said == {
        "software": "colorphase 1.2",
        "source": "film.mkv",
        "frame": "12",
        "time_s": "0.500000",
        "calibration_sha256": "ab",
    }


def test_a_picture_without_a_calibration():
    said = provenance_of({**ATTRIBUTES, "source": "a\r\n\u2028b\udcfc.png", "calibration_sha256": None})
    assert said.keys() == {"software", "source", "settings"}
    assert said["source"] == "a   b?.png"  # one line of text each: it becomes a comment
