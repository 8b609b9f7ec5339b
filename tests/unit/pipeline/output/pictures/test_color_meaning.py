"""Colours that mean something, and distances from planes, spheres and meshes."""

import numpy as np
import pytest
from support.drawn_surfaces import dome, walled

from pipeline.errors import RenderError
from pipeline.output.mesh import Mesh
from pipeline.output.pictures.color_meaning import (
    SurfaceColors,
    check_boxes,
    distance_from,
    plane_deviation,
    sphere_deviation,
)
from pipeline.output.pictures.viewpoint import CLAY

RNG = np.random.default_rng(1)


def test_clay_and_texture_have_no_scale():
    clay, texture = (SurfaceColors([dome()], colors) for colors in ("clay", "texture"))
    assert clay.scale is None and clay.of(dome()).tolist() == CLAY.tolist()
    np.testing.assert_array_equal(texture.of(dome()), dome().colors)


def test_depth_has_the_limits_of_all_samples_without_the_wall():
    scale = SurfaceColors([walled(dome(at_mm=at)) for at in (400.0, 420.0)], "depth").scale
    assert scale is not None and (scale.name, scale.unit) == ("depth", "mm")
    assert 349 < scale.low < 353 and 418 < scale.high < 422
    assert scale.grey_beyond
    alone = SurfaceColors([dome()], "depth").scale
    assert alone is not None and not alone.grey_beyond


def test_sigma_begins_at_zero_and_a_sphere_fits_itself():
    sigma = SurfaceColors([dome(sigma_mm=0.1)], "sigma").scale
    assert sigma is not None and sigma.low == 0 and sigma.high == pytest.approx(0.1)
    sphere = SurfaceColors([walled(dome())], "sphere").scale
    assert sphere is not None and sphere.diverging and sphere.high < 1e-3
    plane = SurfaceColors([walled(dome())], "plane").scale
    assert plane is not None and plane.high == pytest.approx(250, abs=3), "the dome stands out of the wall"


def test_a_distance_wins():
    colors = SurfaceColors([dome()], "clay", lambda points: points[:, 0])
    assert colors.scale is not None and (colors.scale.name, colors.scale.unit) == ("deviation", "mm")
    painted = colors.of(dome()).astype(int)
    assert (painted[dome().vertices[:, 0] > 20, 0] > painted[dome().vertices[:, 0] > 20, 2]).all()


@pytest.mark.parametrize(
    ("mesh", "colors", "said"),
    [
        (dome(), "modulation", "the mesh holds no modulation"),
        (dome(colors=False), "texture", "has no colours"),
        (dome("rad"), "plane", "decode with a calibration"),
        (Mesh(dome().vertices[:2], np.empty((0, 3), np.int32)), "plane", "cannot be fitted to 2 points"),
    ],
)
def test_what_cannot_be_shown(mesh, colors, said):
    with pytest.raises(RenderError, match=said):
        SurfaceColors([mesh], colors)


def test_a_plane_with_outliers():
    x, y = RNG.uniform(-50, 50, (2, 2000))
    points = np.stack([x, y, 600 + 0.3 * x - 0.1 * y + RNG.normal(0, 0.02, 2000)], axis=1)
    points[:100, 2] -= 40
    deviation = plane_deviation(points, points)
    assert np.std(deviation[100:]) == pytest.approx(0.02 / np.sqrt(1 + 0.09 + 0.01), rel=0.1)
    # Nearer to the camera is above 0.
    assert deviation[:100].mean() == pytest.approx(40 / np.sqrt(1.1), rel=0.01)


def test_a_part_of_a_sphere_with_outliers():
    directions = RNG.normal((0, 0, -3), 1, (2000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    points = (10, 20, 700) + directions * (50 + RNG.normal(0, 0.01, (2000, 1)))
    points[:60] += (0, 0, 30)
    deviation = sphere_deviation(points, points)
    assert abs(deviation[60:].mean()) < 0.003 and np.std(deviation[60:]) == pytest.approx(0.01, rel=0.1)
    middle = np.array([[10, 20, 700 - 51.0]])
    assert sphere_deviation(points, middle) == pytest.approx(1, abs=0.01), "outside is above 0"


def test_too_few_or_flat():
    with pytest.raises(RenderError, match="a plane cannot be fitted to 2 points: use other colours"):
        plane_deviation(np.zeros((2, 3)), np.zeros((2, 3)))
    flat = np.array([[0, 0, 5], [1, 0, 5], [0, 1, 5], [1, 1, 5], [2, 1, 5.0]])
    with pytest.raises(RenderError, match="the surface is flat"):
        sphere_deviation(flat, flat)


def test_the_distance_from_a_ball_is_positive_outside():
    directions = np.random.default_rng(0).normal((0, 0, -4), 1, (200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for radius in (49.0, 50.0, 52.0):
        points = ((0, 0, 400) + radius * directions).astype(np.float32)
        np.testing.assert_allclose(distance_from(dome())(points), radius - 50, atol=0.03)  # its triangles' sagitta


def test_what_has_no_distance():
    for mesh in (dome("rad"), Mesh(dome().vertices, np.empty((0, 3), np.int32))):
        with pytest.raises(RenderError, match="--compare needs a mesh of triangles in mm"):
            distance_from(mesh)


def test_given_limits_and_colours_are_used():
    values = np.array([[0, 0, 90], [0, 0, 100], [0, 0, 120], [0, 0, 300]], np.float32)
    mesh = Mesh(values, np.empty((0, 3), np.int32))
    shown = SurfaceColors([mesh], "depth", limits=(100.0, 120.0), colormap="viridis")
    assert (shown.scale.low, shown.scale.high) == (100, 120)
    # Viridis begins with (68, 1, 84) and ends with (253, 231, 37); what lies outside has the same.
    np.testing.assert_allclose(shown.of(mesh), [[68, 1, 84]] * 2 + [[253, 231, 37]] * 2, atol=2)


@pytest.mark.parametrize(
    ("moved_mm", "said"), [((0, 0, 0.9), None), ((0, 0, 3), "2 mm apart: if one has other axes"), ((30, 0, 0), None)]
)
def test_surfaces_whose_boxes_do_not_overlap_are_told_of_and_far_ones_refused(moved_mm, said):
    points = np.array([[0, 0, 0], [40, 0, 0], [0, 30, 1]], np.float32)  # 50 mm large
    note = check_boxes(points, points + np.float32(moved_mm))
    assert note is None if said is None else said in note
    with pytest.raises(RenderError, match="960 mm apart"):
        check_boxes(points, points + np.float32((1000, 0, 0)))
