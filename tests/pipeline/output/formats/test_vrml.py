"""Meshes as VRML."""

import numpy as np

from pipeline.output.mesh_files import write_mesh


def test_vrml_lists_points_colors_and_faces(tmp_path, mesh):
    write_mesh(mesh, tmp_path / "mesh.wrl")
    text = (tmp_path / "mesh.wrl").read_text()
    assert text.startswith("#VRML V2.0 utf8\n")
    assert text.count("{") == text.count("}")

    def table(name, width):
        return np.array(text.split(f"{name} [")[1].split("]")[0].replace(",", " ").split(), float).reshape(-1, width)

    np.testing.assert_allclose(table("point", 3), mesh.vertices * (1e-3, -1e-3, -1e-3), rtol=1e-6)
    np.testing.assert_array_equal((table("color", 3) * 255).round(), mesh.colors)
    np.testing.assert_array_equal(table("coordIndex", 4), np.pad(mesh.faces, ((0, 0), (0, 1)), constant_values=-1))
