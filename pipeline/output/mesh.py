"""The shapes that files hold: a triangle mesh, the camera's grid of points in mm, and how either was made."""

import json
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from pipeline.calibration.lens import Lens
from pipeline.showing import to_html
from pipeline.text import one_line
from tikernels.errors import ShapeError

Unit = Literal["mm", "rad"]

#: The note in files of a mesh in rad.
NOT_METRIC = "not metric: z is relative phase, x and y are px"
#: Names of a vertex's coordinates, of its normal's and of its colour's channels, and of its flags, which no other
#: property of it may have.
POSITION = ("x", "y", "z")
NORMAL = ("nx", "ny", "nz")
COLOR = ("red", "green", "blue")
FLAGS = "flags"
#: Bits of a vertex's flags; without any it lies where the pixel was measured.
SMOOTHED, FILLED, RIM = 1, 2, 4
RESERVED = (*POSITION, *NORMAL, *COLOR, FLAGS)
#: The entries of a mesh's provenance; see `provenance_of`.
PROVENANCE = ("software", "source", "frame", "time_s", "calibration_sha256", "settings")


def flag_counts(flags: npt.NDArray[np.uint8]) -> dict[str, int]:
    """Return how many vertices were smoothed, filled in holes, and moved to a rim."""
    in_holes = flags & (FILLED | RIM) == FILLED
    kinds = {"smoothed": flags & SMOOTHED, "filled": in_holes, "rim": flags & RIM}
    return {name: int(np.count_nonzero(there)) for name, there in kinds.items()}


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
        The unit of z.
    normals : (N, 3) float32, optional
        Unit vectors across the surface, towards the camera.
    flags : (N,) uint8, optional
        Properties of each vertex that were not measured: bits `SMOOTHED` (1: moved along its pixel's ray to the surface
        through its neighbours) and `FILLED` (2: nothing was measured there: the surface around a small hole continues,
        or, with `RIM` (4), the vertex has moved along the surface, by less than half a pixel, to the line in which that
        ends).
    texture : (H, W, 3) uint8, optional
        sRGB: a picture that the surface wears; `colors` are its colours at the vertices.
    pixels : (N, 2) float32, optional
        Position of each vertex in the texture: x and y of the camera's pixel, px, 0 at the middle of the first one.
    provenance : dict of str
        The mesh's provenance: version, settings, calibration, frame, time; kept by every format that has room for it.

    Raises
    ------
    ShapeError
        If the arrays do not fit together, or a vertex is not finite.

    Examples
    --------
    >>> rig = colorphase.simulated_rig((160, 120), period_px=64)
    >>> sheet = colorphase.simulate_frame(rig, colorphase.SimulationSettings(scene="plane"))
    >>> frame = colorphase.Decoder(calibration=rig, arch="cpu").decode(sheet.image)
    >>> mesh = colorphase.frame_mesh(frame)
    >>> f"{len(mesh.vertices)} vertices, {np.median(mesh.vertices[:, 2]):.0f} mm away"
    '19200 vertices, 900 mm away'
    """

    vertices: npt.NDArray[np.float32]
    faces: npt.NDArray[np.int32]
    colors: npt.NDArray[np.uint8] | None = None
    properties: dict[str, npt.NDArray[np.float32]] = field(default_factory=dict)
    unit: Unit = "mm"
    normals: npt.NDArray[np.float32] | None = None
    flags: npt.NDArray[np.uint8] | None = None
    texture: npt.NDArray[np.uint8] | None = None
    pixels: npt.NDArray[np.float32] | None = None
    provenance: dict[str, str] = field(default_factory=dict)

    def __repr__(self) -> str:
        known = f", {' '.join(self.properties)}" if self.properties else ""
        return f"Mesh({len(self.vertices)} vertices, {len(self.faces)} faces, {self.unit}{known})"

    def __post_init__(self) -> None:
        count = len(self.vertices)
        wanted: list[tuple[str, npt.NDArray[Any], tuple[int, ...], type]] = [
            ("vertices", self.vertices, (count, 3), np.float32),
            ("faces", self.faces, (len(self.faces), 3), np.int32),
            *((f"property {name}", values, (count,), np.float32) for name, values in self.properties.items()),
        ]
        if self.colors is not None:
            wanted.append(("colors", self.colors, (count, 3), np.uint8))
        if self.normals is not None:
            wanted.append(("normals", self.normals, (count, 3), np.float32))
        if self.flags is not None:
            wanted.append(("flags", self.flags, (count,), np.uint8))
        if self.pixels is not None:
            wanted.append(("pixels", self.pixels, (count, 2), np.float32))
        if self.texture is not None:
            wanted.append(("texture", self.texture, (*self.texture.shape[:2], 3), np.uint8))
            if self.pixels is None:
                raise ShapeError("texture: give the vertices' pixels in it, too")
        for name, values, shape, dtype in wanted:
            if values.shape != shape or values.dtype != dtype:
                raise ShapeError(f"{name}: got shape {values.shape} {values.dtype}, expected {shape} {np.dtype(dtype)}")
        for name in self.properties:
            if not name.isascii() or name.split() != [name] or name in RESERVED:
                raise ShapeError(f"property {name!r}: expected one plain word other than {', '.join(RESERVED)}")
        if self.unit not in get_args(Unit):
            raise ShapeError(f"unit: got {self.unit!r}, expected 'mm' or 'rad'")
        if not np.isfinite(self.vertices).all():
            raise ShapeError("vertices: some are not finite; leave masked pixels out of the mesh")
        if self.faces.size and not (self.faces.min() >= 0 and self.faces.max() < count):
            raise ShapeError(f"faces: got corners {self.faces.min()} to {self.faces.max()} of {count} vertices")

    def _repr_html_(self) -> str | None:
        return to_html(self)

    def vertices_at(self, kept: npt.NDArray[np.intp]) -> dict[str, Any]:
        """Return all that is known of some vertices, by the names of the parameters, without the faces."""
        arrays = {
            name: None if (values := getattr(self, name)) is None else values[kept]
            for name in ("vertices", "colors", "normals", "flags", "pixels")
        }
        return {**arrays, "properties": {name: values[kept] for name, values in self.properties.items()}}

    def texture_places(self) -> npt.NDArray[np.float64]:
        """Return where each vertex is in the texture, (N, 2): 0 at its left and top edge, 1 at the right and bottom.

        Raises
        ------
        ShapeError
            It has no texture.
        """
        if self.texture is None or self.pixels is None:
            raise ShapeError("this mesh has no texture")
        height, width = self.texture.shape[:2]
        return np.asarray((self.pixels + 0.5) / (width, height), np.float64)


def vertex_normals(mesh: Mesh) -> npt.NDArray[np.float32]:
    """Return a mesh's normals: its own, or means of those of the triangles around each vertex, weighted by their area.

    Returns
    -------
    (N, 3) float32
        Unit vectors on the side from which corners run counter-clockwise; (0, 0, 1) for a vertex without a surface.
    """
    if mesh.normals is not None:
        return mesh.normals
    corners = mesh.faces.ravel()
    across = np.repeat(face_normals(mesh), 3, axis=0)
    sums = np.stack([np.bincount(corners, axis, len(mesh.vertices)) for axis in across.T], axis=1)
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    return np.where(lengths > 0, sums / np.where(lengths > 0, lengths, 1), (0, 0, 1)).astype(np.float32)


def face_normals(mesh: Mesh) -> npt.NDArray[np.float32]:
    """Return a normal a triangle, (M, 3), as long as twice its area."""
    first, second, third = (mesh.vertices[corner] for corner in mesh.faces.T)
    return np.cross(second - first, third - first)


@dataclass(frozen=True, eq=False)
class RangeGrid:
    """A frame's places in mm, pixel by pixel."""

    points: npt.NDArray[np.float32]
    """(H, W, 3), mm, camera frame; NaN where nothing was measured."""
    texture: npt.NDArray[np.uint8] | None = None
    """(H, W, 3), sRGB."""
    properties: dict[str, npt.NDArray[np.float32]] = field(default_factory=dict)
    """More about each pixel, (H, W), by the names that meshes' vertices have."""
    camera: Lens | None = None
    """None: a store of a version that did not keep it."""
    time_s: float = 0.0
    """Since the first frame, or since 1970 where the footage states when it was taken."""
    provenance: dict[str, str] = field(default_factory=dict)
    """Provenance; see `provenance_of`."""

    @classmethod
    def of_records(cls, records: npt.NDArray[np.void]) -> "RangeGrid":
        """Return the grid that robots' programs hold as (H, W) records, of numbers of any kind; see `records`.

        A place that is not finite, or not in front of the camera, is none.

        Raises
        ------
        ValueError
            It has no rows and columns, or its points no x, y and z.
        """
        height, width = records.shape
        if min(width, height) < 2:
            raise ValueError(f"its {width} times {height} points are no grid: an organised cloud has rows and columns")
        names = records.dtype.names or ()
        if not {*"xyz"} <= {*names}:
            raise ValueError("its points have no x, y and z")
        with np.errstate(over="ignore"):
            points = np.stack([records[axis].astype(np.float32) for axis in "xyz"], axis=-1) * np.float32(1000)
        points[~(np.isfinite(points).all(axis=-1) & (points[..., 2] > 0))] = np.nan
        properties = {
            name: np.ascontiguousarray(records[name], np.float32) for name in names if _is_property(records, name)
        }
        return cls(points, _colors(records), properties)

    @property
    def depth(self) -> npt.NDArray[np.float32]:
        """(H, W) float32, mm."""
        return self.points[..., 2]

    def records(self) -> npt.NDArray[np.void]:
        """Return the grid as robots' programs have it: (H, W) records of x, y, z, rgb and the properties, float32.

        Places are in m; a colour is the bits 0x00RRGGBB. What was not measured is NaN, and black.
        """
        kinds = [(name, "<f4") for name in (*"xyz", *([] if self.texture is None else ["rgb"]), *self.properties)]
        records = np.empty(self.points.shape[:2], kinds)
        for axis, name in enumerate("xyz"):
            records[name] = self.points[..., axis] * np.float32(0.001)
        if self.texture is not None:
            red, green, blue = (self.texture[..., color].astype(np.uint32) for color in range(3))
            records["rgb"] = (red << 16 | green << 8 | blue).view(np.float32)
        for name, values in self.properties.items():
            records[name] = values
        return records


