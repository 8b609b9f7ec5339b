"""Meshes and range images, each file read back by a reader that is not ours."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import pyvista

from pipeline.errors import FootageError, OutputError
from pipeline.output.mesh import Mesh
from pipeline.output.mesh_files import read_mesh, write_mesh

SUFFIXES = (".ply", ".wrl", ".obj", ".stl", ".glb", ".gltf")
GREY = 48


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_an_empty_mesh_is_written_where_the_format_allows(tmp_path: Path, suffix: str) -> None:
    empty = Mesh(np.empty((0, 3), np.float32), np.empty((0, 3), np.int32))
    if suffix in (".glb", ".gltf"):
        with pytest.raises(OutputError, match="empty mesh"):
            write_mesh(empty, tmp_path / f"empty{suffix}")
    else:
        write_mesh(empty, tmp_path / f"empty{suffix}")


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl"])
def test_pyvista_reads_what_we_write(tmp_path: Path, mesh: Mesh, suffix: str) -> None:
    write_mesh(mesh, tmp_path / f"mesh{suffix}")
    read = pyvista.read(tmp_path / f"mesh{suffix}")
    triangles = read.points[read.regular_faces]
    np.testing.assert_allclose(triangles, mesh.vertices[mesh.faces], rtol=1e-6)
    if suffix == ".ply":
        np.testing.assert_array_equal(read.point_data["RGB"], mesh.colors)


def test_obj_holds_colors_after_positions(tmp_path: Path, mesh: Mesh) -> None:
    write_mesh(mesh, tmp_path / "mesh.obj")
    rows = [line.split() for line in (tmp_path / "mesh.obj").read_text().splitlines()]
    vertices = np.array([row[1:] for row in rows if row[0] == "v"], float)
    np.testing.assert_allclose(vertices[:, :3], mesh.vertices, rtol=1e-6)
    np.testing.assert_array_equal((vertices[:, 3:] * 255).round(), mesh.colors)


def test_obj_names_a_normal_for_every_corner(tmp_path: Path, mesh: Mesh) -> None:
    write_mesh(mesh, tmp_path / "mesh.obj")
    read = pyvista.read(tmp_path / "mesh.obj")
    np.testing.assert_allclose(read.point_data["Normals"], mesh.normals, atol=1e-4)
    write_mesh(replace(mesh, normals=None), tmp_path / "bare.obj")
    assert "vn" not in (tmp_path / "bare.obj").read_text()
    np.testing.assert_array_equal(pyvista.read(tmp_path / "bare.obj").regular_faces, read.regular_faces)


def test_stl_has_unit_normals(tmp_path: Path, mesh: Mesh) -> None:
    write_mesh(mesh, tmp_path / "mesh.stl")
    data = (tmp_path / "mesh.stl").read_bytes()
    assert len(data) == 84 + 50 * len(mesh.faces)
    assert not data.startswith(b"solid"), "readers take that for text"
    normals = np.frombuffer(data, np.dtype([("normal", "<f4", 3), ("rest", "V38")]), offset=84)["normal"]
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, rtol=1e-5)


def test_vrml_lists_points_colors_and_faces(tmp_path: Path, mesh: Mesh) -> None:
    write_mesh(mesh, tmp_path / "mesh.wrl")
    text = (tmp_path / "mesh.wrl").read_text()
    assert text.startswith("#VRML V2.0 utf8\n")
    assert text.count("{") == text.count("}")
    assert "rotation 1 0 0 3.14159265\nscale 0.001 0.001 0.001" in text

    def table(name: str, width: int) -> np.ndarray:
        return np.array(text.split(f"{name} [")[1].split("]")[0].replace(",", " ").split(), float).reshape(-1, width)

    np.testing.assert_allclose(table("point", 3), mesh.vertices, rtol=1e-6)
    np.testing.assert_array_equal((table("color", 3) * 255).round(), mesh.colors)
    np.testing.assert_array_equal(table("coordIndex", 4), np.pad(mesh.faces, ((0, 0), (0, 1)), constant_values=-1))


def test_a_missing_mesh_is_named(tmp_path: Path) -> None:
    with pytest.raises(FootageError, match=r"none\.ply: No such file"):
        read_mesh(tmp_path / "none.ply")


def test_an_unknown_suffix_names_the_known_ones(tmp_path: Path, mesh: Mesh) -> None:
    with pytest.raises(OutputError, match=r"'\.xyz', use one of \.ply, \.wrl, \.obj, \.stl, \.glb, \.gltf"):
        write_mesh(mesh, tmp_path / "mesh.xyz")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_folder_that_cannot_hold_it(tmp_path: Path, mesh: Mesh, suffix: str) -> None:
    with pytest.raises(OutputError, match="folder does not exist"):
        write_mesh(mesh, tmp_path / "none" / f"mesh{suffix}")
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(OutputError, match="folder"):
        write_mesh(mesh, tmp_path / "file" / f"mesh{suffix}")
    (tmp_path / f"mesh{suffix}").mkdir()
    with pytest.raises(OutputError, match="folder"):
        write_mesh(mesh, tmp_path / f"mesh{suffix}")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", f"mesh{suffix}"]
