"""Meshes to glTF 2.0 as .glb, their texture in the same file.

References
----------
Khronos Group, glTF 2.0 specification, 2021 (ISO/IEC 12113:2022).
"""

import json
import struct
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.errors import OutputError
from pipeline.output.formats.file_text import Content, Heading
from pipeline.output.mesh import Mesh, vertex_normals
from pipeline.output.range_image import encode_png

_SRGB = np.arange(256) / 255
_SRGB_TO_LINEAR = np.where(_SRGB <= 0.04045, _SRGB / 12.92, ((_SRGB + 0.055) / 1.055) ** 2.4)


def _scene_and_buffer(mesh: Mesh, heading: Heading) -> tuple[dict[str, Any], bytes]:
    """Return the description of a glTF scene and its one buffer."""
    if len(mesh.faces) == 0:
        raise OutputError("glTF cannot hold an empty mesh: write a .ply file instead")
    columns: dict[str, npt.NDArray[Any]] = {"POSITION": mesh.vertices, "NORMAL": vertex_normals(mesh)}
    if mesh.texture is not None:
        columns["TEXCOORD_0"] = mesh.texture_places().astype(np.float32)
    elif mesh.colors is not None:
        # glTF's vertex colours are linear light; a fourth channel keeps each on a multiple of four bytes.
        linear = (65535 * _SRGB_TO_LINEAR).round().astype(np.uint16)
        columns["COLOR_0"] = np.pad(linear[mesh.colors], ((0, 0), (0, 1)), constant_values=65535)
    if mesh.flags is not None:
        # What glTF does not know begins with a line; as floats each keeps to a multiple of four bytes.
        columns["_FLAGS"] = mesh.flags[:, None].astype(np.float32)
    blocks = [*columns.values(), mesh.faces.reshape(-1, 1).astype(np.uint32)]
    contents = [block.tobytes() for block in blocks]
    if mesh.texture is not None:
        contents.append(encode_png(mesh.texture))
        contents[-1] += b"\0" * (-len(contents[-1]) % 4)
    offsets = np.cumsum([0, *map(len, contents)]).tolist()
    accessors: list[dict[str, Any]] = [
        {
            "bufferView": index,
            "componentType": {"f4": 5126, "u2": 5123, "u4": 5125}[block.dtype.str[1:]],
            "normalized": block.dtype == np.uint16,
            "count": len(block),
            "type": {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}[block.shape[1]],
        }
        for index, block in enumerate(blocks)
    ]
    accessors[0] |= {"min": mesh.vertices.min(axis=0).tolist(), "max": mesh.vertices.max(axis=0).tolist()}
    attributes = {name: index for index, name in enumerate(columns)}
    surface: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 0.8}
    views: list[dict[str, Any]] = [
        {"buffer": 0, "byteOffset": offset, "byteLength": len(content)}
        for offset, content in zip(offsets, contents, strict=False)
    ]
    for index in range(len(blocks)):
        views[index]["target"] = 34963 if index == len(columns) else 34962
    pictures: dict[str, Any] = {}
    if mesh.texture is not None:
        surface["baseColorTexture"] = {"index": 0}
        pictures = {
            "images": [{"bufferView": len(blocks), "mimeType": "image/png"}],
            "samplers": [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}],
            "textures": [{"source": 0, "sampler": 0}],
        }
    return {
        "asset": {"version": "2.0", "generator": "colorphase", "extras": heading.remarks},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": len(columns), "material": 0}]}],
        "materials": [{"doubleSided": True, "pbrMetallicRoughness": surface}],
        "buffers": [{"byteLength": offsets[-1]}],
        "bufferViews": views,
        "accessors": accessors,
        **pictures,
    }, b"".join(contents)


def encode_glb(mesh: Mesh, heading: Heading) -> dict[str, Content]:
    """Return a mesh as a binary glTF file.

    Raises
    ------
    OutputError
        It has no faces.
    """
    scene, buffer = _scene_and_buffer(mesh, heading)
    text = json.dumps(scene, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    parts = [
        struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(buffer)),
        struct.pack("<I4s", len(text), b"JSON") + text,
        struct.pack("<I4s", len(buffer), b"BIN\0") + buffer,
    ]
    return {".glb": b"".join(parts)}
