"""Meshes and range images, each file read back by a reader that is not ours."""

import base64
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista

from pipeline.errors import FootageError, OutputError
from pipeline.output.mesh import Mesh
from pipeline.output.mesh_files import read_mesh, write_mesh

SUFFIXES = (".ply", ".wrl", ".obj", ".stl", ".glb", ".gltf")
GREY = 48


@pytest.fixture
def mesh() -> Mesh:
    """Return a bumpy 5 x 4 sheet some 700 mm before the camera."""
    rng = np.random.default_rng(3)
    row, column = np.mgrid[:4, :5]
    vertices = np.stack([column * 2.5, row * 2.0, 700 + rng.normal(0, 1, row.shape)], axis=-1).reshape(-1, 3)
    first = (row * 5 + column)[:-1, :-1].ravel()
    faces = np.concatenate([first[:, None] + (0, 5, 1), first[:, None] + (1, 5, 6)])
    return Mesh(
        vertices.astype(np.float32),
        faces.astype(np.int32),
        colors=rng.integers(0, 256, (20, 3), np.uint8),
        properties={name: rng.random(20, np.float32) for name in ("sigma_mm", "modulation")},
    )


def plain(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices, mesh.faces)


def assert_same(got: Mesh, expected: Mesh) -> None:
    np.testing.assert_array_equal(got.vertices, expected.vertices)
    np.testing.assert_array_equal(got.faces, expected.faces)
    assert got.unit == expected.unit
    assert got.properties.keys() == expected.properties.keys()
    for name, values in expected.properties.items():
        np.testing.assert_array_equal(got.properties[name], values)
    if expected.colors is None:
        assert got.colors is None
    else:
        np.testing.assert_array_equal(got.colors, expected.colors)


@pytest.mark.parametrize("unit", ["mm", "rad"])
def test_ply_brings_everything_back(tmp_path: Path, mesh: Mesh, unit: Any) -> None:
    path = tmp_path / "Mädchen.ply"
    for written in (Mesh(mesh.vertices, mesh.faces, mesh.colors, mesh.properties, unit), plain(mesh)):
        write_mesh(written, path)
        assert_same(read_mesh(path), written)


def test_ply_of_an_empty_mesh(tmp_path: Path) -> None:
    empty = Mesh(np.empty((0, 3), np.float32), np.empty((0, 3), np.int32))
    write_mesh(empty, tmp_path / "empty.ply")
    assert_same(read_mesh(tmp_path / "empty.ply"), empty)


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


def load_gltf(path: Path) -> tuple[dict[str, Any], bytes]:
    data = path.read_bytes()
    if path.suffix == ".gltf":
        scene = json.loads(data)
        return scene, base64.b64decode(scene["buffers"][0]["uri"].split(",")[1])
    magic, version, length, text_length, kind = struct.unpack_from("<4sII I4s", data)
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    buffer_length, kind = struct.unpack_from("<I4s", data, 20 + text_length)
    assert (kind, 28 + text_length + buffer_length) == (b"BIN\0", len(data))
    assert text_length % 4 == buffer_length % 4 == 0
    return json.loads(data[20 : 20 + text_length]), data[28 + text_length :]


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_gltf_is_y_up_and_in_metres(tmp_path: Path, mesh: Mesh, suffix: str) -> None:
    path = tmp_path / f"mesh{suffix}"
    write_mesh(mesh, path)
    scene, buffer = load_gltf(path)
    assert scene["buffers"][0]["byteLength"] == len(buffer)

    def table(index: int) -> np.ndarray:
        accessor = scene["accessors"][index]
        view = scene["bufferViews"][accessor["bufferView"]]
        dtype = {5126: "<f4", 5123: "<u2", 5125: "<u4"}[accessor["componentType"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        assert view["byteLength"] == accessor["count"] * width * np.dtype(dtype).itemsize
        return np.frombuffer(buffer, dtype, accessor["count"] * width, view["byteOffset"]).reshape(-1, width)

    (primitive,) = scene["meshes"][0]["primitives"]
    attributes = primitive["attributes"]
    positions = table(attributes["POSITION"])
    np.testing.assert_allclose(positions, mesh.vertices * (1e-3, -1e-3, -1e-3), rtol=1e-6)
    np.testing.assert_array_equal(table(primitive["indices"]).reshape(-1, 3), mesh.faces)
    np.testing.assert_allclose(np.linalg.norm(table(attributes["NORMAL"]), axis=1), 1, rtol=1e-5)
    bounds = scene["accessors"][attributes["POSITION"]]
    np.testing.assert_array_equal(np.float32(bounds["min"]), positions.min(axis=0))
    np.testing.assert_array_equal(np.float32(bounds["max"]), positions.max(axis=0))
    colors = table(attributes["COLOR_0"]) / 65535
    assert scene["accessors"][attributes["COLOR_0"]]["normalized"]
    assert (colors[:, 3] == 1).all()
    srgb = np.where(colors <= 0.0031308, colors * 12.92, 1.055 * colors ** (1 / 2.4) - 0.055)[:, :3]
    np.testing.assert_array_equal((srgb * 255).round(), mesh.colors)  # back from linear light


def test_gltf_never_calls_radians_metres(tmp_path: Path, mesh: Mesh) -> None:
    write_mesh(Mesh(mesh.vertices, mesh.faces, unit="rad"), tmp_path / "mesh.glb")
    scene, _ = load_gltf(tmp_path / "mesh.glb")
    assert scene["asset"]["extras"]["unit"] == "x and y in px, z in rad"
    assert scene["accessors"][0]["max"][0] == mesh.vertices[:, 0].max()


@pytest.mark.parametrize("binary", [True, False])
def test_other_programs_ply_is_read(tmp_path: Path, mesh: Mesh, binary: bool) -> None:
    other = pyvista.PolyData.from_regular_faces(mesh.vertices, mesh.faces)
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
        (b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nend_header\n", "vertices followed by faces"),
        (b"ply\nformat ascii 1.0\nelement vertex -1\nend_header\n", "element vertex -1"),
        (
            b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
            b"element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n4 0 0 0 0\n",
            "triangulate",
        ),
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


def test_a_ply_cut_anywhere_is_refused(tmp_path: Path, mesh: Mesh) -> None:
    path = tmp_path / "mesh.ply"
    write_mesh(mesh, path)
    whole = path.read_bytes()
    for length in range(0, len(whole), 7):
        path.write_bytes(whole[:length])
        with pytest.raises(FootageError):
            read_mesh(path)


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
