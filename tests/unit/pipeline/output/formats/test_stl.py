"""Meshes as STL."""

import numpy as np

from pipeline.output.mesh_files import write_mesh


def test_stl_has_unit_normals_away_from_the_bed(tmp_path, mesh):
    write_mesh(mesh, tmp_path / "mesh.stl")
    data = (tmp_path / "mesh.stl").read_bytes()
    assert len(data) == 84 + 50 * len(mesh.faces)
    assert not data.startswith(b"solid"), "readers take that for text"
    rows = np.frombuffer(data, np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")]), offset=84)
    np.testing.assert_allclose(np.linalg.norm(rows["normal"], axis=1), 1, rtol=1e-5)
    across = np.cross(rows["corners"][:, 1] - rows["corners"][:, 0], rows["corners"][:, 2] - rows["corners"][:, 0])
    assert ((across * rows["normal"]).sum(axis=1) > 0).all()
