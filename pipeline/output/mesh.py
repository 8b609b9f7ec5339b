"""A triangle mesh, as decoded frames become and files hold."""

from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from pipeline.showing import to_html

Unit = Literal["mm", "rad"]

#: What files say of a mesh in rad.
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
#: What a mesh may say of how it was made (`pipeline.output.provenance`).
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
        What z is measured in.
    normals : (N, 3) float32, optional
        Unit vectors across the surface, towards the camera.
    flags : (N,) uint8, optional
        What of each vertex was not measured: bits `SMOOTHED` (1: moved along its pixel's ray to the surface through its
        neighbours) and `FILLED` (2: nothing was measured there: the surface around a small hole goes on, or, with `RIM`
        (4), the vertex has moved along the surface, by less than half a pixel, to the line in which that ends).
    texture : (H, W, 3) uint8, optional
        sRGB: a picture that the surface wears; `colors` are its colours at the vertices.
    pixels : (N, 2) float32, optional
        Where each vertex is in the texture: x and y of the camera's pixel, px, 0 at the middle of the first one.
    provenance : dict of str
        How the mesh was made: version, settings, calibration, frame, time; kept by every format that has room for it.

    Raises
    ------
    ValueError
        If the arrays do not fit together, or a vertex is not finite.
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
                raise ValueError("texture: give the vertices' pixels in it, too")
        for name, values, shape, dtype in wanted:
            if values.shape != shape or values.dtype != dtype:
                raise ValueError(f"{name}: got {values.shape} {values.dtype}, expected {shape} {np.dtype(dtype)}")
        for name in self.properties:
            if not name.isascii() or name.split() != [name] or name in RESERVED:
                raise ValueError(f"property {name!r}: expected one plain word other than {', '.join(RESERVED)}")
        if self.unit not in get_args(Unit):
            raise ValueError(f"unit: got {self.unit!r}, expected 'mm' or 'rad'")
        if not np.isfinite(self.vertices).all():
            raise ValueError("vertices: some are not finite; leave masked pixels out of the mesh")
        if self.faces.size and not (self.faces.min() >= 0 and self.faces.max() < count):
            raise ValueError(f"faces: got corners {self.faces.min()} to {self.faces.max()} of {count} vertices")

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
        ValueError
            It has no texture.
        """
        if self.texture is None or self.pixels is None:
            raise ValueError("this mesh has no texture")
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


def metres_a_unit(mesh: Mesh) -> float:
    """Return by what to multiply coordinates to get metres; a mesh in rad has none, and keeps its numbers."""
    return 0.001 if mesh.unit == "mm" else 1.0
