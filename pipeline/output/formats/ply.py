"""Meshes to PLY and back, with every property of their vertices.

VTK's reader drops those that it does not know, as standard deviations.

References
----------
G. Turk, The PLY polygon file format, 1994.
"""

import re
from collections.abc import Sequence
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from pipeline.limits import check_mesh_size
from pipeline.output.formats import Content, Heading
from pipeline.output.mesh import COLOR, FLAGS, NORMAL, POSITION, PROVENANCE, RESERVED, Mesh

_TYPES = dict(
    zip(
        "char int8 uchar uint8 short int16 ushort uint16 int int32 uint uint32 float float32 double float64".split(),
        "i1 i1 u1 u1 i2 i2 u2 u2 i4 i4 u4 u4 f4 f4 f8 f8".split(),
        strict=True,
    )
)
# A line for each property, and comments: others' have some 1,000 bytes.
_LONGEST_HEAD = 2**16
# Vertices or faces at a time, which stay in the processor's cache until they are written.
_BLOCK = 2**14
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}


def encode_ply(mesh: Mesh, heading: Heading) -> dict[str, Content]:
    """Return a mesh as a binary PLY file, remarks as its comments."""
    groups: list[tuple[tuple[str, ...], npt.NDArray[Any]]] = [(POSITION, mesh.vertices)]
    if mesh.normals is not None:
        groups.append((NORMAL, mesh.normals))
    if mesh.colors is not None:
        groups.append((COLOR, mesh.colors))
    if mesh.flags is not None:
        groups.append(((FLAGS,), mesh.flags))
    groups += [((name,), values) for name, values in mesh.properties.items()]
    vertex = np.dtype([(names[0], values.dtype.newbyteorder("<"), values.shape[1:]) for names, values in groups])
    face = np.dtype([("count", "u1"), ("corners", "<i4", 3)])
    kinds = {name: "uchar" if values.dtype == np.uint8 else "float" for names, values in groups for name in names}
    head = [
        "ply",
        "format binary_little_endian 1.0",
        *heading.comments("comment").splitlines(),
        *(["comment flags 0 measured, 1 smoothed, 2 filled, 6 moved to a rim"] if mesh.flags is not None else []),
        f"element vertex {len(mesh.vertices)}",
        *(f"property {kind} {name}" for name, kind in kinds.items()),
        f"element face {len(mesh.faces)}",
        "property list uchar int vertex_indices",
        "end_header\n",
    ]
    corners = [("corners", mesh.faces)]

    def write(file: BinaryIO) -> None:
        file.write("\n".join(head).encode())
        _write_records(file, np.empty(_BLOCK, vertex), [(names[0], values) for names, values in groups])
        _write_records(file, np.full(_BLOCK, 3, face), corners)

    return {".ply": write}


def _write_records(file: BinaryIO, block: npt.NDArray[Any], fields: Sequence[tuple[str, npt.NDArray[Any]]]) -> None:
    """Write records, block by block; fields that are not named are as in the block."""
    count = len(fields[0][1])
    for first in range(0, count, len(block)):
        part = block[: count - first]
        for name, values in fields:
            part[name] = values[first : first + len(part)]
        file.write(part.data)


def decode_ply(data: bytes) -> Mesh:
    """Return the mesh of triangles that a PLY file holds, binary or ASCII; without a comment on its unit in mm.

    Raises
    ------
    ValueError
        It is truncated, or holds something else.
    """
    head, end, _ = data[:_LONGEST_HEAD].partition(b"end_header")
    if not end:
        raise ValueError(f"its header has no end within {_LONGEST_HEAD} bytes")
    body = data[len(head) + len(end) :]
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    (vertex_count, vertex), (face_count, face) = _parse_header(lines)
    names = vertex.names or ()
    if not {*POSITION} <= {*names} or "corners" not in (face.names or ()):
        raise ValueError("its vertices have no x, y and z, or its faces no corners")
    check_mesh_size(vertex_count, face_count)
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
    colored, flagged = {*COLOR} <= {*names}, FLAGS in names
    return Mesh(
        vertices=_columns(vertices, POSITION, np.float32),
        faces=_whole(faces["corners"], "corners", np.int32),
        colors=_whole(_columns(vertices, COLOR), "colours", np.uint8) if colored else None,
        properties={name: _columns(vertices, (name,), np.float32)[:, 0] for name in names if name not in RESERVED},
        unit="rad" if ["comment", "unit", "rad"] in lines else "mm",
        normals=_columns(vertices, NORMAL, np.float32) if {*NORMAL} <= {*names} else None,
        flags=_whole(_columns(vertices, (FLAGS,))[:, 0], "flags", np.uint8) if flagged else None,
        provenance={
            line[1]: " ".join(line[2:]) for line in lines if line[:1] == ["comment"] and {*line[1:2]} & {*PROVENANCE}
        },
    )


def _columns(vertices: npt.NDArray[Any], names: tuple[str, ...], dtype: npt.DTypeLike = np.float64) -> npt.NDArray[Any]:
    """Return properties of the vertices side by side; beyond the type's largest number they become infinite."""
    with np.errstate(over="ignore"):
        return np.stack([vertices[name] for name in names], axis=1).astype(dtype)


def _whole(values: npt.NDArray[Any], what: str, dtype: type[np.integer[Any]]) -> npt.NDArray[Any]:
    """Return whole numbers in a type that holds them, where they are such numbers."""
    limits = np.iinfo(dtype)
    if values.size and not ((values >= 0) & (values <= limits.max) & (values == np.floor(values))).all():
        raise ValueError(f"its {what} are not whole numbers from 0 to {limits.max}")
    return values.astype(dtype)


def _as_doubles(layout: np.dtype) -> np.dtype:
    return np.dtype([(name, "f8", layout[name].shape) for name in layout.names or ()])


def _parse_header(lines: list[list[str]]) -> list[tuple[int, np.dtype]]:
    """Return how many vertices and how many faces follow a PLY header, and the layout of each."""
    order = ""
    elements: list[tuple[str, int, list[Any]]] = []
    for line in lines:
        match line:
            case ["format", encoding, "1.0"] if encoding in _BYTE_ORDERS:
                order = _BYTE_ORDERS[encoding]
            case ["element", name, count] if re.fullmatch("[0-9]{1,18}", count):
                elements.append((name, int(count), []))
            case ["property", "list", count, corner, _] if elements and {count, corner} <= _TYPES.keys():
                record = [("count", order + _TYPES[count]), ("corners", order + _TYPES[corner], 3)]
                elements[-1][2].extend(record)
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1][2].append((name, order + _TYPES[kind]))
            case [] | ["ply"] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise ValueError(f"its header says {' '.join(line)[:80]!r}")
    if not order or [name for name, _, _ in elements[:2]] != ["vertex", "face"]:
        raise ValueError("its header does not announce vertices followed by faces")
    return [(count, np.dtype(fields)) for _, count, fields in elements[:2]]
