"""The object before a wall."""

import numpy as np
from support.drawn_surfaces import dome, walled

from pipeline.output.background import object_pixels, object_vertices, wall_vertices
from pipeline.output.mesh import Mesh


def scene(tilt=0.2, object_mm=500.0):
    """Return depths of a tilted wall with a disc before it, and where the disc is."""
    y, x = (np.mgrid[:120, :160] - np.array([60, 80])[:, None, None]) / 200
    disc = np.hypot(x, y) < 0.1
    wall = 800 / (1 + tilt * x - 0.1 * y)  # a plane, as a pinhole camera sees it
    return np.where(disc, object_mm + 20 * x, wall).astype(np.float32), disc


def test_the_wall_is_found_in_a_depth_image():
    depth, disc = scene()
    found = object_pixels(depth, np.ones(depth.shape, bool))
    assert (found == disc).mean() > 0.99


def test_without_an_object_or_a_wall_all_counts():
    depth, _ = scene(object_mm=0)
    everything = np.ones(depth.shape, bool)
    flat = scene()[0][:30]
    assert object_pixels(flat, everything[:30]).all(), "a wall alone"
    rough = (800 + np.random.default_rng(0).normal(0, 50, depth.shape)).astype(np.float32)
    assert object_pixels(rough, everything).all()
    assert not object_pixels(rough, ~everything).any()


def test_vertices_of_a_mesh():
    mesh = walled(dome())
    n_dome = len(dome().vertices)
    wall = wall_vertices(mesh)
    assert wall[n_dome:].mean() > 0.99 and wall[:n_dome].mean() < 0.02
    np.testing.assert_array_equal(object_vertices(mesh), ~wall)
    assert object_vertices(dome()).all()
    relative = Mesh(mesh.vertices, mesh.faces, unit="rad")
    assert object_vertices(relative).all()
