"""The eye's place, and light on a surface."""

import numpy as np
import pytest

from pipeline.errors import SettingsError
from pipeline.output.pictures.viewpoint import (
    CLAY,
    FIELD_OF_VIEW_DEG,
    VIEWS,
    CameraPath,
    Viewpoint,
    fitted_viewpoint,
    lit_colors,
)

PATH = """
[[keyframes]]
at = 0.0
position = [0, 0, -100]
focal_point = [0, 0, 600]
[[keyframes]]
at = {at}
position = [100, 0, 0]
focal_point = [0, 0, 600]
[[keyframes]]
at = 1.0
position = [200, -50, 0]
focal_point = [0, 0, 600]
up = [0, -1, 0.1]
"""

EYE = Viewpoint(position=(0, 0, 0), focal_point=(0, 0, 100))
PLACES = np.array([[0, 0, 100]] * 3, np.float32)


def projected(points, eye, size_px):
    """Return the px at which points are seen."""
    right, down, _ = eye.axes() @ (points - np.array(eye.position)).T
    focal_px = size_px[1] / 2 / np.tan(np.radians(FIELD_OF_VIEW_DEG / 2))
    depth = eye.depth_of(points)
    return size_px[0] / 2 + focal_px * right / depth, size_px[1] / 2 + focal_px * down / depth


@pytest.mark.parametrize("view", VIEWS)
def test_points_just_fill_the_picture_inside_its_margins(view):
    points = np.random.default_rng(0).normal((20, -30, 700), (60, 40, 30), (500, 3))
    towards_eye, up = map(np.array, VIEWS[view])
    size, margins = (640, 480), (10, 20, 120, 40)
    eye = fitted_viewpoint(points, towards_eye, up, size, margins)
    x, y = projected(points, eye, size)
    free = np.array([x.min() - 10, y.min() - 20, 640 - 120 - x.max(), 480 - 40 - y.max()])
    assert (free > -1e-6).all()
    assert min(free[0] + free[2], free[1] + free[3]) < 1e-6, "one side is filled"


def test_the_front_view_is_the_cameras():
    eye = fitted_viewpoint(np.array([[0, 0, 500.0], [10, 10, 520]]), *map(np.array, VIEWS["front"]), (64, 48), 4 * (0,))
    np.testing.assert_allclose(eye.axes(), [[1, 0, 0], [0, 1, 0], [0, 0, -1]], atol=1e-12)


def test_a_flat_point_has_a_viewpoint():
    eye = fitted_viewpoint(np.zeros((3, 3)), *map(np.array, VIEWS["front"]), (64, 48), 4 * (0,))
    assert eye.position[2] < 0


def test_turning_keeps_the_distance_and_goes_to_the_left():
    eye = Viewpoint(position=(0, 0, -100), focal_point=(0, 0, 500))
    pivot = np.array([0.0, 0, 400])
    turned = eye.turned(np.pi / 2, pivot)
    np.testing.assert_allclose(turned.position, (-500, 0, 400), atol=1e-9)
    np.testing.assert_allclose(turned.focal_point, (100, 0, 400), atol=1e-9)


@pytest.mark.parametrize(
    ("numbers", "said"),
    [
        ((1, 2, 3), "got 3 numbers, expected 6"),
        ((1, 2, 3, 1, 2, 3), "the eye is at the point that it looks at"),
        ((0, 0, 0, 0, 0, 1, 0, 0, 1), "what is up lies along the line of sight"),
        ((0, 0, 0, 0, 0, float("nan")), r"must be a number from .* got NaN"),
    ],
)
def test_numbers_that_tell_no_viewpoint(numbers, said):
    with pytest.raises(SettingsError, match=said) as caught:
        Viewpoint.of_numbers(numbers)
    assert "\n" not in str(caught.value) and str(caught.value).startswith("--camera: ")


def test_a_path_passes_its_places_without_a_jump(tmp_path):
    (tmp_path / "path.toml").write_text(PATH.format(at=0.4))
    path = CameraPath.read(tmp_path / "path.toml")
    for part, position in ((0, (0, 0, -100)), (0.4, (100, 0, 0)), (1, (200, -50, 0))):
        np.testing.assert_allclose(path.viewpoint(part).position, position, atol=1e-9)
    places = np.array([path.viewpoint(part).position for part in np.linspace(0, 1, 201)])
    steps = np.diff(places, axis=0)
    assert np.linalg.norm(np.diff(steps, axis=0), axis=1).max() < 0.1 * np.linalg.norm(steps, axis=1).max()


def test_two_places_are_joined_by_a_line(tmp_path):
    text = "[[keyframes]]\nat = 0\nposition = [0, 0, 0]\nfocal_point = [0, 0, 9]\n"
    (tmp_path / "path.toml").write_text(text + text.replace("at = 0", "at = 1").replace("[0, 0, 0]", "[8, 0, 0]"))
    assert CameraPath.read(tmp_path / "path.toml").viewpoint(0.25).position == pytest.approx((2, 0, 0))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("at = 1.0", "at = 0.9"), "at must begin at 0, grow, and end at 1"),
        (("at = {at}", "at = 1.0"), "at must begin at 0"),
        (("position = [100, 0, 0]", "position = [100, 0]"), r"keyframes\.1\.position"),
        (("at = 1.0", "at = 1.0\nspeed = 3"), "speed: is not a known key"),
        (("[[keyframes]]", "[keyframes]"), "not what it should be"),
    ],
)
def test_faults_of_a_path_are_one_line(tmp_path, change, said):
    (tmp_path / "path.toml").write_text(PATH.replace(*change).format(at=0.4))
    with pytest.raises(SettingsError, match=said) as caught:
        CameraPath.read(tmp_path / "path.toml")
    assert "\n" not in str(caught.value)
    with pytest.raises(SettingsError, match="cannot read"):
        CameraPath.read(tmp_path / "none.toml")


def normals(*directions):
    return np.array([np.array(d) / np.linalg.norm(d) for d in directions], np.float32)


def test_light_comes_from_the_upper_left():
    lit = lit_colors(PLACES, normals((-0.5, -0.5, -1), (0, 0, -1), (0.5, 0.5, -1)), CLAY.astype(np.uint8), EYE)
    assert lit[0, 0] > lit[1, 0] > lit[2, 0] > 40
    assert lit.max() <= 255


def test_the_back_of_a_surface_is_lit_as_its_front():
    directions = normals((-0.5, -0.5, -1), (0, 0, -1), (0.5, 0.5, -1))
    clay = CLAY.astype(np.uint8)
    np.testing.assert_allclose(lit_colors(PLACES, -directions, clay, EYE), lit_colors(PLACES, directions, clay, EYE))


def test_colours_that_mean_something_stay_themselves():
    colors = np.array([[200, 20, 20], [20, 200, 20], [20, 20, 200]], np.uint8)
    lit = lit_colors(PLACES, normals(*3 * [(0.4, 0.6, -1)]), colors, EYE)
    assert (lit.argmax(axis=1) == [0, 1, 2]).all()
    assert lit.max(axis=1).min() > 110
