"""How far points are from a mesh; by VTK, so only for a child process."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from pipeline.errors import RenderError
from pipeline.output.mesh import Mesh

Floats = npt.NDArray[np.float32]


def distance_from(mesh: Mesh) -> Callable[[Floats], Floats]:
    """Return a function that tells the signed distance of points, (N, 3), from a mesh, mm.

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
