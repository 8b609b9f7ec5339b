"""The wall, the box, and the object before the wall."""

import numpy as np
import pytest
from support.drawn_surfaces import dome, walled

from pipeline.errors import SettingsError
from pipeline.output.background import inside_box, object_pixels, object_vertices, on_largest_plane, wall_vertices
from pipeline.output.mesh import Mesh

SHAPE = (90, 120)


def before_a_wall(object_depth, tilt=0.3):
    """Return points of a tilted wall with noise of 0.1 mm, some of them nearer by a depth, and which."""
    y, x = np.indices(SHAPE)
    rays = np.stack([(x - 60) / 400, (y - 45) / 400, np.ones(SHAPE)], axis=-1)
    depth = 900 / (1 + tilt * rays[..., 0])
    there = (np.abs(x - 60) < 25) & (np.abs(y - 40) < 25)
    depth = np.where(there, object_depth(depth, x, y), depth)
    depth = depth + np.random.default_rng(1).normal(0, 0.1, SHAPE)
    return (rays * depth[..., None]).astype(np.float32), np.full(SHAPE, 0.1, np.float32), there


def test_the_wall_goes_and_the_object_stays():
    points, sigma, there = before_a_wall(lambda depth, x, y: depth - 60 + 0.05 * (x - 60) ** 2)
    wall = on_largest_plane(points, sigma, np.ones(SHAPE, bool))
    assert not wall[there].any()
    assert wall[~there].mean() > 0.97  # within four pixels of the object the square finds room


def test_an_object_that_passes_the_plane_stays_whole():
    """A face that leans through the wall, 4 mm a pixel: one row of it lies on the plane."""
    points, sigma, there = before_a_wall(lambda depth, x, y: depth + 4.0 * (y - 40) + 1)
    wall = on_largest_plane(points, sigma, np.ones(SHAPE, bool))
    assert wall[there].mean() < 0.01 and wall[~there].mean() > 0.95


def test_pixels_off_the_mask_are_on_no_plane():
    points, sigma, there = before_a_wall(lambda depth, x, y: depth)
    points[there] = np.nan
    assert not on_largest_plane(points, sigma, ~there)[there].any()


def test_a_ball_alone_has_no_background():
    y, x = np.indices(SHAPE)
    rays = np.stack([(x - 60) / 400, (y - 45) / 400, np.ones(SHAPE)], axis=-1)
    ball = (x - 60) ** 2 + (y - 45) ** 2 < 40**2
    depth = 800 - 80 * np.sqrt(np.clip(1 - ((x - 60) ** 2 + (y - 45) ** 2) / 40**2, 0, None))
    found = on_largest_plane((rays * depth[..., None]).astype(np.float32), np.full(SHAPE, 0.02, np.float32), ball)
    assert found.sum() < 0.1 * ball.sum()


@pytest.mark.parametrize("count", [0, 2])
def test_no_plane_goes_through_two_points(count):
    mask = np.zeros(SHAPE, bool)
    mask[0, :count] = True
    assert not on_largest_plane(np.ones((*SHAPE, 3), np.float32), np.ones(SHAPE, np.float32), mask).any()


def test_the_box_holds_what_lies_between_its_corners():
    points = np.array([[[0, 0, 800], [5, 0, 800], [0, 0, 901], [np.nan] * 3]], np.float32)
    np.testing.assert_array_equal(inside_box(points, (-4, -4, 700, 4, 4, 900)), [[True, False, False, False]])


def test_a_box_inside_out_is_refused():
    with pytest.raises(SettingsError, match=r"crop: got x 4 to -4, .* each must grow"):
        inside_box(np.zeros((1, 1, 3), np.float32), (4, -4, 700, -4, 4, 900))


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
