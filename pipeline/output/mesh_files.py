"""Meshes to files that other programs open, and meshes in PLY back.

Numbers keep the camera frame of OpenCV (x right, y down, z forward) and their unit in PLY, OBJ and STL. VRML wraps the
same numbers in a transform, and glTF holds converted ones, because both fix y up, z towards the viewer, and metres.
"""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.errors import FootageError, OutputError
from pipeline.files import write_atomically
from pipeline.output.gltf import encode_glb, encode_gltf
from pipeline.output.mesh import NOT_METRIC, Mesh, face_normals, metres_a_unit
from pipeline.output.ply import decode_ply, encode_ply


def write_mesh(mesh: Mesh, path: str | Path) -> None:
    """Write a mesh in the format that the file's suffix names.

    Parameters
    ----------
    mesh : Mesh
        What to write. PLY keeps all of it; OBJ and glTF its colours and normals, glTF its flags, too; VRML its colours;
        STL its shape.
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
        With every property of the vertices.

    Raises
    ------
    FootageError
        If the file is missing, truncated, or no mesh of triangles.
    """
    try:
        return decode_ply(Path(path).read_bytes())
    except OSError as error:
        raise FootageError(f"cannot read {path}: {error.strerror}") from error
    except ValueError as error:
        raise FootageError(f"cannot read {path} as a PLY mesh: {error}") from error


def _encode_stl(mesh: Mesh) -> bytes:
    normals = face_normals(mesh)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    triangles = np.zeros(len(mesh.faces), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    triangles["normal"] = normals / np.where(lengths > 0, lengths, 1)
    triangles["corners"] = mesh.vertices[mesh.faces]
    unit = "unit mm" if mesh.unit == "mm" else f"unit rad, {NOT_METRIC}"
    return struct.pack("<80sI", f"binary STL, {unit}".encode(), len(triangles)) + triangles.tobytes()


def _encode_obj(mesh: Mesh) -> bytes:
    vertices = _rows("v %.7g %.7g %.7g\n", mesh.vertices)
    if mesh.colors is not None:
        vertices = _rows("v %.7g %.7g %.7g %.4f %.4f %.4f\n", np.hstack([mesh.vertices, mesh.colors / np.float32(255)]))
    if mesh.normals is None:
        faces = _rows("f %d %d %d\n", mesh.faces + 1)
        return f"{_unit_comment(mesh)}{vertices}{faces}".encode()
    normals = _rows("vn %.4f %.4f %.4f\n", mesh.normals)
    # A corner names its vertex and its normal, which have the same number here.
    faces = _rows("f %d//%d %d//%d %d//%d\n", np.repeat(mesh.faces + 1, 2, axis=1))
    return f"{_unit_comment(mesh)}{vertices}{normals}{faces}".encode()


def _unit_comment(mesh: Mesh) -> str:
    return "# unit mm\n" if mesh.unit == "mm" else f"# unit rad\n# {NOT_METRIC}\n"


def _encode_vrml(mesh: Mesh) -> bytes:
    scale = metres_a_unit(mesh)
    vertices = _rows("%.7g %.7g %.7g,\n", mesh.vertices)
    faces = _rows("%d,%d,%d,-1,\n", mesh.faces)
    colors = ""
    if mesh.colors is not None:
        colors = "color Color { color [\n" + _rows("%.4f %.4f %.4f,\n", mesh.colors / np.float32(255)) + "] }\n"
    return f"""#VRML V2.0 utf8
{_unit_comment(mesh)}Transform {{
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


def _rows(row: str, table: npt.NDArray[Any]) -> str:
    # One format of the whole table is several times faster than numpy.savetxt.
    return row * len(table) % tuple(table.ravel().tolist())


_ENCODERS: dict[str, Callable[[Mesh], bytes]] = {
    ".ply": encode_ply,
    ".wrl": _encode_vrml,
    ".obj": _encode_obj,
    ".stl": _encode_stl,
    ".glb": encode_glb,
    ".gltf": encode_gltf,
}
