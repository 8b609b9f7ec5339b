"""What the colours of a surface show: nothing (clay), something about its vertices, or how far it is from a shape."""

from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np
import numpy.typing as npt

from pipeline.errors import RenderError
from pipeline.output.mesh import Mesh
from pipeline.output.pictures.color_scale import ColorScale
from pipeline.output.pictures.fitted_shapes import plane_deviation, sphere_deviation
from pipeline.output.pictures.lighting import CLAY
from pipeline.output.pictures.object_choice import object_vertices, wall_vertices

Floats = npt.NDArray[np.float32]
Distance = Callable[[Floats], Floats]

Colors = Literal["clay", "depth", "sigma", "texture", "modulation", "plane", "sphere"]

#: Colours that are of a length, and so need a calibration.
IN_MM = ("plane", "sphere")


class SurfaceColors:
    """One meaning of colours for all pictures of a film.

    Parameters
    ----------
    samples : sequence of Mesh
        What tells the limits; of some frames it need not be all, and needs no faces. The limits are those of the
        object, and not of the wall behind it.
    colors : str
        What they show.
    distance : callable, optional
        Signed distance of points, (N, 3), from another mesh, mm, which the colours then show.

    Raises
    ------
    RenderError
        The meshes do not have what the colours would show.
    """

    def __init__(self, samples: Sequence[Mesh], colors: Colors, distance: Distance | None = None) -> None:
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
        self.scale = ColorScale.over(
            values,
            name,
            unit,
            diverging=deviation,
            from_zero=colors == "sigma",
            grey_beyond=not all(some.all() for some in chosen) and colors != "sigma",
        )

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
