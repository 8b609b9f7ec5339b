"""From unwrapped phase to points in millimetres and to triangles."""

from typing import TYPE_CHECKING

from tikernels.lazy_names import lazily

if TYPE_CHECKING:
    from tikernels.depth.meshing import triangulate_mesh
    from tikernels.depth.triangulation import ProjectorGeometry, triangulate

__all__ = ["ProjectorGeometry", "triangulate", "triangulate_mesh"]
__getattr__, __dir__ = lazily(__name__)
