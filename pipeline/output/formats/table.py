"""Every format that results are written in: the one table that `write_mesh`, `colorphase export` and the docs take.

Installed packages add theirs by entry points: `format_of`.

In memory everything is in the camera frame of OpenCV, in mm: x right, y down, z away from the camera. A program that
takes y for up shows that upside down, and one that takes the number 1 for a metre shows a face as tall as a tower. So
files have the axes and the unit that the users of each format expect: viewers take y for up, printers z; glTF and VRML
are in metres by their standards, robots' programs by custom (REP 103), and all others keep mm.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from hardware.plugins import announced, load, plugin_of
from pipeline.errors import SettingsError
from pipeline.output.formats import Content, Heading
from pipeline.output.formats.camera_grids import (
    CAMERA,
    STEP,
    depth_step_mm,
    encode_depth_png,
    encode_depth_tiff,
    encode_pcd,
)
from pipeline.output.formats.obj_stl_gltf import encode_glb, encode_obj, encode_stl
from pipeline.output.formats.ply import encode_ply
from pipeline.output.formats.point_tables import encode_csv, encode_npz, encode_xyz
from pipeline.output.formats.vrml import encode_vrml
from pipeline.output.mesh import NOT_METRIC, Mesh, RangeGrid

#: The names by which users choose axes, and a unit's length in mm.
AxesName = Literal["y-up", "z-up", "camera"]
UnitName = Literal["mm", "cm", "m", "in"]
MM: dict[str, float] = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4}

#: The group of entry points in which packages announce formats.
GROUP = "colorphase.formats"


@dataclass(frozen=True)
class Axes:
    """A rotation of the camera frame by right angles."""

    directions: str
    """The directions of x, y and z."""
    sources: tuple[int, int, int]
    """Index of the camera frame's axis that each of the file's x, y and z is."""
    signs: tuple[int, int, int]
    """And whether it points the same way (1) or back (-1)."""

    def from_camera(self, vectors: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Turn places or directions, (N, 3), of the camera frame; each keeps its dtype."""
        turned = np.empty_like(vectors)
        for k, (source, sign) in enumerate(zip(self.sources, self.signs, strict=True)):
            np.multiply(vectors[:, source], vectors.dtype.type(sign), out=turned[:, k])
        return turned

    def to_camera(self, vectors: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Turn places or directions, (N, 3), into the camera frame; the inverse of `from_camera`."""
        turned = np.empty_like(vectors)
        turned[:, self.sources] = vectors * np.array(self.signs, vectors.dtype)
        return turned


#: As robots have it: the optical frame of REP 103.
OPTICAL = Axes("x right, y down, z away from the camera", (0, 1, 2), (1, 1, 1))


#: As viewers and glTF have it.
Y_UP = Axes("x right, y up, z towards the camera", (0, 1, 2), (1, -1, -1))


#: As a printer's bed has it.
Z_UP = Axes("x right, y away from the camera, z up", (0, 2, 1), (1, 1, -1))

AXES: dict[AxesName, Axes] = {"y-up": Y_UP, "z-up": Z_UP, "camera": OPTICAL}


def placed(mesh: Mesh, axes: Axes, scale: float) -> Mesh:
    """Return a mesh as a file has it: turned, and its vertices multiplied."""
    vertices = axes.from_camera(mesh.vertices)
    if scale != 1:
        vertices *= np.float32(scale)
    return replace(mesh, vertices=vertices, normals=None if mesh.normals is None else axes.from_camera(mesh.normals))


def in_camera_frame(mesh: Mesh, axes: Axes, unit_mm: float) -> Mesh:
    """Return a mesh that a file has in the camera frame again; the inverse of `placed`."""
    vertices = axes.to_camera(mesh.vertices)
    if unit_mm != 1:
        vertices *= np.float32(unit_mm)
    return replace(mesh, vertices=vertices, normals=None if mesh.normals is None else axes.to_camera(mesh.normals))


@dataclass(frozen=True)
class FileFormat:
    """A format and its encoder, of meshes or of grids; neither: one file holds all frames."""

    meaning: str
    holds: str
    unit: Literal["mm", "m"]
    axes: Axes
    encode_mesh: Callable[[Mesh, Heading], dict[str, Content]] | None = None
    encode_grid: Callable[[RangeGrid, Heading], dict[str, Content]] | None = None
    is_fixed: bool = True
    """True if axes and unit are those of the format's standard or custom, false if its writer chooses them."""

    @property
    def holds_all_frames(self) -> bool:
        """True if one file holds all frames."""
        return self.encode_mesh is None and self.encode_grid is None

    @property
    def has_step(self) -> bool:
        """True if depths are whole numbers of steps, which all frames of a film share."""
        return self.encode_grid in (encode_depth_png, encode_depth_tiff)


_SHAPE = "triangles"


_GRID = "the camera's grid of points, NaN kept"


FORMATS: dict[str, FileFormat] = {
    "ply": FileFormat(
        "Stanford PLY, binary",
        f"{_SHAPE}, normals, colour, flags, sigma, confidence, modulation",
        "mm",
        Y_UP,
        encode_ply,
        is_fixed=False,
    ),
    "obj": FileFormat(
        "Wavefront OBJ, with .mtl and .png",
        f"{_SHAPE}, normals, the texture as a picture",
        "mm",
        Y_UP,
        encode_obj,
        is_fixed=False,
    ),
    "stl": FileFormat("binary STL, for printers", _SHAPE, "mm", Z_UP, encode_stl, is_fixed=False),
    "glb": FileFormat(
        "glTF 2.0 in one binary file", f"{_SHAPE}, normals, the texture as a picture, flags", "m", Y_UP, encode_glb
    ),
    "wrl": FileFormat("VRML 2.0", f"{_SHAPE}, colour", "m", Y_UP, encode_vrml),
    "pcd": FileFormat(
        "Point Cloud Library, organised", f"{_GRID}, colour, sigma, modulation", "m", OPTICAL, None, encode_pcd
    ),
    "png": FileFormat("depth in 16 bits, PNG", "depth by a step that it names", "mm", OPTICAL, None, encode_depth_png),
    "tiff": FileFormat(
        "depth in 16 bits, TIFF", "depth by a step that it names", "mm", OPTICAL, None, encode_depth_tiff
    ),
    "xyz": FileFormat("points, one a line", "measured points, colour", "mm", Y_UP, None, encode_xyz),
    "csv": FileFormat(
        "a table of points", "measured points, colour, sigma, modulation", "mm", OPTICAL, None, encode_csv
    ),
    "npz": FileFormat(
        "NumPy's archive", f"{_GRID}, colour, sigma, modulation, camera", "mm", OPTICAL, None, encode_npz
    ),
    "mcap": FileFormat("ROS 2 bag in MCAP", f"{_GRID}, depth, texture, camera", "m", OPTICAL),
}


#: The kinds that are meshes, by suffix.
MESH_FORMATS = {f".{kind}": form for kind, form in FORMATS.items() if form.encode_mesh is not None}


def format_of(kind: str) -> FileFormat:
    """Return a format by its kind: one of `FORMATS`, or a `FileFormat` that an installed package announces.

    Raises
    ------
    SettingsError
        There is none, several packages announce one, or it cannot be imported.
    """
    plugin = plugin_of(GROUP, kind, FORMATS, SettingsError)
    if plugin is None:
        if kind not in FORMATS:
            raise SettingsError(f"{kind!r} is no format: choose one of {', '.join([*FORMATS, *announced(GROUP)])}")
        return FORMATS[kind]
    form = load(f"format {kind}", plugin, SettingsError)
    if not isinstance(form, FileFormat) or form.holds_all_frames:
        raise SettingsError(f"format {kind}: {plugin} is no FileFormat with an encoder: update that package")
    return form


def encode_as(form: FileFormat, shape: Mesh | RangeGrid, stem: str, farthest_mm: float = 0.0) -> dict[str, Content]:
    """Return the files that a mesh or a grid becomes, by their suffixes.

    Parameters
    ----------
    form : FileFormat
        One that takes this shape.
    shape : Mesh or RangeGrid
        In the camera frame, in mm or rad.
    stem : str
        The files' common name.
    farthest_mm : float
        The largest depth that one step has to hold for all frames of a film, mm.

    Raises
    ------
    OutputError
        The format cannot hold it.
    """
    metric = isinstance(shape, RangeGrid) or shape.unit == "mm"
    remarks = {"unit": form.unit if metric else "rad", "axes": form.axes.directions}
    if not metric:
        remarks["note"] = NOT_METRIC
    remarks |= shape.provenance
    remarks.setdefault("software", f"colorphase {version('colorphase')}")
    if isinstance(shape, Mesh) and form.encode_mesh is not None:
        scale = 0.001 if metric and form.unit == "m" else 1.0
        return form.encode_mesh(placed(shape, form.axes, scale), Heading(stem, remarks))
    if isinstance(shape, RangeGrid) and form.encode_grid is not None:
        if form.has_step:
            remarks[STEP] = f"{depth_step_mm(farthest_mm):g}"
            if shape.camera is not None:
                remarks[CAMERA] = shape.camera.model_dump_json()
        return form.encode_grid(shape, Heading(stem, remarks))
    raise TypeError(f"{form.meaning} is not made of a {type(shape).__name__}")
