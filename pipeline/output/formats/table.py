"""Every format that results are written in: the one table that `write_mesh`, `colorphase export` and the docs take.

Which way is up, and which unit is used, is what the users of each format expect: viewers take y for up, printers z;
glTF and VRML are in metres by their standards, robots' programs by custom (REP 103), and all others keep mm.
"""

from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from typing import Literal

from pipeline.output.formats.axes import OPTICAL, Y_UP, Z_UP, Axes, placed
from pipeline.output.formats.depth_picture import CAMERA, STEP, depth_step_mm, encode_depth_png, encode_depth_tiff
from pipeline.output.formats.file_text import Content, Heading
from pipeline.output.formats.gltf import encode_glb
from pipeline.output.formats.obj import encode_obj
from pipeline.output.formats.pcd import encode_pcd
from pipeline.output.formats.ply import encode_ply
from pipeline.output.formats.stl import encode_stl
from pipeline.output.formats.vrml import encode_vrml
from pipeline.output.mesh import NOT_METRIC, Mesh
from pipeline.output.range_grid import RangeGrid

Kind = Literal["ply", "obj", "stl", "glb", "wrl", "pcd", "png", "tiff", "mcap"]


@dataclass(frozen=True)
class FileFormat:
    """What a format is, and who makes it: a mesh's encoder, or a grid's; neither: one file holds all frames."""

    meaning: str
    holds: str
    unit: Literal["mm", "m"]
    axes: Axes
    encode_mesh: Callable[[Mesh, Heading], dict[str, Content]] | None = None
    encode_grid: Callable[[RangeGrid, Heading], dict[str, Content]] | None = None

    @property
    def holds_all_frames(self) -> bool:
        """Whether one file holds all frames."""
        return self.encode_mesh is None and self.encode_grid is None

    @property
    def has_step(self) -> bool:
        """Whether depths are whole numbers of steps, which one film has in common."""
        return self.encode_grid in (encode_depth_png, encode_depth_tiff)


_SHAPE = "triangles"
_GRID = "the camera's grid of points, NaN kept"
FORMATS: dict[Kind, FileFormat] = {
    "ply": FileFormat(
        "Stanford PLY, binary",
        f"{_SHAPE}, normals, colour, flags, sigma, confidence, modulation",
        "mm",
        Y_UP,
        encode_ply,
    ),
    "obj": FileFormat(
        "Wavefront OBJ, with .mtl and .png", f"{_SHAPE}, normals, the texture as a picture", "mm", Y_UP, encode_obj
    ),
    "stl": FileFormat("binary STL, for printers", _SHAPE, "mm", Z_UP, encode_stl),
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
    "mcap": FileFormat("ROS 2 bag in MCAP", f"{_GRID}, depth, texture, camera", "m", OPTICAL),
}
#: The kinds that are meshes, by suffix.
MESH_FORMATS = {f".{kind}": form for kind, form in FORMATS.items() if form.encode_mesh is not None}


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
    remarks = {"unit": form.unit if metric else "rad", "axes": form.axes.told}
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
