"""Normals from the slopes of depth along pixels' rays."""

import numpy as np
import pytest

from pipeline.output.surface_normals import PixelRays, relief_normals, surface_normals
from pipeline.simulation import simulated_rig

SIZE = (96, 80)


def rays_of(distortion):
    lens = simulated_rig(SIZE, camera_distortion=distortion).camera
    rays = lens.rays()
    return np.concatenate([rays, np.ones((*rays.shape[:2], 1), np.float32)], axis=-1)


@pytest.mark.parametrize("distortion", [(0.0,) * 5, (-0.1, 0.0, 0.001, -0.002, 0.0)])
def test_rays_are_read_off_points(distortion):
    """To a hundredth of a pixel, also where there is no point; undistorting is no cubic of its own."""
    rays = rays_of(distortion)
    mask = np.random.default_rng(1).random(rays.shape[:2]) > 0.3
    points = rays * np.random.default_rng(2).uniform(600, 900, (*rays.shape[:2], 1)).astype(np.float32)
    points[~mask] = np.nan
    found = PixelRays.of(points, mask)
    places = np.arange(mask.size)
    pixel = float(np.median(np.diff(rays[..., 0], axis=1)))
    np.testing.assert_allclose(found.at(places).reshape(rays.shape), rays, atol=1e-2 * pixel)
    right, down = (change.reshape(rays.shape) for change in found.changes(places))
    np.testing.assert_allclose(right[:, 1:-1], (rays[:, 2:] - rays[:, :-2]) / 2, atol=1e-2 * pixel)
    np.testing.assert_allclose(down[1:-1], (rays[2:] - rays[:-2]) / 2, atol=1e-2 * pixel)


def test_a_plane_has_its_own_normal_everywhere():
    """Tilted by 40 degrees, towards the camera, through a lens: to a tenth of a degree."""
    rays = rays_of((-0.1, 0.0, 0.001, -0.002, 0.0)).astype(np.float64)
    normal = np.array([0.4, -0.5, -0.768])
    normal /= np.linalg.norm(normal)
    depth = -700 / (rays @ normal)
    points = (rays * depth[..., None]).astype(np.float32)
    inside = np.zeros(depth.shape, bool)
    inside[1:-1, 1:-1] = True
    slope = np.stack(np.gradient(depth), axis=-1)[inside]
    places = np.flatnonzero(inside)
    found = PixelRays.of(points, np.ones(depth.shape, bool))
    normals = surface_normals(
        depth[inside].astype(np.float32), slope.astype(np.float32), found.at(places), found.changes(places)
    )
    assert np.degrees(np.arccos(np.clip(normals @ normal, -1, 1))).max() < 0.1
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
    assert (np.einsum("ni,ni->n", normals, points[inside]) < 0).all()


def test_relief_without_a_calibration_looks_at_the_camera_too():
    normals = relief_normals(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, -1.0]], np.float32))
    half = np.sqrt(0.5)
    np.testing.assert_allclose(normals, [[0, 0, -1], [0, half, -half], [-half, 0, -half]], atol=1e-6)
