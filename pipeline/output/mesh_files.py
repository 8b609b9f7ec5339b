"""Meshes to files that other programs open, and back."""

from pathlib import Path

from pipeline.errors import FootageError, OutputError
from pipeline.files import write_atomically
from pipeline.output.formats.axes import in_camera_frame
from pipeline.output.formats.mesh_reading import READ_SUFFIXES, read_foreign
from pipeline.output.formats.pcd import decode_pcd
from pipeline.output.formats.ply import decode_ply
from pipeline.output.formats.table import MESH_FORMATS, encode_as
from pipeline.output.formats.vrml import decode_vrml
from pipeline.output.mesh import Mesh
from pipeline.output.surface_mesh import grid_mesh

_DECODERS = {"ply": decode_ply, "wrl": decode_vrml}


def write_mesh(mesh: Mesh, path: str | Path) -> None:
    """Write a mesh in the format that the file's suffix names.

    Parameters
    ----------
    mesh : Mesh
        What to write; `pipeline.output.formats.table` says what each format keeps of it, and which way is up there.
    path : str or Path
        A .ply, .obj, .stl, .glb, .gltf or .wrl file. An OBJ file with a texture has an .mtl and a .png beside it.

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


def read_mesh(path: str | Path) -> Mesh:
    """Read a mesh of triangles: PLY, binary or ASCII, OBJ, STL, glTF, VRML; or an organised PCD, which becomes one.

    Parameters
    ----------
    path : str or Path
        The file. Its unit and which way is up there are taken to be what `write_mesh` has written: what has another
        suffix is read as PLY.

    Returns
    -------
    Mesh
        In the camera frame. Of a PLY or PCD file with every property of the vertices; of others with colours. A PCD's
        grid is joined as a frame's pixels are (`frame_mesh`).

    Raises
    ------
    FootageError
        If the file is missing, truncated, or holds nothing of the kind.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    kind = suffix[1:] if suffix in (*READ_SUFFIXES, ".pcd", ".wrl") else "ply"
    try:
        if kind == "pcd":
            return grid_mesh(decode_pcd(path.read_bytes()))
        if kind in _DECODERS:
            mesh = _DECODERS[kind](path.read_bytes())
        else:
            mesh = read_foreign(path)
    except OSError as error:
        raise FootageError(f"cannot read {path}: {error.strerror}") from error
    except ValueError as error:
        raise FootageError(f"cannot read {path} as a {kind.upper()} mesh: {error}") from error
    form = MESH_FORMATS[f".{kind}"]
    return in_camera_frame(mesh, form.axes, 0.001 if form.unit == "m" and mesh.unit == "mm" else 1.0)
