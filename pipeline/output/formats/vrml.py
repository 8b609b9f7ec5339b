"""Meshes to VRML 2.0, as Cortona and other viewers of the paper's time open them, and back.

References
----------
ISO/IEC 14772-1:1997, The Virtual Reality Modeling Language.
"""

import re
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.limits import check_mesh_size
from pipeline.output.formats import Content, Heading, remarks_in, text_rows
from pipeline.output.mesh import Mesh

_COMMENT = re.compile(rb"#[^\n]*")
# The beginning of a list that belongs to the mesh, and how many numbers a row of it has.
_POINTS = re.compile(rb"coord\s+Coordinate\s*{\s*point\s*\["), 3
_COLORS = re.compile(rb"color\s+Color\s*{\s*color\s*\["), 3
_FACES = re.compile(rb"coordIndex\s*\["), 4
# What places or colours a shape in ways that are not read.
_ELSEWHERE = (b"Transform", b"Inline", b"PROTO", b"colorIndex", b"colorPerVertex")


def encode_vrml(mesh: Mesh, heading: Heading) -> dict[str, Content]:
    """Return a mesh as a VRML file, its colours by vertex."""
    vertices = text_rows("%.7g %.7g %.7g,\n", mesh.vertices)
    faces = text_rows("%d,%d,%d,-1,\n", mesh.faces)
    colors = ""
    if mesh.colors is not None:
        colors = "color Color { color [\n" + text_rows("%.4f %.4f %.4f,\n", mesh.colors / np.float32(255)) + "] }\n"
    text = f"""#VRML V2.0 utf8
{heading.comments("#")}Shape {{
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
"""
    return {".wrl": text.encode()}


def decode_vrml(data: bytes) -> tuple[Mesh, dict[str, str]]:
    """Return the mesh that a VRML file with one set of triangles holds, as it is there, and its remarks.

    Raises
    ------
    ValueError
        It is truncated, larger than `max_pixels` allows, or holds something else.
    """
    if not data.startswith(b"#VRML V2.0"):
        raise ValueError("it does not begin with '#VRML V2.0'")
    text = _COMMENT.sub(b"", data)
    if any(text.count(mark) != text.count(end) for mark, end in ((b"{", b"}"), (b"[", b"]"))):
        raise ValueError("it is truncated: a bracket is not closed")
    other = next((word.decode() for word in _ELSEWHERE if word in text), None)
    if other is not None or text.count(b"IndexedFaceSet") != 1:
        raise ValueError(f"it holds {other or 'more or less than one IndexedFaceSet'}: save it as PLY, OBJ or glTF")
    points, colors, faces = (_rows(text, *table) for table in (_POINTS, _COLORS, _FACES))
    if points is None or faces is None:
        raise ValueError("it has no points or no faces")
    check_mesh_size(len(points), len(faces))
    if not (faces == np.rint(faces)).all() or (faces[:, 3] != -1).any() or (faces[:, :3] < 0).any():
        raise ValueError("it has faces other than triangles: triangulate them first")
    if colors is not None and (len(colors) != len(points) or not ((colors >= 0) & (colors <= 1)).all()):
        raise ValueError("its colours are not one from 0 to 1 for each point")
    mesh = Mesh(
        vertices=points.astype(np.float32),
        faces=faces[:, :3].astype(np.int32),
        colors=None if colors is None else np.rint(255 * colors).astype(np.uint8),
    )
    return mesh, remarks_in(comment[1:].decode("utf-8", "replace") for comment in _COMMENT.findall(data))


def _rows(text: bytes, beginning: "re.Pattern[bytes]", width: int) -> npt.NDArray[Any] | None:
    """Return a list's numbers, (N, width); None: there is no such list."""
    found = beginning.search(text)
    if found is None:
        return None
    numbers = np.array(text[found.end() : text.index(b"]", found.end())].replace(b",", b" ").split(), np.float64)
    if numbers.size % width:
        raise ValueError(f"a list of it has {numbers.size} numbers, which is no whole number of rows of {width}")
    return numbers.reshape(-1, width)
