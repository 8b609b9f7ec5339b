"""Meshes as OBJ, with and without normals, colours and a texture."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import pyvista
from support.tilted_sheets import tilted_grid, tilted_mesh

from pipeline.output.mesh_files import write_mesh


def test_colors_follow_positions(tmp_path, mesh):
    write_mesh(mesh, tmp_path / "mesh.obj")
    rows = [line.split() for line in (tmp_path / "mesh.obj").read_text().splitlines()]
    vertices = np.array([row[1:] for row in rows if row[0] == "v"], float)
    np.testing.assert_allclose(vertices[:, :3], mesh.vertices * (1, -1, -1), rtol=1e-6)
    np.testing.assert_array_equal((vertices[:, 3:] * 255).round(), mesh.colors)


def test_a_corner_names_its_normal(tmp_path, mesh):
    write_mesh(mesh, tmp_path / "mesh.obj")
    read = pyvista.read(tmp_path / "mesh.obj")
    np.testing.assert_allclose(read.point_data["Normals"], mesh.normals * (1, -1, -1), atol=1e-4)
    write_mesh(replace(mesh, normals=None), tmp_path / "bare.obj")
    assert "vn" not in (tmp_path / "bare.obj").read_text()
    np.testing.assert_array_equal(pyvista.read(tmp_path / "bare.obj").regular_faces, read.regular_faces)


@pytest.mark.parametrize("with_normals", [True, False])
def test_a_texture_is_a_picture_beside_it(cpu, tmp_path, with_normals):
    mesh = tilted_mesh()
    write_mesh(mesh if with_normals else replace(mesh, normals=None), tmp_path / "face.OBJ")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["face.OBJ", "face.mtl", "face.png"]
    text = (tmp_path / "face.OBJ").read_text()
    assert "mtllib face.mtl\n" in text and "map_Kd face.png" in (tmp_path / "face.mtl").read_text()
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "face.png"))[..., ::-1], tilted_grid().texture)
    corner = "1/1/1" if with_normals else "1/1"
    assert f"\nf {corner} " in text or f" {corner}\n" in text
