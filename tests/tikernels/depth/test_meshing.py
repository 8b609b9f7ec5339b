"""Pictures of points to triangles."""

import numpy as np
import pytest
import reference

import tikernels


def sheet(height: int, width: int, roughness_mm: float = 0.0, seed: int = 1) -> np.ndarray:
    """Return points a millimetre apart, 800 mm away."""
    y, x = np.mgrid[:height, :width]
    depth = 800 + roughness_mm * np.random.default_rng(seed).standard_normal((height, width))
    return np.stack([x, y, depth], axis=-1).astype(np.float32)


def as_sets(faces: np.ndarray) -> set[frozenset[int]]:
    found = {frozenset(map(int, face)) for face in faces}
    assert len(found) == len(faces), "a triangle came twice"
    return found


@pytest.mark.parametrize("shape", [(2, 2), (17, 23), (30, 2)])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_as_the_twin(arch, shape, seed):
    points = sheet(*shape, roughness_mm=1.0, seed=seed)
    mask = np.random.default_rng(seed).random(shape) > 0.1
    faces = tikernels.triangulate_mesh(points, mask, 1.5)
    assert as_sets(faces) == reference.triangulate_mesh(points, mask, 1.5)


def test_a_whole_sheet(arch):
    faces = tikernels.triangulate_mesh(sheet(9, 14), np.ones((9, 14), bool), 1.0)
    assert len(faces) == 2 * 8 * 13
    assert set(faces.ravel()) == set(range(9 * 14))


def test_counterclockwise_as_the_camera_sees_it(arch):
    """X right and y down: such a triangle's normal points back at the camera, and its area is half a square's."""
    points = sheet(13, 11, roughness_mm=0.5)
    mask = np.random.default_rng(2).random((13, 11)) > 0.1
    faces = tikernels.triangulate_mesh(points, mask, 1.0)
    a, b, c = (points[mask][faces[:, i]].astype(np.float64) for i in range(3))
    np.testing.assert_allclose(np.cross(b - a, c - a)[:, 2], -1.0)


def test_nothing_spans_a_step(arch):
    points = sheet(10, 20)
    points[:, 10:, 2] += 5
    faces = tikernels.triangulate_mesh(points, np.ones((10, 20), bool), 4.9)
    assert len(faces) == 2 * 2 * 9 * 9
    assert np.ptp(points.reshape(-1, 3)[faces][..., 2], axis=1).max() == 0
    assert len(tikernels.triangulate_mesh(points, np.ones((10, 20), bool), 5.1)) == 2 * 9 * 19


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1)])
def test_lines_have_no_triangles(arch, shape):
    assert tikernels.triangulate_mesh(sheet(*shape), np.ones(shape, bool), 1.0).shape == (0, 3)


def test_nothing_masked_has_no_triangles(arch):
    assert tikernels.triangulate_mesh(sheet(5, 6), np.zeros((5, 6), bool), 1.0).shape == (0, 3)


def test_missing_points_join_nothing(arch):
    points = sheet(5, 6)
    points[2, 3] = np.nan
    faces = tikernels.triangulate_mesh(points, np.ones((5, 6), bool), 1.0)
    assert 2 * 6 + 3 not in faces


def test_menu(menu):
    menu(
        lambda points, mask: tikernels.triangulate_mesh(points, mask, 1.0),
        points=sheet(7, 9, roughness_mm=0.5),
        mask=np.random.default_rng(3).random((7, 9)) > 0.1,
    )
