"""Meshes to glTF 2.0, as .glb or .gltf: y up, z towards the viewer, in metres.

References
----------
Khronos Group, glTF 2.0 specification, 2021 (ISO/IEC 12113:2022).
"""

import base64
import json
import struct
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.errors import OutputError
from pipeline.output.mesh import NOT_METRIC, Mesh, metres_a_unit, vertex_normals

_SRGB = np.arange(256) / 255
_SRGB_TO_LINEAR = np.where(_SRGB <= 0.04045, _SRGB / 12.92, ((_SRGB + 0.055) / 1.055) ** 2.4)


def _gltf_parts(mesh: Mesh) -> tuple[dict[str, Any], bytes]:
    """Return the description of a glTF scene and its one buffer."""
    if len(mesh.faces) == 0:
        raise OutputError("glTF cannot hold an empty mesh: write a .ply file instead")
    y_up = np.array([1, -1, -1], np.float32)
    positions = mesh.vertices * y_up * np.float32(metres_a_unit(mesh))
    columns: dict[str, npt.NDArray[Any]] = {"POSITION": positions, "NORMAL": vertex_normals(mesh) * y_up}
    if mesh.colors is not None:
        # glTF's vertex colours are linear light; a fourth channel keeps each on a multiple of four bytes.
        linear = (65535 * _SRGB_TO_LINEAR).round().astype(np.uint16)
        columns["COLOR_0"] = np.pad(linear[mesh.colors], ((0, 0), (0, 1)), constant_values=65535)
    if mesh.flags is not None:
        # What glTF does not know begins with a line; as floats each keeps to a multiple of four bytes.
        columns["_FLAGS"] = mesh.flags[:, None].astype(np.float32)
    blocks = [*columns.values(), mesh.faces.reshape(-1, 1).astype(np.uint32)]
    offsets = np.cumsum([0, *(block.nbytes for block in blocks)]).tolist()
    accessors: list[dict[str, Any]] = [
        {
            "bufferView": index,
            "componentType": {"f4": 5126, "u2": 5123, "u4": 5125}[block.dtype.str[1:]],
            "normalized": block.dtype == np.uint16,
            "count": len(block),
            "type": {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[block.shape[1]],
        }
        for index, block in enumerate(blocks)
    ]
    accessors[0] |= {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
    attributes = {name: index for index, name in enumerate(columns)}
    material = {"doubleSided": True, "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.8}}
    extras = {"unit": "m" if mesh.unit == "mm" else f"rad, {NOT_METRIC}"}
    return {
        "asset": {"version": "2.0", "generator": "colorphase", "extras": extras},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": len(columns), "material": 0}]}],
        "materials": [material],
        "buffers": [{"byteLength": offsets[-1]}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": offset, "byteLength": block.nbytes, "target": target}
            for offset, block, target in zip(offsets, blocks, [34962] * len(columns) + [34963], strict=False)
        ],
        "accessors": accessors,
    }, b"".join(block.tobytes() for block in blocks)


def encode_glb(mesh: Mesh) -> bytes:
    """Return a mesh as a binary glTF file."""
    scene, buffer = _gltf_parts(mesh)
    text = json.dumps(scene, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    return b"".join(
        [
            struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(buffer)),
            struct.pack("<I4s", len(text), b"JSON") + text,
            struct.pack("<I4s", len(buffer), b"BIN\0") + buffer,
        ]
    )


def encode_gltf(mesh: Mesh) -> bytes:
    """Return a mesh as a glTF file in JSON, its numbers in it in base 64."""
    scene, buffer = _gltf_parts(mesh)
    scene["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(buffer).decode()
    return json.dumps(scene).encode()
