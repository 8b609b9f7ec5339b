"""Meanings of a surface's colours: none (clay), a property of its vertices, or their distance from a shape.

The shape is a plane or a sphere fitted to the points, some of which lie elsewhere, or another mesh.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from pipeline.errors import RenderError
from pipeline.output.background import object_vertices, wall_vertices
from pipeline.output.mesh import Mesh
from pipeline.output.pictures.picture_overlay import Colormap, ColorScale
from pipeline.output.pictures.viewpoint import CLAY
from pipeline.robust import fit_plane, fit_sphere

Floats = npt.NDArray[np.float32]
Points = npt.NDArray[np.floating]
Distance = Callable[[Floats], Floats]

Colors = Literal["clay", "depth", "sigma", "texture", "modulation", "plane", "sphere"]

#: Colours that are of a length, and so need a calibration.
IN_MM = ("plane", "sphere")


class SurfaceColors:
    """One meaning of colours for all pictures of a film.

    Parameters
    ----------
    samples : sequence of Mesh
        Meshes that set the limits; of some frames it need not be all, and needs no faces. The limits are those of the
        object, and not of the wall behind it.
    colors : str
        What they show.
    distance : callable, optional
        Signed distance of points, (N, 3), from another mesh, mm, which the colours then show.
    limits : (float, float), optional
        The least and the largest value that has a colour of its own; left out, by the samples.
    colormap : str, optional
        Which colours; left out, as the meaning needs.

    Raises
    ------
    RenderError
        The meshes do not have what the colours would show.
    """

    def __init__(
        self,
        samples: Sequence[Mesh],
        colors: Colors,
        distance: Distance | None = None,
        limits: tuple[float, float] | None = None,
        colormap: Colormap | None = None,
    ) -> None:
        self._colors, self._distance = colors, distance
        self.scale: ColorScale | None = None
        for sample in samples[:1]:
            self._refuse(sample)
        if distance is None and colors in ("clay", "texture"):
            return
        chosen = [object_vertices(mesh) for mesh in samples]
        values = np.concatenate([self._values(mesh)[some] for mesh, some in zip(samples, chosen, strict=True)])
        deviation = distance is not None or colors in IN_MM
        name, unit = self._name(samples[0])
        scale = ColorScale.over(
            values,
            name,
            unit,
            diverging=deviation,
            from_zero=colors == "sigma",
            grey_beyond=not all(some.all() for some in chosen) and colors != "sigma",
        )
        low, high = (scale.low, scale.high) if limits is None else limits
        beyond = scale.grey_beyond and limits is None
        self.scale = replace(scale, low=low, high=high, colormap=colormap, grey_beyond=beyond)

    def of(self, mesh: Mesh) -> npt.NDArray[np.uint8]:
        """Return the sRGB in full light of each vertex, (N, 3); or of all of them, (3,)."""
        if self.scale is not None:
            return self.scale.colors(self._values(mesh))
        if self._colors == "texture" and mesh.colors is not None:
            return mesh.colors
        return CLAY.astype(np.uint8)

    def _values(self, mesh: Mesh) -> Floats:
        if self._distance is not None:
            return self._distance(mesh.vertices)
        if self._colors == "depth":
            return mesh.vertices[:, 2]
        if self._colors == "plane":
            wall = wall_vertices(mesh)
            return plane_deviation(mesh.vertices[wall] if wall.any() else mesh.vertices, mesh.vertices)
        if self._colors == "sphere":
            return sphere_deviation(mesh.vertices[object_vertices(mesh)], mesh.vertices)
        return mesh.properties[_property(self._colors, mesh.unit)]

    def _refuse(self, mesh: Mesh) -> None:
        """Refuse what cannot be shown."""
        name = _property(self._colors, mesh.unit)
        if self._colors in ("sigma", "modulation") and name not in mesh.properties:
            raise RenderError(
                f"--colors {self._colors}: the mesh holds no {name}: use --colors clay, or a PLY file of colorphase"
            )
        if self._colors == "texture" and mesh.colors is None:
            raise RenderError("--colors texture: the mesh has no colours: use --colors clay")
        if mesh.unit == "rad" and (self._distance is not None or self._colors in IN_MM):
            raise RenderError("a deviation in mm needs a mesh in mm: decode with a calibration")

    def _name(self, mesh: Mesh) -> tuple[str, str]:
        """Return what the values are, and in what unit."""
        if self._distance is not None:
            return "deviation", "mm"
        if self._colors in IN_MM:
            return f"from {self._colors}", "mm"
        if self._colors == "modulation":
            return "modulation", "levels"
        unit = "mm" if mesh.unit == "mm" else "rad"
        return ("relative phase" if self._colors == "depth" and unit == "rad" else self._colors), unit


def _property(colors: str, unit: str) -> str:
    return f"sigma_{unit}" if colors == "sigma" else colors


def plane_deviation(points: Points, shown: Points) -> npt.NDArray[np.float32]:
    """Return how far points lie from a plane fitted to others, mm; more than 0 before it, towards the camera.

    Parameters
    ----------
    points : (M, 3) float
        What the plane is fitted to by least squares, without those far from it.
    shown : (N, 3) float
        The points.

    Raises
    ------
    RenderError
        Fewer than 3 points.
    """
    middle, normal = fit_plane(_enough(points, 3, "a plane"))
    return np.asarray((shown - middle) @ (-normal if normal[2] > 0 else normal), np.float32)


def sphere_deviation(points: Points, shown: Points) -> npt.NDArray[np.float32]:
    """Return how far points lie from a sphere fitted to others, mm; more than 0 outside it.

    Parameters
    ----------
    points : (M, 3) float
        What the sphere is fitted to by least squares, without those far from it.
    shown : (N, 3) float
        The points.

    Raises
    ------
    RenderError
        Fewer than 4 points, or they are flat.
    """
    sphere = fit_sphere(_enough(points, 4, "a sphere"))
    if sphere is None:
        raise RenderError("a sphere cannot be fitted: the surface is flat, use the colours of a plane")
    centre, radius = sphere
    return np.asarray(np.linalg.norm(shown - centre, axis=1) - radius, np.float32)


def _enough(points: Points, least: int, what: str) -> npt.NDArray[np.float64]:
    if len(points) < least:
        raise RenderError(f"{what} cannot be fitted to {len(points)} points: use other colours")
    return points.astype(np.float64)


def check_boxes(points: Floats, others: Floats) -> str | None:
    """Return a remark where the boxes around two surfaces do not overlap; None: they do.

    Raises
    ------
    RenderError
        They are farther apart than the first one is large; distances would be of no use, and take minutes.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    gaps = np.maximum(low - others.max(axis=0), others.min(axis=0) - high)
    apart_mm = float(np.linalg.norm(np.maximum(gaps, 0)))
    note = (
        f"the boxes of the two surfaces are {apart_mm:.4g} mm apart: if one has other axes or another unit, say so "
        "by --compare-axes and --compare-unit, or --axes and --unit"
    )
    if apart_mm > float(np.linalg.norm(high - low)):
        raise RenderError(note)
    return note if apart_mm > 0 else None


def distance_from(mesh: Mesh) -> Callable[[Floats], Floats]:
    """Return a function for the signed distance of points, (N, 3), from a mesh, mm.

    It is that of the mesh's nearest point, and more than 0 on the side that its normals point to: before a surface that
    was measured, towards the camera. Beyond its rim it is that of the rim.

    Raises
    ------
    RenderError
        The mesh is not in mm, or has no faces.
    """
    if mesh.unit != "mm" or not len(mesh.faces):
        raise RenderError("--compare needs a mesh of triangles in mm")
    import pyvista  # slow to import

    surface = pyvista.PolyData.from_regular_faces(mesh.vertices, mesh.faces)

    def distance(points: Floats) -> Floats:
        compared = pyvista.PolyData(points).compute_implicit_distance(surface)
        return np.asarray(compared.point_data["implicit_distance"], np.float32)

    return distance
