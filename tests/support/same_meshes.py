"""When two meshes are the same, and a mesh with nothing but vertices and faces."""

import numpy as np

from pipeline.output.mesh import Mesh


def plain(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices, mesh.faces)


def assert_same(got: Mesh, expected: Mesh) -> None:
    np.testing.assert_array_equal(got.vertices, expected.vertices)
    np.testing.assert_array_equal(got.faces, expected.faces)
    assert got.unit == expected.unit
    assert got.properties.keys() == expected.properties.keys()
    for name, values in expected.properties.items():
        np.testing.assert_array_equal(got.properties[name], values)
    for name in ("colors", "normals", "flags"):
        wanted = getattr(expected, name)
        assert (getattr(got, name) is None) == (wanted is None), name
        if wanted is not None:
            np.testing.assert_array_equal(getattr(got, name), wanted)
