"""Meshes to binary STL: triangles and their normals, for printers."""

import struct

import numpy as np

from pipeline.output.formats.file_text import Content, Heading
from pipeline.output.mesh import Mesh, face_normals


def encode_stl(mesh: Mesh, heading: Heading) -> dict[str, Content]:
    """Return a mesh as a binary STL file; of the remarks its head holds what 80 bytes do."""
    normals = face_normals(mesh)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    triangles = np.zeros(len(mesh.faces), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    triangles["normal"] = normals / np.where(lengths > 0, lengths, 1)
    triangles["corners"] = mesh.vertices[mesh.faces]
    # A head that begins with "solid" is taken for text.
    head = "; ".join(["binary STL", *(f"{name} {value}" for name, value in heading.remarks.items())])
    return {".stl": struct.pack("<80sI", head.encode()[:80], len(triangles)) + triangles.tobytes()}
