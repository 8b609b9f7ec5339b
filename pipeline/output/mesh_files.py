"""Meshes to files that other programs open, and our own meshes back.

Numbers keep the camera frame of OpenCV (x right, y down, z forward) and their unit in PLY, OBJ and STL. VRML wraps the
same numbers in a transform, and glTF holds converted ones, because both fix y up, z towards the viewer, and metres.
"""

import base64
import json
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import FootageError, OutputError
from pipeline.files import write_atomically

Unit = Literal["mm", "rad"]
Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]

_PLY_TYPES = dict(
    zip(
        "char int8 uchar uint8 short int16 ushort uint16 int int32 uint uint32 float float32 double float64".split(),
        "i1 i1 u1 u1 i2 i2 u2 u2 i4 i4 u4 u4 f4 f4 f8 f8".split(),
        strict=True,
    )
)
_PLY_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
_POSITION = ("x", "y", "z")
_COLOR = ("red", "green", "blue")
_SRGB = np.arange(256) / 255
_SRGB_TO_LINEAR = np.where(_SRGB <= 0.04045, _SRGB / 12.92, ((_SRGB + 0.055) / 1.055) ** 2.4)


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh in the camera frame.

    Parameters
    ----------
    vertices : (N, 3) float32
        In mm; with ``unit="rad"``, x and y in px and z the relative phase in rad.
    faces : (M, 3) int32
        Corners of each triangle, in [0, N).
    colors : (N, 3) uint8, optional
        sRGB.
    properties : dict of (N,) float32
        More about each vertex, such as ``"sigma_mm"`` or ``"modulation"``.
    unit : {"mm", "rad"}
        What z is measured in.

    Raises
    ------
    ValueError
        If the arrays do not fit together, or a vertex is not finite.
    """

    vertices: Floats
    faces: NDArray[np.int32]
    colors: Bytes | None = None
    properties: dict[str, Floats] = field(default_factory=dict)
    unit: Unit = "mm"

    def __post_init__(self) -> None:
        count = len(self.vertices)
        wanted: list[tuple[str, NDArray[Any], tuple[int, ...], type]] = [
            ("vertices", self.vertices, (count, 3), np.float32),
            ("faces", self.faces, (len(self.faces), 3), np.int32),
            *((f"property {name}", values, (count,), np.float32) for name, values in self.properties.items()),
        ]
        if self.colors is not None:
            wanted.append(("colors", self.colors, (count, 3), np.uint8))
        for name, values, shape, dtype in wanted:
            if values.shape != shape or values.dtype != dtype:
                raise ValueError(f"{name}: got {values.shape} {values.dtype}, expected {shape} {np.dtype(dtype)}")
        for name in self.properties:
            if not name.isascii() or name.split() != [name] or name in _POSITION + _COLOR:
                raise ValueError(f"property {name!r}: expected one plain word other than x, y, z, red, green and blue")
        if self.unit not in get_args(Unit):
            raise ValueError(f"unit: got {self.unit!r}, expected 'mm' or 'rad'")
        if not np.isfinite(self.vertices).all():
            raise ValueError("vertices: some are not finite; leave masked pixels out of the mesh")
        if self.faces.size and not (self.faces.min() >= 0 and self.faces.max() < count):
            raise ValueError(f"faces: got corners {self.faces.min()} to {self.faces.max()} of {count} vertices")


def write_mesh(mesh: Mesh, path: str | Path) -> None:
    """Write a mesh in the format that the file's suffix names.

    Parameters
    ----------
    mesh : Mesh
        What to write. PLY keeps all of it; VRML, OBJ and glTF its colours; STL its shape.
    path : str or Path
        A .ply, .wrl, .obj, .stl, .glb or .gltf file.

    Raises
    ------
    OutputError
        If the suffix is unknown, the file cannot be written, or the mesh is empty and the format glTF.

    Notes
    -----
    glTF is y-up, right-handed and in metres, so (x, y, z) becomes (x, -y, -z) / 1000. A mesh in rad has no metres: it
    keeps its numbers, and its ``extras`` say what they are.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in _ENCODERS:
        raise OutputError(f"cannot write {path}: unknown mesh format '{suffix}', use one of {', '.join(_ENCODERS)}")
    write_atomically(path, _ENCODERS[suffix](mesh))


