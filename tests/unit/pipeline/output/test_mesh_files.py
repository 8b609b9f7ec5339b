"""Meshes to files, by their suffix; `formats/test_table.py` has other programs read them."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.errors import FootageError, OutputError
from pipeline.output.mesh import Mesh
from pipeline.output.mesh_files import read_mesh, write_mesh

SUFFIXES = (".ply", ".wrl", ".obj", ".stl", ".glb")
GREY = 48


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_an_empty_mesh_is_written_where_the_format_allows(tmp_path: Path, suffix: str) -> None:
    empty = Mesh(np.empty((0, 3), np.float32), np.empty((0, 3), np.int32))
    if suffix == ".glb":
        with pytest.raises(OutputError, match="empty mesh"):
            write_mesh(empty, tmp_path / f"empty{suffix}")
    else:
        write_mesh(empty, tmp_path / f"empty{suffix}")


def test_a_missing_mesh_is_named(tmp_path: Path) -> None:
    with pytest.raises(FootageError, match=r"none\.ply: No such file"):
        read_mesh(tmp_path / "none.ply")


@pytest.mark.parametrize("kind", ["xyz", "csv", "npz"])
def test_points_alone_are_no_surface(tmp_path: Path, kind: str) -> None:
    (tmp_path / f"points.{kind}").write_bytes(b"1 2 3")
    with pytest.raises(FootageError, match=rf"\({kind.upper()}\): it holds points alone: give a mesh"):
        read_mesh(tmp_path / f"points.{kind}")


def test_an_unknown_suffix_names_the_known_ones(tmp_path: Path, mesh: Mesh) -> None:
    with pytest.raises(OutputError, match=r"is no format of meshes, use \.ply, \.obj, \.stl, \.glb, \.wrl"):
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
