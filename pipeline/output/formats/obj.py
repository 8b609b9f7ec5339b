"""Meshes to Wavefront OBJ, with their texture as a PNG beside it.

References
----------
Wavefront Technologies, Advanced Visualizer manual, appendix B1: Object files; MTL material format.
"""

import numpy as np

from pipeline.output.formats.file_text import Content, Heading, text_rows
from pipeline.output.mesh import Mesh
from pipeline.output.range_image import encode_png


def encode_obj(mesh: Mesh, heading: Heading) -> dict[str, Content]:
    """Return a mesh as an OBJ file; with a texture also as the material and the picture that it names.

    Without a texture colours follow each place, as MeshLab and others read them.
    """
    told = heading.comments("#")
    vertices = text_rows("v %.7g %.7g %.7g\n", mesh.vertices)
    if mesh.colors is not None and mesh.texture is None:
        table = np.hstack([mesh.vertices, mesh.colors / np.float32(255)])
        vertices = text_rows("v %.7g %.7g %.7g %.4f %.4f %.4f\n", table)
    # A corner names its vertex, its place in the texture and its normal, which all have the same number here.
    textured, bent = mesh.texture is not None, mesh.normals is not None
    corner = "%d" + ("/%d" if textured else "/" if bent else "") + ("/%d" if bent else "")
    repeated = np.repeat(mesh.faces + 1, 1 + textured + bent, axis=1)
    faces = text_rows(f"f {corner} {corner} {corner}\n", repeated)
    normals = "" if mesh.normals is None else text_rows("vn %.4f %.4f %.4f\n", mesh.normals)
    if mesh.texture is None:
        return {".obj": f"{told}{vertices}{normals}{faces}".encode()}
    # In an OBJ file a texture's v goes up from the bottom of the picture.
    places = text_rows("vt %.6f %.6f\n", mesh.texture_places() * (1, -1) + (0, 1))
    head = f"{told}mtllib {heading.stem}.mtl\nusemtl surface\n"
    material = f"{told}newmtl surface\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {heading.stem}.png\n"
    return {
        ".obj": f"{head}{vertices}{places}{normals}{faces}".encode(),
        ".mtl": material.encode(),
        ".png": encode_png(mesh.texture),
    }
