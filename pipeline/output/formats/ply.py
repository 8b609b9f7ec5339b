"""Meshes to PLY and back, with every property of their vertices.

VTK's reader drops those that it does not know, as standard deviations.

References
----------
G. Turk, The PLY polygon file format, 1994.
"""

import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from pipeline.limits import check_mesh_size
from pipeline.output.formats import Content, Heading, remarks_in
from pipeline.output.mesh import COLOR, FLAGS, NORMAL, POSITION, RESERVED, Mesh

_TYPES = dict(
    zip(
        "char int8 uchar uint8 short int16 ushort uint16 int int32 uint uint32 float float32 double float64".split(),
        "i1 i1 u1 u1 i2 i2 u2 u2 i4 i4 u4 u4 f4 f4 f8 f8".split(),
        strict=True,
    )
)
# A line for each property, and comments: others' have about 1,000 bytes.
_LONGEST_HEAD = 2**16
# Vertices or faces at a time, which stay in the processor's cache until they are written.
_BLOCK = 2**14
# What lists of corners are called, and the elements that are used.
_CORNERS = ("vertex_indices", "vertex_index")
_USED = ("vertex", "face", "tristrips")
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


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


def ply_bytes(mesh: Mesh) -> int:
    """Return what a mesh takes as a PLY file, without its header."""
    arrays = [mesh.vertices, mesh.normals, mesh.colors, mesh.flags, *mesh.properties.values()]
    return sum(array.nbytes for array in arrays if array is not None) + (mesh.faces.itemsize * 3 + 1) * len(mesh.faces)


def _write_records(file: BinaryIO, block: npt.NDArray[Any], fields: Sequence[tuple[str, npt.NDArray[Any]]]) -> None:
    """Write records, block by block; fields that are not named are as in the block."""
    count = len(fields[0][1])
    for first in range(0, count, len(block)):
        part = block[: count - first]
        for name, values in fields:
            part[name] = values[first : first + len(part)]
        file.write(part.data)


def decode_ply(data: bytes) -> tuple[Mesh, dict[str, str]]:
    """Return the mesh that a PLY file holds, binary or ASCII, with the coordinates that it has there; and its remarks.

    Polygons and strips become triangles; elements other than vertices, faces and strips are not read.

    Raises
    ------
    ValueError
        It is truncated, larger than `max_pixels` allows, or no mesh.
    """
    head, end, _ = data[:_LONGEST_HEAD].partition(b"end_header")
    if not end:
        raise ValueError(f"its header has no end within {_LONGEST_HEAD} bytes")
    body = data[len(head) + len(end) :]
    lines = head.decode("ascii", "replace").splitlines()
    is_text, elements = _parse_header([line.split() for line in lines])
    counts = {element.name: element.count for element in elements}
    vertices = next(element for element in elements if element.name == "vertex")
    if not {*POSITION} <= {name for name, (count, _) in vertices.properties.items() if count is None}:
        raise ValueError("its vertices have no x, y and z")
    check_mesh_size(counts["vertex"], sum(counts.get(name, 0) for name in _USED[1:]))
    if is_text:
        body = np.array(body.split(), np.float64).tobytes()
    else:
        body = body[2 if body[:2] == b"\r\n" else 1 :]
    tables, at = {}, 0
    for element in elements[: max(i for i, element in enumerate(elements) if element.name in _USED) + 1]:
        tables[element.name], at = _read_rows(body, at, element)
    vertex, triangles = tables["vertex"], [np.empty((0, 3), np.int64)]
    for name, joined in (("face", _fans), ("tristrips", _strips)):
        table = tables.get(name, {})
        corners = next((table[key] for key in _CORNERS if key in table), None)
        if corners is not None and corners.counts is not None:
            triangles.append(joined(_whole(corners.values, "corners", np.int32).astype(np.int64), corners.counts))
    faces = np.concatenate(triangles)
    check_mesh_size(counts["vertex"], len(faces))
    names = [name for name, column in vertex.items() if column.counts is None]
    colored, flagged = {*COLOR} <= {*names}, FLAGS in names
    mesh = Mesh(
        vertices=_columns(vertex, POSITION, np.float32),
        faces=faces.astype(np.int32),
        colors=_colors(_columns(vertex, COLOR)) if colored else None,
        properties={name: _columns(vertex, (name,), np.float32)[:, 0] for name in names if name not in RESERVED},
        normals=_columns(vertex, NORMAL, np.float32) if {*NORMAL} <= {*names} else None,
        flags=_whole(_columns(vertex, (FLAGS,))[:, 0], "flags", np.uint8) if flagged else None,
    )
    return mesh, remarks_in(line.removeprefix("comment") for line in lines if line.startswith("comment"))


