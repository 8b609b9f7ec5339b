"""Meshes as VRML, and back."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.errors import FootageError
from pipeline.output.mesh_files import read_mesh, write_mesh


def test_vrml_lists_points_colors_and_faces(tmp_path, mesh):
    write_mesh(mesh, tmp_path / "mesh.wrl")
    text = (tmp_path / "mesh.wrl").read_text()
    assert text.startswith("#VRML V2.0 utf8\n")
    assert text.count("{") == text.count("}")

    def table(name, width):
        return np.array(text.split(f"{name} [")[1].split("]")[0].replace(",", " ").split(), float).reshape(-1, width)

    np.testing.assert_allclose(table("point", 3), mesh.vertices * (1e-3, -1e-3, -1e-3), rtol=1e-6)
    np.testing.assert_array_equal((table("color", 3) * 255).round(), mesh.colors)
    np.testing.assert_array_equal(table("coordIndex", 4), np.pad(mesh.faces, ((0, 0), (0, 1)), constant_values=-1))


@pytest.mark.parametrize("unit", ["mm", "rad"])
def test_a_mesh_comes_back(tmp_path, mesh, unit):
    write_mesh(replace(mesh, unit=unit, provenance={"frame": "7", "source": "a # b"}), tmp_path / "mesh.wrl")
    read = read_mesh(tmp_path / "mesh.wrl")
    np.testing.assert_allclose(read.vertices, mesh.vertices, rtol=1e-5)
    np.testing.assert_array_equal(read.faces, mesh.faces)
    np.testing.assert_array_equal(read.colors, mesh.colors)
    assert read.unit == unit and read.provenance["frame"] == "7" and read.provenance["source"] == "a # b"


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("#VRML V2.0", "#VRML V1.0", "does not begin"),
        ("]\n}\n}\n", "", "truncated"),
        ("Shape {", "Transform { } Shape {", "it holds Transform"),
        ("IndexedFaceSet", "IndexedLineSet", "less than one IndexedFaceSet"),
        ("coordIndex", "normalIndex", "no points or no faces"),
        ("0,2,1,-1", "0,2,1,3,-1", "whole number of rows"),
        ("0,2,1,-1", "0,2,1,3", "other than triangles"),
        ("0,2,1,-1", "0,2,99,-1", "corners|vertices"),
        ("0,2,1,-1", "0,2,one,-1", "could not convert"),
        ("color [\n", "color [\n2 0 0,\n", "its colours"),
    ],
)
def test_what_is_wrong_is_said(tmp_path, mesh, old, new, said):
    path = tmp_path / "mesh.wrl"
    write_mesh(mesh, path)
    text = path.read_text()
    first = ",".join(map(str, mesh.faces[0])) + ",-1"
    damaged = text.replace(old.replace("0,2,1,-1", first), new.replace("0,2,1", first.removesuffix(",-1")), 1)
    assert damaged != text
    path.write_text(damaged)
    with pytest.raises(FootageError, match=said) as caught:
        read_mesh(path)
    assert "\n" not in str(caught.value)
