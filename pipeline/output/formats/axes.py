"""Which way the coordinates of a file point, and what they are measured in.

Everything here is kept in the camera frame of OpenCV, in mm: x right, y down, z away from the camera. A program that
takes y for up shows that upside down, and one that takes the number 1 for a metre shows a face as tall as a tower.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.output.mesh import Mesh


@dataclass(frozen=True)
class Axes:
    """A rotation of the camera frame by right angles."""

    told: str
    """Where x, y and z point."""
    sources: tuple[int, int, int]
    """Of the file's x, y and z: which of the camera frame's each is."""
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


def placed(mesh: Mesh, axes: Axes, scale: float) -> Mesh:
    """Return a mesh as a file has it: turned, and its vertices multiplied."""
    vertices = axes.from_camera(mesh.vertices)
    if scale != 1:
        vertices *= np.float32(scale)
    return replace(mesh, vertices=vertices, normals=None if mesh.normals is None else axes.from_camera(mesh.normals))


def in_camera_frame(mesh: Mesh, axes: Axes, scale: float) -> Mesh:
    """Return a mesh that a file has in the camera frame again; the inverse of `placed`."""
    vertices = axes.to_camera(mesh.vertices)
    if scale != 1:
        vertices /= np.float32(scale)
    return replace(mesh, vertices=vertices, normals=None if mesh.normals is None else axes.to_camera(mesh.normals))