def _is_property(records: npt.NDArray[np.void], name: str) -> bool:
    """Return whether a field is one number, and no position, colour, or padding between fields."""
    return records[name].ndim == 2 and name not in (*"xyz", "rgb", "rgba", *RESERVED) and not name.startswith("_")


def _colors(records: npt.NDArray[np.void]) -> npt.NDArray[np.uint8] | None:
    """Return the colours of points, whose bits are 0x00RRGGBB; None: they have none."""
    name = next((name for name in ("rgb", "rgba") if name in (records.dtype.names or ())), None)
    if name is None:
        return None
    bits = np.ascontiguousarray(records[name])
    bits = bits.view(np.uint32) if bits.dtype == np.float32 else bits.astype(np.uint32)
    return np.stack([bits >> 16, bits >> 8, bits], axis=-1).astype(np.uint8)


def provenance_of(attributes: dict[str, Any], number: int | None = None, time_s: float | None = None) -> dict[str, str]:
    """Return how a frame was decoded, as names and lines of text.

    Parameters
    ----------
    attributes : dict
        Those of its store or report.
    number : int, optional
        The frame, of footage.
    time_s : float, optional
        Its time, s.
    """
    said = {"software": f"colorphase {attributes['colorphase_version']}"}
    source = attributes.get("source", attributes.get("footage", {}).get("name"))
    if source is not None:
        said["source"] = str(source)
    if number is not None:
        said["frame"] = str(number)
    if time_s is not None:
        said["time_s"] = f"{time_s:.6f}"
    if attributes.get("calibration_sha256") is not None:
        said["calibration_sha256"] = attributes["calibration_sha256"]
    # The settings that are not None; all of them are in the store.
    said["settings"] = json.dumps({name: value for name, value in attributes["settings"].items() if value is not None})
    return {name: one_line(str(value)) for name, value in said.items()}
