"""Meshes to files that other programs open, and back."""

import errno
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.errors import FootageError, OutputError, SettingsError
from pipeline.files import write_atomically
from pipeline.limits import MAX_PIXELS, max_pixels, open_plain, read_plain
from pipeline.output.formats.camera_grids import decode_depth, decode_pcd
from pipeline.output.formats.obj_stl_gltf import READ_SUFFIXES, read_foreign
from pipeline.output.formats.ply import decode_ply
from pipeline.output.formats.ros_bag import read_bag
from pipeline.output.formats.table import (
    AXES,
    FORMATS,
    MESH_FORMATS,
    MM,
    AxesName,
    FileFormat,
    UnitName,
    encode_as,
    format_of,
    in_camera_frame,
)
from pipeline.output.formats.vrml import decode_vrml
from pipeline.output.mesh import PROVENANCE, Mesh
from pipeline.output.surface_mesh import grid_mesh

_DECODERS = {"ply": decode_ply, "wrl": decode_vrml}
_GRID_DECODERS = {"pcd": decode_pcd, "png": decode_depth, "tiff": decode_depth, "tif": decode_depth}
_BAG = "mcap"
_POINTS = ("xyz", "csv", "npz")
_FORMS: dict[str, FileFormat] = FORMATS | {"gltf": FORMATS["glb"], "tif": FORMATS["tiff"]}
# A vertex and its two triangles take about 150 bytes as text, and colours and normals some more.
_BYTES_A_PIXEL = 250


def write_mesh(mesh: Mesh, path: str | Path) -> None:
    """Write a mesh in the format that the file's suffix names.

    Parameters
    ----------
    mesh : Mesh
        The mesh; `pipeline.output.formats.table` lists what each format keeps of it, and which way is up there.
    path : str or Path
        A .ply, .obj, .stl, .glb or .wrl file, or of a format that an installed package announces. An OBJ file with a
        texture has an .mtl and a .png next to it.

    Raises
    ------
    OutputError
        If the suffix is unknown, the file cannot be written, or the mesh is empty and the format glTF.

    Examples
    --------
    >>> rig = colorphase.simulated_rig((160, 120), period_px=64)
    >>> sheet = colorphase.simulate_frame(rig, colorphase.SimulationSettings(scene="plane"))
    >>> frame = colorphase.Decoder(calibration=rig, arch="cpu").decode(sheet.image)
    >>> colorphase.write_mesh(colorphase.frame_mesh(frame), "face.ply")
    >>> f"{np.median(colorphase.read_mesh('face.ply').vertices[:, 2]):.0f} mm"
    '900 mm'
    """
    path = Path(path)
    try:
        form = format_of(path.suffix.lower()[1:])
    except SettingsError as error:
        raise OutputError(f"cannot write {path}: {error}") from None
    if form.encode_mesh is None:
        raise OutputError(f"cannot write {path}: {form.meaning} is no format of meshes, use {', '.join(MESH_FORMATS)}")
    files = encode_as(form, mesh, path.stem)
    own = path.suffix.lower()
    # What a file names is there before it.
    for suffix in sorted(files, key=lambda suffix: suffix == own):
        write_atomically(path if suffix == own else path.with_suffix(suffix), files[suffix])


