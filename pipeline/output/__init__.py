"""Where results go: stores, meshes, reports, images and films."""

import pipeline.output.notebook  # noqa: F401  # it says how frames, results, meshes and calibrations show themselves
from pipeline.output.mesh import Mesh
from pipeline.output.mesh_files import read_mesh, write_mesh
from pipeline.output.stored_result import StoredResult
from pipeline.output.surface_mesh import frame_mesh

__all__ = ["Mesh", "StoredResult", "frame_mesh", "read_mesh", "write_mesh"]
