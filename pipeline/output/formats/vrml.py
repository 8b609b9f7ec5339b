"""Meshes to VRML 2.0, as Cortona and other viewers of the paper's time open them."""

import numpy as np

from pipeline.output.formats.file_text import Content, Heading, text_rows
from pipeline.output.mesh import Mesh


def encode_vrml(mesh: Mesh, heading: Heading) -> dict[str, Content]:
    """Return a mesh as a VRML file, its colours by vertex."""
    vertices = text_rows("%.7g %.7g %.7g,\n", mesh.vertices)
    faces = text_rows("%d,%d,%d,-1,\n", mesh.faces)
    colors = ""
    if mesh.colors is not None:
        colors = "color Color { color [\n" + text_rows("%.4f %.4f %.4f,\n", mesh.colors / np.float32(255)) + "] }\n"
    text = f"""#VRML V2.0 utf8
{heading.comments("#")}Shape {{
appearance Appearance {{ material Material {{ }} }}
geometry IndexedFaceSet {{
solid FALSE
creaseAngle 3.14159265
coord Coordinate {{ point [
{vertices}] }}
{colors}coordIndex [
{faces}]
}}
}}
"""
    return {".wrl": text.encode()}
