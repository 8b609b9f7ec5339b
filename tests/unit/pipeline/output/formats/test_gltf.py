"""Meshes as glTF: y up, in metres, colours in linear light."""

import json
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from support.tilted_sheets import tilted_grid, tilted_mesh

from pipeline.output.mesh import Mesh
from pipeline.output.mesh_files import write_mesh


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
