"""Meshes to files that other programs open, and back."""

import errno
from pathlib import Path

from pipeline.errors import FootageError, OutputError
from pipeline.files import write_atomically
from pipeline.limits import MAX_PIXELS, max_pixels, open_plain, read_plain
from pipeline.output.formats.camera_grids import decode_depth, decode_pcd
from pipeline.output.formats.obj_stl_gltf import READ_SUFFIXES, read_foreign
from pipeline.output.formats.ply import decode_ply
from pipeline.output.formats.ros_bag import read_bag
from pipeline.output.formats.table import MESH_FORMATS, encode_as, in_camera_frame
from pipeline.output.formats.vrml import decode_vrml
from pipeline.output.mesh import Mesh
from pipeline.output.surface_mesh import grid_mesh

_DECODERS = {"ply": decode_ply, "wrl": decode_vrml}
_GRID_DECODERS = {"pcd": decode_pcd, "png": decode_depth, "tiff": decode_depth, "tif": decode_depth}
_BAG = "mcap"
# A vertex and its two triangles take some 150 bytes as text, and colours and normals some more.
_BYTES_A_PIXEL = 250


def write_mesh(mesh: Mesh, path: str | Path) -> None:
    """Write a mesh in the format that the file's suffix names.

    Parameters
    ----------
    mesh : Mesh
        What to write; `pipeline.output.formats.table` says what each format keeps of it, and which way is up there.
    path : str or Path
        A .ply, .obj, .stl, .glb or .wrl file. An OBJ file with a texture has an .mtl and a .png next to it.

    Raises
    ------
    OutputError
        If the suffix is unknown, the file cannot be written, or the mesh is empty and the format glTF.
    """
    path = Path(path)
    form = MESH_FORMATS.get(path.suffix.lower())
    if form is None:
        known = ", ".join(MESH_FORMATS)
        raise OutputError(f"cannot write {path}: unknown mesh format '{path.suffix}', use one of {known}")
    files = encode_as(form, mesh, path.stem)
    own = path.suffix.lower()
    # What a file names is there before it.
    for suffix in sorted(files, key=lambda suffix: suffix == own):
        write_atomically(path if suffix == own else path.with_suffix(suffix), files[suffix])


def read_mesh(path: str | Path, frame: int | None = None) -> Mesh:
    """Read a mesh of triangles, or a camera's grid of points, which becomes one.

    Parameters
    ----------
    path : str or Path
        A mesh: PLY, binary or ASCII, OBJ, STL, glTF or VRML. A grid: organised PCD, depth as a PNG or TIFF of 16 bits
        that says its step and its camera, or a bag, as an MCAP file. Units and which way is up are taken to be what is
        written by `write_mesh` and `colorphase export`; what has another suffix is read as PLY.
    frame : int, optional
        Which frame of a bag, from 0; of a bag of one frame it may be left out, and of other files it has to be.

    Returns
    -------
    Mesh
        In the camera frame. Of a PLY, PCD or MCAP file with every property of the vertices; of others with colours. The
        points of a grid are joined as a frame's pixels are (`frame_mesh`).

    Raises
    ------
    FootageError
        If the file is missing, truncated, or holds nothing of the kind.
    """
    path = Path(path)
    kind = path.suffix.lower()[1:]
    if kind not in (*_DECODERS, *_GRID_DECODERS, _BAG) and f".{kind}" not in READ_SUFFIXES:
        kind = "ply"
    most = _BYTES_A_PIXEL * max_pixels()
    try:
        if frame is not None and kind != _BAG:
            raise ValueError(f"it holds one frame: leave out frame {frame}")
        if kind == _BAG:
            open_plain(path).close()
            return grid_mesh(read_bag(path, frame))
        if kind in _GRID_DECODERS:
            return grid_mesh(_GRID_DECODERS[kind](read_plain(path, most)))
        if kind in _DECODERS:
            mesh = _DECODERS[kind](read_plain(path, most))
        else:
            mesh = read_foreign(path, most)
    except OSError as error:
        more = f": set {MAX_PIXELS} to a larger number if it is whole" if error.errno == errno.EFBIG else ""
        raise FootageError(f"cannot read {path}: {error.strerror}{more}") from error
    except ValueError as error:
        raise FootageError(f"cannot read {path} as a surface ({kind.upper()}): {error}") from error
    form = MESH_FORMATS[".glb" if kind == "gltf" else f".{kind}"]
    return in_camera_frame(mesh, form.axes, 0.001 if form.unit == "m" and mesh.unit == "mm" else 1.0)