def read_mesh(path: str | Path) -> Mesh:
    """Read a PLY file of triangles, binary or ASCII.

    Parameters
    ----------
    path : str or Path
        The file. Without our comment on the unit it is taken to be in mm.

    Returns
    -------
    Mesh
        With every floating point property of the vertices besides their position.

    Raises
    ------
    FootageError
        If the file is missing, truncated, or no mesh of triangles.
    """
    try:
        return _decode_ply(Path(path).read_bytes())
    except OSError as error:
        raise FootageError(f"cannot read {path}: {error.strerror}") from error
    except ValueError as error:
        raise FootageError(f"cannot read {path} as a PLY mesh: {error}") from error


def vertex_normals(mesh: Mesh) -> Floats:
    """Average the normals of the triangles around each vertex, weighted by their area.

    Returns
    -------
    (N, 3) float32
        Unit vectors on the side from which corners run counter-clockwise; (0, 0, 1) for a vertex without a surface.
    """
    corners = mesh.faces.ravel()
    across = np.repeat(_face_normals(mesh), 3, axis=0)
    sums = np.stack([np.bincount(corners, axis, len(mesh.vertices)) for axis in across.T], axis=1)
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    return np.where(lengths > 0, sums / np.where(lengths > 0, lengths, 1), (0, 0, 1)).astype(np.float32)


def _face_normals(mesh: Mesh) -> Floats:
    """Return a normal a triangle, (M, 3), as long as twice its area."""
    first, second, third = (mesh.vertices[corner] for corner in mesh.faces.T)
    return np.cross(second - first, third - first)


def _encode_ply(mesh: Mesh) -> bytes:
    columns: dict[str, NDArray[Any]] = dict(zip(_POSITION, mesh.vertices.T, strict=True))
    if mesh.colors is not None:
        columns |= zip(_COLOR, mesh.colors.T, strict=True)
    columns |= mesh.properties
    vertices = np.empty(
        len(mesh.vertices), [(name, values.dtype.newbyteorder("<")) for name, values in columns.items()]
    )
    for name, values in columns.items():
        vertices[name] = values
    faces = np.empty(len(mesh.faces), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.faces
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment unit {mesh.unit}",
        f"element vertex {len(vertices)}",
        *(f"property {'uchar' if values.dtype == np.uint8 else 'float'} {name}" for name, values in columns.items()),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header\n",
    ]
    return "\n".join(header).encode() + vertices.tobytes() + faces.tobytes()


def _decode_ply(data: bytes) -> Mesh:
    head, _, body = data.partition(b"end_header")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    (vertex_count, vertex), (face_count, face) = _parse_ply_header(lines)
    names = vertex.names or ()
    if not {*_POSITION} <= {*names} or "corners" not in (face.names or ()):
        raise ValueError("its vertices have no x, y and z, or its faces no corners")
    if ["format", "ascii", "1.0"] in lines:
        vertex, face = _as_doubles(vertex), _as_doubles(face)
        body = np.array(body.split(), np.float64).tobytes()
    else:
        body = body[body.find(b"\n") + 1 :]
    promised = vertex_count * vertex.itemsize + face_count * face.itemsize
    if len(body) < promised:
        raise ValueError(f"it is truncated: its header promises {promised} bytes of data and {len(body)} follow")
    vertices = np.frombuffer(body, vertex, vertex_count)
    faces = np.frombuffer(body, face, face_count, vertex_count * vertex.itemsize)
    if (faces["count"] != 3).any():
        raise ValueError("it has faces other than triangles: triangulate them first")
    return Mesh(
        vertices=np.stack([vertices[name] for name in _POSITION], axis=1).astype(np.float32),
        faces=faces["corners"].astype(np.int32),
        colors=np.stack([vertices[name] for name in _COLOR], axis=1).astype(np.uint8) if "red" in names else None,
        properties={name: vertices[name].astype(np.float32) for name in names if name not in _POSITION + _COLOR},
        unit="rad" if ["comment", "unit", "rad"] in lines else "mm",
    )


def _as_doubles(layout: np.dtype) -> np.dtype:
    return np.dtype([(name, "f8", layout[name].shape) for name in layout.names or ()])