@dataclass(frozen=True)
class _Column:
    """A property of all rows; of lists, one after another, how long each is."""

    values: npt.NDArray[Any]
    counts: npt.NDArray[np.int64] | None = None


@dataclass(frozen=True)
class _Element:
    """Rows of a header's element: their number, and the type of each property, and of a list's count."""

    name: str
    count: int
    properties: dict[str, tuple[str | None, str]]

    def layout(self, lengths: Sequence[int]) -> np.dtype:
        """Return the layout of a row whose lists have these lengths; a list's count has the name before its own."""
        fields: list[Any] = []
        left = iter(lengths)
        for name, (count, kind) in self.properties.items():
            fields += [(name, kind)] if count is None else [(f"#{name}", count), (name, kind, (next(left),))]
        return np.dtype(fields)


def _read_rows(body: bytes, at: int, element: _Element) -> tuple[dict[str, _Column], int]:
    """Return an element's properties, if it is used, and where its rows end."""
    if not element.properties:
        return {}, at
    lists = [name for name, (count, _) in element.properties.items() if count is not None]
    shortest = element.layout([0] * len(lists))
    if not lists and at + element.count * shortest.itemsize > len(body):
        promised = element.count * shortest.itemsize
        raise ValueError(
            f"it is truncated: its header promises {promised} bytes of {element.name}, {len(body) - at} follow"
        )
    parts, left, layouts = [np.empty(0, shortest)], element.count, dict[tuple[int, ...], np.dtype]()
    at_once = left  # of almost all files lists are of one length
    while left:
        lengths = tuple(_lengths(body, at, element))
        layout = layouts[lengths] = layouts.get(lengths) or element.layout(lengths)
        rows = np.frombuffer(body, layout, min(at_once, left, (len(body) - at) // layout.itemsize), at)
        said = zip(lists, lengths, strict=True)
        if at_once > 1 and not all((rows[f"#{name}"] == length).all() for name, length in said):
            at_once = 1
            continue
        if element.name in _USED:
            parts.append(rows)
        at, left = at + rows.nbytes, left - len(rows)
    columns = {name: np.concatenate([part[name].ravel() for part in parts]) for name in element.properties}
    counts = {name: np.concatenate([part[f"#{name}"] for part in parts]).astype(np.int64) for name in lists}
    return {name: _Column(values, counts.get(name)) for name, values in columns.items()}, at


def _lengths(body: bytes, at: int, element: _Element) -> list[int]:
    """Return how long the lists of the row that begins here are."""
    lengths = []
    for count, kind in element.properties.values():
        if count is not None:
            number = _number(count)
            if at + number.size > len(body):
                raise ValueError(f"it is truncated: a {element.name} that its header promises is missing")
            (length,) = number.unpack_from(body, at)
            if not 0 <= length <= len(body) or length != int(length):
                raise ValueError(f"a list of a {element.name} has {length:g} entries: it is damaged")
            lengths.append(int(length))
            at += number.size
        at += (lengths[-1] if count is not None else 1) * _number(kind).size
    if at > len(body):
        raise ValueError(f"it is truncated: a {element.name} that its header promises is missing")
    return lengths


@cache
def _number(kind: str) -> struct.Struct:
    """Return what reads one number of a NumPy type; many of them are read one after another."""
    return struct.Struct(kind[0] + np.dtype(kind).char)


def _fans(corners: npt.NDArray[np.int64], counts: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return polygons as triangles, (M, 3), around the first corner of each."""
    first = np.cumsum(counts) - counts
    n_each = np.maximum(counts - 2, 0)
    start = np.repeat(first, n_each)
    step = np.arange(len(start)) - np.repeat(np.cumsum(n_each) - n_each, n_each)
    return np.stack([corners[start], corners[start + step + 1], corners[start + step + 2]], axis=1)


def _strips(corners: npt.NDArray[np.int64], counts: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return strips, ended by -1, as triangles, (M, 3); every other one runs the other way round."""
    place = np.arange(len(corners))
    ends = np.cumsum(counts)
    begin = np.maximum.accumulate(np.where(corners < 0, place + 1, np.where(np.isin(place, ends), place, 0)))
    first = np.flatnonzero((begin[2:] == begin[:-2]) & (corners[2:] >= 0) & (corners[:-2] >= 0))
    odd = (first - begin[first]) % 2
    return np.stack([corners[first], corners[first + 1 + odd], corners[first + 2 - odd]], axis=1)


def _columns(vertex: dict[str, _Column], names: tuple[str, ...], dtype: npt.DTypeLike = np.float64) -> npt.NDArray[Any]:
    """Return properties of the vertices side by side; beyond the type's largest number they become infinite."""
    with np.errstate(over="ignore"):
        return np.stack([vertex[name].values for name in names], axis=1).astype(dtype)


def _colors(values: npt.NDArray[np.float64]) -> npt.NDArray[np.uint8]:
    """Return colours of 0 to 255, or of 0 to 1 with decimals."""
    parts = values.size and values.max() <= 1 and (values != np.floor(values)).any()
    return _whole(np.rint(255 * values) if parts else values, "colours", np.uint8)


def _whole(values: npt.NDArray[Any], what: str, dtype: type[np.integer[Any]]) -> npt.NDArray[Any]:
    """Return whole numbers in a type that holds them, where they are such numbers; -1 ends a strip of corners."""
    limits = np.iinfo(dtype)
    least = max(limits.min, -1)
    if values.size and not ((values >= least) & (values <= limits.max) & (values == np.floor(values))).all():
        raise ValueError(f"its {what} are not whole numbers from 0 to {limits.max}")
    return values.astype(dtype)


def _parse_header(lines: list[list[str]]) -> tuple[bool, list[_Element]]:
    """Return whether a PLY file's numbers are text, and its elements."""
    is_text, types = False, dict[str, str]()
    elements: list[_Element] = []
    for line in lines:
        match line:
            case ["format", "ascii", "1.0"]:
                is_text, types = True, dict.fromkeys(_TYPES, "=f8")  # as they are read
            case ["format", encoding, "1.0"] if encoding in _BYTE_ORDERS:
                types = {name: _BYTE_ORDERS[encoding] + kind for name, kind in _TYPES.items()}
            case ["element", name, count] if re.fullmatch("[0-9]{1,18}", count):
                elements.append(_Element(name, int(count), {}))
            case ["property", "list", count, kind, name] if elements and {count, kind} <= types.keys():
                _add_property(elements[-1], name, types[count], types[kind])
            case ["property", kind, name] if elements and kind in types:
                _add_property(elements[-1], name, None, types[kind])
            case [] | ["ply"] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise ValueError(f"its header has {' '.join(line)[:80]!r}")
    names = [element.name for element in elements]
    if not types or "vertex" not in names or len({*names}) < len(names):
        raise ValueError("its header does not announce vertices, once, and how they are stored")
    return is_text, elements


def _add_property(element: _Element, name: str, count: str | None, kind: str) -> None:
    if name in element.properties:
        raise ValueError(f"its header names the property {name[:80]!r} twice")
    element.properties[name] = count, kind
