"""Vertices on pixels' rays, and their normals."""

import numpy as np
import pytest

from pipeline.simulation import simulated_rig
from tikernels.depth.vertex_placing import place_vertices, ray_cubic

SIZE = (96, 80)
STILL = np.zeros((SIZE[1], SIZE[0], 2), np.float32)
LENS = (-0.1, 0.0, 0.001, -0.002, 0.0)


def rays_of(distortion):
    rays = simulated_rig(SIZE, camera_distortion=distortion).camera.rays()
    return np.concatenate([rays, np.ones((*rays.shape[:2], 1), np.float32)], axis=-1)


def tilted_plane():
    """Return depth and slopes of a plane, tilted by 40 degrees, the points through a lens, and the normal."""
    rays = rays_of(LENS).astype(np.float64)
    normal = np.array([0.4, -0.5, -0.768])
    normal /= np.linalg.norm(normal)
    depth = -700 / (rays @ normal)
    slope = np.stack(np.gradient(depth), axis=-1)
    return depth.astype(np.float32), slope.astype(np.float32), (rays * depth[..., None]).astype(np.float32), normal


@pytest.mark.parametrize("distortion", [(0.0,) * 5, LENS])
def test_rays_are_read_off_points(distortion):
    """To a hundredth of a pixel, also where there is no point; undistorting is no cubic of its own."""
    rays = rays_of(distortion)
    mask = np.random.default_rng(1).random(rays.shape[:2]) > 0.3
    points = rays * np.random.default_rng(2).uniform(600, 900, (*rays.shape[:2], 1)).astype(np.float32)
    points[~mask] = np.nan
    y, x = np.indices(mask.shape) / max(mask.shape)
    found = np.polynomial.polynomial.polyval2d(y, x, ray_cubic(points, mask))
    pixel = float(np.median(np.diff(rays[..., 0], axis=1)))
    np.testing.assert_allclose(np.moveaxis(found, 0, -1), rays[..., :2], atol=1e-2 * pixel)


def test_a_plane_has_its_own_normal_everywhere(arch):
    """To a tenth of a degree, also where nothing was measured."""
    depth, slope, points, normal = tilted_plane()
    inside, mask = np.zeros((2, *depth.shape), bool)
    inside[1:-1, 1:-1], mask[:, ::3], mask[:, 1::3] = True, True, True
    vertices, normals = place_vertices(depth, slope, STILL, np.where(mask[..., None], points, np.nan), mask, inside)
    np.testing.assert_allclose(vertices, points[inside], atol=0.1)
    measured = mask[inside]
    np.testing.assert_allclose(vertices[measured], points[inside & mask], rtol=1e-6)
    assert np.degrees(np.arccos(np.clip(normals @ normal, -1, 1))).max() < 0.1
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
    assert (np.einsum("ni,ni->n", normals, vertices) < 0).all()


def test_vertices_move_along_their_rays(arch):
    depth, slope, points, _ = tilted_plane()
    whole = np.ones(depth.shape, bool)
    vertices, _ = place_vertices(depth + np.float32(5), slope, STILL, points, whole, whole)
    along = vertices / points.reshape(-1, 3)
    np.testing.assert_allclose(along, along[:, :1] * np.ones(3), rtol=1e-5)
    np.testing.assert_allclose(vertices[:, 2], depth.ravel() + 5, rtol=1e-6)


def test_a_vertex_beside_its_pixel_is_on_the_surface(arch):
    """On the plane, half way to the next pixel to the right and a quarter of the way to the one above."""
    depth, slope, points, normal = tilted_plane()
    whole = np.ones(depth.shape, bool)
    shift = np.zeros_like(STILL)
    shift[1:-1, 1:-1] = -0.25, 0.5
    vertices, _ = place_vertices(depth, slope, shift, points, whole, whole)
    assert np.abs(vertices @ normal + 700).max() < 0.03
    moved = vertices.reshape(points.shape)[1:-1, 1:-1]
    pixel_mm = np.linalg.norm(points[1:-1, 2:] - points[1:-1, 1:-1], axis=-1)
    right = np.linalg.norm(moved - points[1:-1, 1:-1], axis=-1)
    np.testing.assert_allclose(right, np.hypot(0.5, 0.25) * pixel_mm, rtol=0.3)


def test_nothing_kept_is_no_vertex(arch):
    depth, slope, points, _ = tilted_plane()
    nothing = np.zeros(depth.shape, bool)
    vertices, normals = place_vertices(depth, slope, STILL, points, nothing, nothing)
    assert vertices.shape == normals.shape == (0, 3)


def test_menu(menu):
    depth, slope, points, _ = tilted_plane()
    whole = np.ones(depth.shape, bool)

    def place(**inputs):
        return place_vertices(**inputs)[0]

    menu(place, depth=depth, slope=slope, shift=STILL, points=points, mask=whole, kept=whole)
