"""Results: stores, meshes, reports, images and films."""

from typing import TYPE_CHECKING

from tikernels.lazy_names import lazily

if TYPE_CHECKING:
    from pipeline.output.mesh import Mesh
    from pipeline.output.mesh_files import read_mesh, write_mesh
    from pipeline.output.stored_result import ResultFrame, StoredResult
    from pipeline.output.surface_mesh import MeshOptions, frame_mesh

__all__ = ["Mesh", "MeshOptions", "ResultFrame", "StoredResult", "frame_mesh", "read_mesh", "write_mesh"]
__getattr__, __dir__ = lazily(__name__)
