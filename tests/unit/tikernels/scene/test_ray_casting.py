"""Rays against closed forms: a ball and a plane."""

import numpy as np

from tikernels._taichi import F32Array1, F32Array2, ti, vec3, vec4
from tikernels.scene.ray_casting import FAR_MM, ray_casting


def cast(scene: str, rays: np.ndarray, towards=(0.0, -0.2, -0.98)) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return depth, normal and whether something shades the point, for (N, 2) rays at unit depth."""
    trace, shadowed, normal_at = ray_casting(scene)

    @ti.kernel
    def cast_kernel(rays: F32Array2, towards: vec3, depths: F32Array1, normals: F32Array2, shadows: F32Array1):
        for i in range(rays.shape[0]):
            ray = vec3(rays[i, 0], rays[i, 1], 1.0)
            depths[i] = trace(ray, vec4(0.0))
            p = ray * depths[i]
            normal = normal_at(p, vec4(0.0))
            shadows[i] = ti.cast(shadowed(p, towards, vec4(0.0)), ti.f32)
            for k in ti.static(range(3)):
                normals[i, k] = normal[k]

    depths, shadows = np.empty((2, len(rays)), np.float32)
    normals = np.empty((len(rays), 3), np.float32)
    direction = np.array(towards) / np.linalg.norm(towards)
    cast_kernel(np.ascontiguousarray(rays, np.float32), vec3(direction.tolist()), depths, normals, shadows)
    return depths, normals, shadows


def test_a_plane_is_met_where_it_is(arch):
    """To 0.01 mm: a hit is refined below a thousandth, and float32 leaves 1e-4 mm of 900."""
    rays = (np.random.default_rng(1).random((100, 2)) - 0.5) * 0.4
    depths, normals, shadows = cast("plane", rays)
    expected = 900 / (1 - 0.25 * rays[:, 0] - 0.2 * rays[:, 1])
    np.testing.assert_allclose(depths, expected, atol=0.01)
    np.testing.assert_allclose(normals, np.tile([0.25, 0.2, -1] / np.sqrt(1.1025), (100, 1)), atol=1e-3)
    assert not shadows.any()


def test_a_ball_is_met_in_front(arch):
    rays = (np.random.default_rng(2).random((100, 2)) - 0.5) * 0.1  # all hit it
    depths, normals, shadows = cast("ball", rays, (0, 0, -1))
    ray = np.column_stack([rays, np.ones(100)])
    square, along = (ray**2).sum(axis=1), 880.0
    expected = (along - np.sqrt(along**2 - square * (880**2 - 85**2))) / square
    np.testing.assert_allclose(depths, expected, atol=0.01)
    outwards = (ray * expected[:, None] - (0, 0, 880)) / 85
    np.testing.assert_allclose(normals, outwards, atol=2e-3)
    assert not shadows.any()


def test_the_wall_behind_the_ball_lies_in_its_shadow(arch):
    """Seen from above the ball, its shadow falls on the wall where the light comes through it."""
    seen = np.array([[0.0, 0.12], [0.0, -0.2]])  # below the ball, and above it
    depths, _, shadows = cast("ball", seen, np.array([0, -0.9, -1.0]))
    assert (depths > 900).all()
    np.testing.assert_array_equal(shadows, [1, 0])


def test_a_ray_that_meets_nothing(arch):
    depths, _, _ = cast("objects", np.array([[0.4, -0.4]]))
    assert depths[0] >= FAR_MM
