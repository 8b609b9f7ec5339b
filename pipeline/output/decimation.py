"""Fewer triangles, by VTK's progressive decimation.

It takes vertices away, those nearest to the plane of their neighbours or to the line of a rim first, and closes what is
left with triangles [1]; whole pieces go where nothing else is left to take. It moves none and makes none, so every
vertex of the result lies where it lay, with its normal, its standard deviation and its flags. (Quadric decimation fits
surfaces somewhat better, but puts new vertices where nothing was measured.)

References
----------
1. W. J. Schroeder, J. A. Zarge, W. E. Lorensen, Decimation of triangle meshes, SIGGRAPH 1992,
   doi:10.1145/133994.134010.
"""

from dataclasses import replace

import numpy as np

from pipeline.output.mesh import Mesh


def decimate_mesh(mesh: Mesh, max_triangles: int) -> Mesh:
    """Return a mesh with few triangles, whose vertices are some of its own.

    Parameters
    ----------
    mesh : Mesh
        Left as it is.
    max_triangles : int
        How many the result may have; a mesh that has no more is returned itself.

    Raises
    ------
    ValueError
        The number is less than one.
    """
    if max_triangles < 1:
        raise ValueError(f"max_triangles: got {max_triangles}, expected 1 or more")
    if len(mesh.faces) <= max_triangles:
        return mesh
    import pyvista  # slow to import, and seldom needed

    surface = pyvista.PolyData.from_regular_faces(mesh.vertices, mesh.faces)
    surface.point_data["number"] = np.arange(len(mesh.vertices), dtype=np.int32)
    # Splitting would make two vertices of one.
    fewer = surface.decimate_pro(1 - max_triangles / len(mesh.faces), splitting=False)
    kept, corners = np.unique(fewer.point_data["number"][fewer.regular_faces], return_inverse=True)
    return replace(mesh, faces=corners.reshape(-1, 3).astype(np.int32), **mesh.vertices_at(kept))
