"""Distance fields: closed forms, and that no ray may step over a surface."""

import numpy as np
import pytest

from tikernels._taichi import F32Array1, F32Array2, ti, vec3, vec4
from tikernels.scene.scene_shapes import SCENES, scene_distance


def distances(scene: str, points: np.ndarray, pose=(0.0, 0.0, 0.0, 0.0)) -> np.ndarray:
    """Return the distances of (N, 3) points, mm."""
    distance_to = scene_distance(scene)

    @ti.kernel
    def measure_kernel(points: F32Array2, pose: vec4, out: F32Array1):
        for i in range(points.shape[0]):
            out[i] = distance_to(vec3(points[i, 0], points[i, 1], points[i, 2]), pose)

    found = np.empty(len(points), np.float32)
    measure_kernel(np.ascontiguousarray(points, np.float32), vec4(*pose), found)
    return found


def anywhere(count: int = 400) -> np.ndarray:
    """Return points between camera and wall, mm."""
    rng = np.random.default_rng(1)
    return np.column_stack([rng.uniform(-200, 200, (count, 2)), rng.uniform(750, 950, count)])


@pytest.mark.parametrize("scene", SCENES)
def test_no_field_is_steeper_than_one(arch, scene):
    """Over 1 mm near a surface; if it were, a ray would step over it. An ellipsoid's first order leaves 5 %.

    Further off the bust's field only says how far it is at least, and jumps where its features are left out.
    """
    points = anywhere(8000)
    direction = np.random.default_rng(2).standard_normal((len(points), 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    change = distances(scene, points + direction) - distances(scene, points)
    near = np.abs(distances(scene, points)) < 8
    assert near.sum() > 50
    assert np.abs(change[near]).max() < 1.05


def test_the_ball_is_a_ball(arch):
    """In front of the wall: the distance to its surface, 85 mm around (0, 0, 880) mm; float32 leaves 1e-4 mm."""
    points = anywhere()
    points[:, 2] -= 60
    expected = np.linalg.norm(points - (0, 0, 880), axis=1) - 85
    nearest = expected < 60  # the wall is further
    np.testing.assert_allclose(distances("ball", points)[nearest], expected[nearest], atol=1e-3)


def test_the_plane_is_a_plane(arch):
    points = anywhere()
    expected = (900 + 0.25 * points[:, 0] + 0.2 * points[:, 1] - points[:, 2]) / np.sqrt(1 + 0.0625 + 0.04)
    np.testing.assert_allclose(distances("plane", points), expected, atol=1e-3)


def test_objects_move_and_turn_about_their_axis(arch):
    """A pose carries the field along: what is moved is as far as what was not, where it was."""
    points, angle = anywhere(), 0.3
    c, s = np.cos(angle), np.sin(angle)
    centred = points - (0, 0, 880)
    x, y, z = centred.T
    moved = np.column_stack([c * x + s * z + 5, y - 3, c * z - s * x + 880 + 7])
    np.testing.assert_allclose(distances("objects", moved, (5, -3, 7, angle)), distances("objects", points), atol=2e-3)