def read_mesh(
    path: str | Path, frame: int | None = None, *, axes: AxesName | None = None, unit: UnitName | None = None
) -> Mesh:
    """Read a mesh of triangles, or a camera's grid of points, which becomes one.

    Parameters
    ----------
    path : str or Path
        A mesh: PLY, OBJ, STL, glTF or VRML. A grid: organised PCD, depth as a PNG or TIFF of 16 bits that states its
        step and its camera, or a bag, as an MCAP file. What has another suffix is read as PLY.
    frame : int, optional
        Index of a bag's frame, from 0; may be omitted for a bag of one frame, and must be for other files.
    axes : {"y-up", "z-up", "camera"}, optional
        Directions of the file's axes: `pipeline.output.formats.table.AXES`. If omitted, as stated in the file, as in
        those of `write_mesh` and `colorphase export`; else as `write_mesh` writes the format.
    unit : {"mm", "cm", "m", "in"}, optional
        Unit of its numbers. If omitted, likewise.

    Returns
    -------
    Mesh
        In the camera frame. Of a PLY, PCD or MCAP file with every property of the vertices; of others with colours. The
        points of a grid are joined as a frame's pixels are (`frame_mesh`).

    Raises
    ------
    FootageError
        If the file is missing, truncated, or holds nothing of the kind.

    Examples
    --------
    >>> rig = colorphase.simulated_rig((160, 120), period_px=64)
    >>> sheet = colorphase.simulate_frame(rig, colorphase.SimulationSettings(scene="plane"))
    >>> frame = colorphase.Decoder(calibration=rig, arch="cpu").decode(sheet.image)
    >>> colorphase.frame_mesh(frame).unit
    'mm'
    >>> frame.save("face.glb")
    >>> f"{np.median(colorphase.read_mesh('face.glb').vertices[:, 2]):.0f} mm"  # the file has metres
    '900 mm'
    """
    return read_placed(path, frame, axes, unit)[0]


# Numbers beyond float32 become infinite or NaN, which a mesh refuses.
@np.errstate(over="ignore", divide="ignore", invalid="ignore")
def read_placed(
    path: str | Path, frame: int | None = None, axes: AxesName | None = None, unit: UnitName | None = None
) -> tuple[Mesh, bool]:
    """Read a mesh as `read_mesh` does; and return whether its axes and its unit are known, or only usual."""
    path = Path(path)
    kind = path.suffix.lower()[1:]
    if kind not in (*_POINTS, *_DECODERS, *_GRID_DECODERS, _BAG) and f".{kind}" not in READ_SUFFIXES:
        kind = "ply"
    most = _BYTES_A_PIXEL * max_pixels()
    try:
        if kind in _POINTS:
            raise ValueError("it holds points alone: give a mesh, or export the same as pcd, which keeps the grid")
        if frame is not None and kind != _BAG:
            raise ValueError(f"it holds one frame: leave out frame {frame}")
        if kind in (*_GRID_DECODERS, _BAG):
            if kind == _BAG:
                open_plain(path).close()
            grid = read_bag(path, frame) if kind == _BAG else _GRID_DECODERS[kind](read_plain(path, most))
            if axes not in (None, "camera"):
                raise ValueError("a camera's grid has the camera's axes: leave out others")
            if unit is not None:
                usual = MM[_FORMS[kind].unit]
                grid = replace(grid, points=grid.points * np.float32(MM[unit] / usual))
            return grid_mesh(grid), True
        mesh, said = _DECODERS[kind](read_plain(path, most)) if kind in _DECODERS else read_foreign(path, most)
        in_rad = said.get("unit") == "rad"
        if in_rad and (axes or unit):
            raise ValueError("it is in rad, not in mm: decode with a calibration")
        form = _FORMS[kind]
        stated = next((each for each in AXES.values() if each.directions == said.get("axes")), None)
        known = form.is_fixed or ((axes or stated) and (unit or said.get("unit") in (*MM, "rad")))
        about = {name: value for name, value in said.items() if name in PROVENANCE}
        mesh = replace(mesh, unit="rad" if in_rad else "mm", provenance=about)
        length_mm = MM[unit] if unit else 1.0 if in_rad else MM.get(said.get("unit", ""), MM[form.unit])
        return in_camera_frame(mesh, AXES[axes] if axes else stated or form.axes, length_mm), bool(known)
    except OSError as error:
        more = f": set {MAX_PIXELS} to a larger number if it is whole" if error.errno == errno.EOVERFLOW else ""
        raise FootageError(f"cannot read {path}: {error.strerror}{more}") from error
    except ValueError as error:
        raise FootageError(f"cannot read {path} as a surface ({kind.upper()}): {error}") from error
    except MemoryError as error:
        raise FootageError(f"cannot read {path}: its stated content does not fit into memory") from error