def _parse_ply_header(lines: list[list[str]]) -> list[tuple[int, np.dtype]]:
    """Return how many vertices and how many faces follow a PLY header, and the layout of each."""
    order = ""
    elements: list[tuple[str, int, list[Any]]] = []
    for line in lines:
        match line:
            case ["format", encoding, "1.0"] if encoding in _PLY_BYTE_ORDERS:
                order = _PLY_BYTE_ORDERS[encoding]
            case ["element", name, count] if count.isdigit():
                elements.append((name, int(count), []))
            case ["property", "list", count, corner, _] if elements and {count, corner} <= _PLY_TYPES.keys():
                record = [("count", order + _PLY_TYPES[count]), ("corners", order + _PLY_TYPES[corner], 3)]
                elements[-1][2].extend(record)
            case ["property", kind, name] if elements and kind in _PLY_TYPES:
                elements[-1][2].append((name, order + _PLY_TYPES[kind]))
            case [] | ["ply"] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise ValueError(f"its header says {' '.join(line)[:80]!r}")
    if not order or [name for name, _, _ in elements[:2]] != ["vertex", "face"]:
        raise ValueError("its header does not announce vertices followed by faces")
    return [(count, np.dtype(fields)) for _, count, fields in elements[:2]]


def _encode_stl(mesh: Mesh) -> bytes:
    normals = _face_normals(mesh)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    triangles = np.zeros(len(mesh.faces), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    triangles["normal"] = normals / np.where(lengths > 0, lengths, 1)
    triangles["corners"] = mesh.vertices[mesh.faces]
    return struct.pack("<80sI", f"binary STL, unit {mesh.unit}".encode(), len(triangles)) + triangles.tobytes()


def _encode_obj(mesh: Mesh) -> bytes:
    vertices = _rows("v %.7g %.7g %.7g\n", mesh.vertices)
    if mesh.colors is not None:
        vertices = _rows("v %.7g %.7g %.7g %.4f %.4f %.4f\n", np.hstack([mesh.vertices, mesh.colors / np.float32(255)]))
    faces = _rows("f %d %d %d\n", mesh.faces + 1)
    return f"# unit {mesh.unit}\n{vertices}{faces}".encode()


def _encode_vrml(mesh: Mesh) -> bytes:
    scale = _metres_a_unit(mesh)
    vertices = _rows("%.7g %.7g %.7g,\n", mesh.vertices)
    faces = _rows("%d,%d,%d,-1,\n", mesh.faces)
    colors = ""
    if mesh.colors is not None:
        colors = "color Color { color [\n" + _rows("%.4f %.4f %.4f,\n", mesh.colors / np.float32(255)) + "] }\n"
    return f"""#VRML V2.0 utf8
# unit {mesh.unit}
Transform {{
rotation 1 0 0 3.14159265
scale {scale} {scale} {scale}
children Shape {{
appearance Appearance {{ material Material {{ }} }}
geometry IndexedFaceSet {{
solid FALSE
creaseAngle 3.14159265
coord Coordinate {{ point [
{vertices}] }}
{colors}coordIndex [
{faces}]
}}
}}
}}
""".encode()


def _rows(row: str, table: NDArray[Any]) -> str:
    # One format of the whole table is several times faster than numpy.savetxt.
    return row * len(table) % tuple(table.ravel().tolist())


def _metres_a_unit(mesh: Mesh) -> float:
    return 0.001 if mesh.unit == "mm" else 1.0


def _gltf_parts(mesh: Mesh) -> tuple[dict[str, Any], bytes]:
    """Return the description of a glTF scene and its one buffer."""
    if len(mesh.faces) == 0:
        raise OutputError("glTF cannot hold an empty mesh: write a .ply file instead")
    y_up = np.array([1, -1, -1], np.float32)
    positions = mesh.vertices * y_up * np.float32(_metres_a_unit(mesh))
    columns: dict[str, NDArray[Any]] = {"POSITION": positions, "NORMAL": vertex_normals(mesh) * y_up}
    if mesh.colors is not None:
        # glTF's vertex colours are linear light; a fourth channel keeps each on a multiple of four bytes.
        linear = (65535 * _SRGB_TO_LINEAR).round().astype(np.uint16)
        columns["COLOR_0"] = np.pad(linear[mesh.colors], ((0, 0), (0, 1)), constant_values=65535)
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
    extras = {"unit": "m" if mesh.unit == "mm" else "x and y in px, z in rad"}
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


def _encode_glb(mesh: Mesh) -> bytes:
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


def _encode_gltf(mesh: Mesh) -> bytes:
    scene, buffer = _gltf_parts(mesh)
    scene["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(buffer).decode()
    return json.dumps(scene).encode()


_ENCODERS: dict[str, Callable[[Mesh], bytes]] = {
    ".ply": _encode_ply,
    ".wrl": _encode_vrml,
    ".obj": _encode_obj,
    ".stl": _encode_stl,
    ".glb": _encode_glb,
    ".gltf": _encode_gltf,
}
