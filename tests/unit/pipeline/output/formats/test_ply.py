"""Meshes as PLY, ours and other programs'."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista
from support.same_meshes import assert_same, plain

from pipeline.errors import FootageError
from pipeline.output.mesh import Mesh
from pipeline.output.mesh_files import read_mesh, write_mesh


@pytest.mark.parametrize("unit", ["mm", "rad"])
def test_ply_brings_everything_back(tmp_path: Path, mesh: Mesh, unit: Any) -> None:
    path = tmp_path / "Mädchen.ply"
    for written in (replace(mesh, unit=unit), plain(mesh)):
        write_mesh(written, path)
        assert_same(read_mesh(path), written)


def test_normals_and_flags_have_the_names_that_programs_look_for(tmp_path: Path, mesh: Mesh) -> None:
    write_mesh(mesh, tmp_path / "mesh.ply")
    head = (tmp_path / "mesh.ply").read_bytes().partition(b"end_header")[0].decode().splitlines()
    assert [f"property float n{axis}" for axis in "xyz"] == [
        line for line in head if line.startswith("property float n")
    ]
    assert "property uchar flags" in head and "comment flags 0 measured, 1 smoothed, 2 filled, 6 moved to a rim" in head
    np.testing.assert_allclose(pyvista.read(tmp_path / "mesh.ply").point_data["Normals"], mesh.normals * (1, -1, -1))


def test_ply_of_an_empty_mesh(tmp_path: Path) -> None:
    empty = Mesh(np.empty((0, 3), np.float32), np.empty((0, 3), np.int32))
    write_mesh(empty, tmp_path / "empty.ply")
    assert_same(read_mesh(tmp_path / "empty.ply"), empty)


@pytest.mark.parametrize("binary", [True, False])
def test_other_programs_ply_is_read(tmp_path: Path, mesh: Mesh, binary: bool) -> None:
    other = pyvista.PolyData.from_regular_faces(mesh.vertices * np.float32((1, -1, -1)), mesh.faces)  # y up
    other["RGB"] = mesh.colors
    other.save(tmp_path / "other.ply", binary=binary, texture="RGB")
    read = read_mesh(tmp_path / "other.ply")
    np.testing.assert_allclose(read.vertices, mesh.vertices, rtol=1e-5)
    np.testing.assert_array_equal(read.faces, mesh.faces)
    np.testing.assert_array_equal(read.colors, mesh.colors)
    assert read.unit == "mm"


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "header"),
        (b"\x89PNG\r\n", "header"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nend_header\n", "no x, y and z"),
        (b"ply\nformat ascii 1.0\nelement face 1\nend_header\n", "does not announce vertices"),
        (b"ply\nformat ascii 1.0\nelement vertex -1\nend_header\n", "element vertex -1"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float x\n end_header\n", "'x' twice"),
        (
            b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
            b"element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n3 0 0 1\n",
            "0 to 1 of 1 vertices",
        ),
    ],
)
def test_what_is_no_mesh_is_refused_in_one_line(tmp_path: Path, content: bytes, reason: str) -> None:
    path = tmp_path / "broken.ply"
    path.write_bytes(content)
    with pytest.raises(FootageError, match=reason) as caught:
        read_mesh(path)
    assert "\n" not in str(caught.value)


def ascii_ply(vertex: str = "0 0 0 1 2 3", face: str = "3 0 0 0", n_vertices: int = 1) -> bytes:
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "red", "green", "blue"))
    return (
        f"ply\nformat ascii 1.0\nelement vertex {n_vertices}\n{names}element face 1\n"
        f"property list uchar uint vertex_indices\nend_header\n{vertex}\n{face}\n"
    ).encode()


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (ascii_ply(face="3 0 0 4294967296"), "corners are not whole numbers from 0 to 2147483647"),
        (ascii_ply(face="3 0 0 nan"), "corners are not whole"),
        (ascii_ply(face="3 0 0 0.5"), "corners are not whole"),
        (ascii_ply(vertex="0 0 0 1 2 300"), "colours are not whole numbers from 0 to 255"),
        (ascii_ply(vertex="1e300 0 0 1 2 3"), "some are not finite"),
        (ascii_ply(n_vertices=10**17), "set COLORPHASE_MAX_PIXELS to a larger number"),
        (ascii_ply(n_vertices=10**4000), "its header has 'element vertex 1000"),
        (b"ply\nformat ascii 1.0\n" + b"comment\n" * 10_000 + ascii_ply()[21:], "its header has no end"),
    ],
)
def test_numbers_that_no_mesh_holds_are_not_cut_to_fit(tmp_path: Path, content: bytes, reason: str) -> None:
    path = tmp_path / "broken.ply"
    path.write_bytes(ascii_ply())
    assert len(read_mesh(path).vertices) == 1
    path.write_bytes(content)
    with pytest.raises(FootageError, match=reason) as caught:
        read_mesh(path)
    assert "\n" not in str(caught.value)


def test_a_ply_cut_anywhere_is_refused(tmp_path: Path, mesh: Mesh) -> None:
    path = tmp_path / "mesh.ply"
    write_mesh(mesh, path)
    whole = path.read_bytes()
    for length in range(0, len(whole), 7):
        path.write_bytes(whole[:length])
        with pytest.raises(FootageError):
            read_mesh(path)
