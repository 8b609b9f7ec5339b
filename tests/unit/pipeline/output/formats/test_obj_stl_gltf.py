"""OBJ, STL and glTF: what each holds, what comes back, what is damaged; nothing elsewhere is opened."""

import base64
import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import pyvista
import trimesh
from support.tilted_sheets import tilted_grid, tilted_mesh

from pipeline.errors import FootageError
from pipeline.output.mesh import Mesh
from pipeline.output.mesh_files import read_mesh, write_mesh


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


def test_stl_has_unit_normals_away_from_the_bed(tmp_path, mesh):
    write_mesh(mesh, tmp_path / "mesh.stl")
    data = (tmp_path / "mesh.stl").read_bytes()
    assert len(data) == 84 + 50 * len(mesh.faces)
    assert not data.startswith(b"solid"), "readers take that for text"
    rows = np.frombuffer(data, np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")]), offset=84)
    np.testing.assert_allclose(np.linalg.norm(rows["normal"], axis=1), 1, rtol=1e-5)
    across = np.cross(rows["corners"][:, 1] - rows["corners"][:, 0], rows["corners"][:, 2] - rows["corners"][:, 0])
    assert ((across * rows["normal"]).sum(axis=1) > 0).all()


def test_gltf_is_y_up_and_in_metres(tmp_path: Path, mesh: Mesh) -> None:
    path = tmp_path / "mesh.glb"
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
    np.testing.assert_allclose(table(attributes["NORMAL"]), mesh.normals * (1, -1, -1), rtol=1e-6)
    np.testing.assert_array_equal(table(attributes["_FLAGS"])[:, 0], mesh.flags)
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
    assert scene["asset"]["extras"]["unit"] == "rad"
    assert scene["asset"]["extras"]["note"] == "not metric: z is relative phase, x and y are px"
    assert scene["accessors"][0]["max"][0] == mesh.vertices[:, 0].max()


def load_gltf(path: Path) -> tuple[dict[str, Any], bytes]:
    data = path.read_bytes()
    magic, version, length, text_length, kind = struct.unpack_from("<4sII I4s", data)
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    buffer_length, kind = struct.unpack_from("<I4s", data, 20 + text_length)
    assert (kind, 28 + text_length + buffer_length) == (b"BIN\0", len(data))
    assert text_length % 4 == buffer_length % 4 == 0
    return json.loads(data[20 : 20 + text_length]), data[28 + text_length :]


def test_a_texture_is_in_the_file(cpu, tmp_path: Path) -> None:
    mesh = tilted_mesh()
    write_mesh(mesh, tmp_path / "mesh.glb")
    scene, buffer = load_gltf(tmp_path / "mesh.glb")
    attributes = scene["meshes"][0]["primitives"][0]["attributes"]
    assert attributes.keys() == {"POSITION", "NORMAL", "TEXCOORD_0", "_FLAGS"}
    view = scene["bufferViews"][scene["images"][0]["bufferView"]]
    picture = buffer[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(picture, np.uint8), 1)[..., ::-1], tilted_grid().texture)
    assert scene["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"] == {"index": 0}
    assert all(view["byteOffset"] % 4 == 0 for view in scene["bufferViews"])


def write(mesh, path):
    """Write a mesh; as .gltf, which other programs write, from the parts of a .glb."""
    if path.suffix != ".gltf":
        return write_mesh(mesh, path)
    write_mesh(mesh, path.with_suffix(".glb"))
    scene, buffer = load_gltf(path.with_suffix(".glb"))
    scene["buffers"][0]["uri"] = f"data:application/octet-stream;base64,{base64.b64encode(buffer).decode()}"
    path.write_text(json.dumps(scene))


@pytest.mark.parametrize("suffix", [".obj", ".stl", ".glb", ".gltf"])
def test_what_is_written_comes_back(tmp_path, mesh, suffix):
    write(mesh, tmp_path / f"mesh{suffix}")
    read = read_mesh(tmp_path / f"mesh{suffix}")
    np.testing.assert_allclose(read.vertices[read.faces], mesh.vertices[mesh.faces], rtol=1e-5, atol=1e-4)
    if suffix == ".stl":
        assert read.colors is None
    else:
        np.testing.assert_allclose(read.colors.astype(int), mesh.colors, atol=2)


def test_other_programs_meshes_are_read(tmp_path):
    box = trimesh.creation.box((10, 20, 30))
    box.apply_translation((0, 5, 0))
    box.export(tmp_path / "box.stl")
    read = read_mesh(tmp_path / "box.stl")
    np.testing.assert_allclose(np.ptp(read.vertices, axis=0), (10, 30, 20))  # a printer's z is up, ours is away
    np.testing.assert_allclose(read.vertices[:, 2].min(), -5)


@pytest.mark.parametrize("suffix", [".obj", ".stl", ".glb", ".gltf"])
def test_damaged_files_are_one_line(tmp_path, mesh, suffix):
    path = tmp_path / f"mesh{suffix}"
    write(mesh, path)
    whole = path.read_bytes()
    rng = np.random.default_rng(5)
    for content in (b"", b"\0" * 100, whole[: len(whole) // 2], rng.bytes(500)):
        path.write_bytes(content)
        try:
            read_mesh(path)
        except FootageError as error:
            assert "\n" not in str(error) and str(error).startswith("cannot read"), error
        else:
            assert suffix == ".obj", "half a text may be a smaller mesh"


def test_only_files_beside_a_mesh_are_opened(tmp_path, mesh):
    (tmp_path / "inside").mkdir()
    (tmp_path / "secret.bin").write_bytes(b"\1" * 4000)
    write(mesh, tmp_path / "inside" / "mesh.gltf")
    scene = json.loads((tmp_path / "inside" / "mesh.gltf").read_text())
    for place in ("../secret.bin", "http://127.0.0.1:9/secret.bin", str(tmp_path / "secret.bin")):
        scene["buffers"][0]["uri"] = place
        (tmp_path / "inside" / "mesh.gltf").write_text(json.dumps(scene))
        with pytest.raises(FootageError, match=r"cannot read .*mesh\.gltf as a surface \(GLTF\)"):
            read_mesh(tmp_path / "inside" / "mesh.gltf")


def test_points_without_triangles_are_no_mesh(tmp_path):
    (tmp_path / "points.obj").write_text("v 0 0 0\nv 1 0 0\n")
    with pytest.raises(FootageError, match=r"cannot read .* as a surface \(OBJ\): it has no triangles"):
        read_mesh(tmp_path / "points.obj")


def test_a_mesh_larger_than_any_camera_is_refused(tmp_path, mesh, monkeypatch):
    write_mesh(mesh, tmp_path / "mesh.stl")
    monkeypatch.setenv("COLORPHASE_MAX_PIXELS", "4")
    with pytest.raises(FootageError, match="set COLORPHASE_MAX_PIXELS to a larger number"):
        read_mesh(tmp_path / "mesh.stl")
