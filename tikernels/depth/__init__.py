"""From unwrapped phase to points in millimetres and to triangles."""

from tikernels.depth.meshing import triangulate_mesh
from tikernels.depth.triangulation import ProjectorGeometry, triangulate

__all__ = ["ProjectorGeometry", "triangulate", "triangulate_mesh"]
