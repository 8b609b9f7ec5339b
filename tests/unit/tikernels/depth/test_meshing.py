"""Pictures of linked pixels to triangles."""

import numpy as np
import pytest
import reference
from support.linked_pixels import all_linked

import tikernels
from tikernels.depth.step_cutting import DOWN, RIGHT


def sheet(height: int, width: int, roughness_mm: float = 0.0, seed: int = 1) -> np.ndarray:
    """Return points a millimetre apart, 800 mm away."""
    y, x = np.mgrid[:height, :width]
    depth = 800 + roughness_mm * np.random.default_rng(seed).standard_normal((height, width))
    return np.stack([x, y, depth], axis=-1).astype(np.float32)


def within(mask: np.ndarray, links: np.ndarray) -> np.ndarray:
    """Return the links between masked pixels."""
    padded = np.pad(mask, ((0, 1), (0, 1)))
    here, right, below, beyond = padded[:-1, :-1], padded[:-1, 1:], padded[1:, :-1], padded[1:, 1:]
    allowed = 1 * (here & right) + 2 * (here & below) + 4 * (here & beyond) + 8 * (right & below)
    return links & allowed.astype(np.uint8)


def as_sets(faces: np.ndarray) -> set[frozenset[int]]:
    found = {frozenset(map(int, face)) for face in faces}
    assert len(found) == len(faces), "a triangle came twice"
    return found


@pytest.mark.parametrize("shape", [(2, 2), (17, 23), (30, 2)])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_as_the_twin(arch, shape, seed):
    rng = np.random.default_rng(seed)
    depth = sheet(*shape, roughness_mm=1.0, seed=seed)[..., 2]
    mask = rng.random(shape) > 0.1
    links = within(mask, rng.integers(0, 16, shape, np.uint8) | rng.integers(0, 16, shape, np.uint8))
    faces = tikernels.triangulate_mesh(depth, mask, links)
    assert as_sets(faces) == reference.triangulate_mesh(depth, mask, links)


def test_a_whole_sheet(arch):
    faces = tikernels.triangulate_mesh(sheet(9, 14)[..., 2], np.ones((9, 14), bool), all_linked((9, 14)))
    assert len(faces) == 2 * 8 * 13
    assert set(faces.ravel()) == set(range(9 * 14))


def test_counterclockwise_as_the_camera_sees_it(arch):
    """X right and y down: such a triangle's normal points back at the camera, and its area is half a square's."""
    points = sheet(13, 11, roughness_mm=0.5)
    mask = np.random.default_rng(2).random((13, 11)) > 0.1
    faces = tikernels.triangulate_mesh(np.ascontiguousarray(points[..., 2]), mask, within(mask, all_linked((13, 11))))
    a, b, c = (points[mask][faces[:, i]].astype(np.float64) for i in range(3))
    np.testing.assert_allclose(np.cross(b - a, c - a)[:, 2], -1.0)


def test_no_triangle_joins_what_is_not_linked(arch):
    shape = (10, 20)
    links = all_linked(shape)
    links[:, 9] &= DOWN
    faces = tikernels.triangulate_mesh(sheet(*shape)[..., 2], np.ones(shape, bool), links)
    assert len(faces) == 2 * 2 * 9 * 9
    column = faces % 20
    assert ((column < 10).all(axis=1) | (column >= 10).all(axis=1)).all()


def test_a_square_without_diagonals_has_no_triangles(arch):
    links = np.array([[RIGHT | DOWN, DOWN], [RIGHT, 0]], np.uint8)
    assert tikernels.triangulate_mesh(sheet(2, 2)[..., 2], np.ones((2, 2), bool), links).shape == (0, 3)


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1)])
def test_lines_have_no_triangles(arch, shape):
    assert tikernels.triangulate_mesh(sheet(*shape)[..., 2], np.ones(shape, bool), all_linked(shape)).shape == (0, 3)


def test_nothing_masked_has_no_triangles(arch):
    nothing = np.zeros((5, 6), np.uint8)
    assert tikernels.triangulate_mesh(sheet(5, 6)[..., 2], nothing, nothing).shape == (0, 3)


def test_menu(menu):
    mask = np.random.default_rng(3).random((7, 9)) > 0.1
    depth = np.ascontiguousarray(sheet(7, 9, roughness_mm=0.5)[..., 2])
    menu(tikernels.triangulate_mesh, depth=depth, mask=mask, links=within(mask, all_linked((7, 9))))
