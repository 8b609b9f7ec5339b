"""What the pictures of a calibration show."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from support.posed_boards import CAMERA_PX, PATTERN, PROJECTOR_PX, exact_poses, rig

from pipeline.calibration.figures import (
    geometry_figure,
    picture_share,
    pose_bars,
    radiometry_figure,
    shared_volume,
    write_figure,
)
from pipeline.calibration.radiometry import RAMP_CODES, measure_radiometry, radiometry_codes, radiometry_sequence
from pipeline.calibration.rig_geometry import solve_geometry
from pipeline.errors import OutputError
from pipeline.simulation import TYPICAL_CROSSTALK


@pytest.fixture(scope="module")
def radiometry():
    names = radiometry_sequence((1024, 768)).names
    light = {name: np.array(TYPICAL_CROSSTALK) @ radiometry_codes(name) ** 2 for name in names}
    noise = np.random.default_rng(0)
    return measure_radiometry(
        {
            name: np.clip(np.rint(200 * np.tile(seen, (40, 50, 1)) + noise.normal(10, 1, (40, 50, 3))), 0, 255).astype(
                np.uint8
            )
            for name, seen in light.items()
        }
    )


@pytest.fixture(scope="module")
def solved():
    """Return a geometry from ten poses; an eleventh moved by 3 px in the projector, and one corner is off by 3 px."""
    poses = exact_poses(11, 0.02)
    moved = np.random.default_rng(1).normal(0, 3, poses[4].projector_px.shape)
    poses[4] = replace(poses[4], projector_px=poses[4].projector_px + moved)
    poses[7].camera_px[5] += 3
    return solve_geometry(poses, CAMERA_PX, PROJECTOR_PX, PATTERN)


@pytest.fixture(scope="module")
def light_panels(radiometry):
    return panels(radiometry_figure(radiometry))


@pytest.fixture(scope="module")
def rig_panels(solved):
    return panels(geometry_figure(solved))


def panels(figure):
    """Return a figure's panels by the beginning of their titles."""
    titled = ((axes, axes.get_title() or axes.get_title(loc="left")) for axes in figure.get_axes())
    return {title.split(":")[0]: axes for axes, title in titled if title}


def labelled(axes, part):
    """Return what is drawn with this in its label."""
    (found,) = (artist for artist in axes.get_children() if part in str(artist.get_label()))
    return found


def test_each_primary_has_its_measured_points_beside_the_curve(radiometry, light_panels):
    white = radiometry.ramps[3, -1]
    for k, primary in enumerate(("red", "green", "blue")):
        axes = light_panels[f"the projector shows {primary}"]
        assert axes.get_ylabel() == ("light, share of white" if k == 0 else "")
        for i, channel in enumerate(("red", "green", "blue")):
            points = labelled(axes, f"seen by {channel}")
            np.testing.assert_array_equal(points.get_xdata(), [0, *RAMP_CODES])
            np.testing.assert_allclose(points.get_ydata(), radiometry.ramps[k, :, i] / white[i])
        curves = [line for line in axes.get_lines() if len(line.get_xdata()) == 256]
        assert len(curves) == 3
        for curve, ramp in zip(curves, radiometry.ramps[k].T / white[:, None], strict=True):
            np.testing.assert_allclose(curve.get_ydata()[[0, *RAMP_CODES]], ramp, atol=1e-3)  # of white: the noise


def test_the_crosstalk_is_a_table_of_shares(light_panels):
    axes = light_panels["crosstalk"]
    shares = [float(text.get_text().split(" %")[0]) for text in axes.texts]
    truth = np.array(TYPICAL_CROSSTALK)
    np.testing.assert_allclose(shares, 100 * (truth / truth.sum(axis=1, keepdims=True)).ravel(), atol=0.1)


def test_corners_and_residuals_of_all_used_poses_are_drawn(solved, rig_panels):
    fit = solved.adjustment
    used = np.concatenate(fit.used)
    assert np.count_nonzero(~used) == 1
    for device, name in enumerate(("camera", "projector")):
        axes = rig_panels[name]
        seen = np.concatenate([(pose.camera_px, pose.projector_px)[device] for pose in fit.poses])
        np.testing.assert_array_equal(np.transpose(labelled(axes, "corner; grey").get_data()), seen[used])
        np.testing.assert_array_equal(np.transpose(labelled(axes, "corner that was left out").get_data()), seen[~used])
        arrows = labelled(axes, "residual, ")
        scale = float(arrows.get_label().split()[1])
        steps = np.column_stack([arrows.U, arrows.V]) / scale
        rms = (solved.camera_rms_px, solved.projector_rms_px)[device]
        assert np.sqrt((steps**2).sum(axis=1).mean()) == pytest.approx(rms)
        # From the measured corner to where the fit puts it: there the truth is, to a third of the noise.
        np.testing.assert_allclose(steps[:40], (np.concatenate(truth_px(device)) - seen)[used][:40], atol=0.03)
        assert len([patch for patch in axes.patches if patch.get_facecolor()[3] == 0]) == 10  # a board's outline each


def truth_px(device):
    """Return the corners without noise of the poses that are used."""
    exact = [pose for k, pose in enumerate(exact_poses(11, 0.0)) if k != 4]
    return [(pose.camera_px, pose.projector_px)[device] for pose in exact]


def test_the_share_of_the_picture_is_that_of_the_hull(solved, rig_panels):
    corners = np.array([[0, 0], [320, 0], [320, 240], [0, 240], [100, 100]], np.float64)
    assert picture_share(corners, (640, 480)) == pytest.approx(0.25)
    title = rig_panels["camera"].get_title()
    fit = solved.adjustment
    seen = np.concatenate([pose.camera_px for pose in fit.poses])[np.concatenate(fit.used)]
    assert f"fill {picture_share(seen, CAMERA_PX):.0%} of the picture" in title


def test_bars_have_all_poses_and_mark_the_one_left_out(solved, rig_panels):
    bars = pose_bars(solved)
    assert [bar.name for bar in bars] == [f"pose_{k:02d}" for k in range(11)]
    assert [bar.name for bar in bars if not bar.used] == ["pose_04"]
    np.testing.assert_allclose([bar.rms_px for bar in bars if bar.used], solved.adjustment.pose_rms_px(), rtol=1e-12)
    camera, projector = bars[4].rms_px
    assert camera < 0.1 and projector == pytest.approx(3 * np.sqrt(2), rel=0.3)  # of 3 px along either axis
    axes = rig_panels["residuals of each pose"]
    assert sum(len(bars) for bars in axes.containers) == 22
    (mark,) = axes.texts
    assert mark.get_text().startswith("left out") and mark.get_position()[0] == 4


def test_the_rig_is_drawn_to_scale_in_two_views(solved, rig_panels):
    centre = -solved.calibration.rotation.T @ solved.calibration.translation_mm
    for view, axis in (("from the side", 1), ("from above", 0)):
        axes = rig_panels[view]
        assert axes.get_aspect() == 1
        np.testing.assert_allclose(labelled(axes, "baseline").get_xydata(), [[0, 0], centre[[2, axis]]], atol=1e-9)
        assert "180.0 mm" in labelled(axes, "baseline").get_label()
        assert len([patch for patch in axes.patches if patch.get_edgecolor()[:3] == (0, 0, 0)]) == 10  # boards


def test_the_volume_that_both_see_is_in_both_pictures():
    geometry = rig().geometry()
    points = shared_volume(geometry, 800.0, 1000.0)
    assert (points[:, 2].min(), points[:, 2].max()) == (800.0, 1000.0)
    lens, turn = geometry.projector, cv2.Rodrigues(geometry.rotation)[0]
    pixels, _ = cv2.projectPoints(points, turn, geometry.translation_mm, lens.matrix, lens.distortion)
    assert pixels.min() >= 0 and np.all(pixels[:, 0] <= np.array(PROJECTOR_PX))
    away = replace(geometry, translation_mm=geometry.translation_mm + np.array([0, 5000, 0]))
    assert len(shared_volume(away, 800.0, 1000.0)) == 0


def test_a_rig_whose_fields_do_not_meet_is_still_drawn(solved):
    """A projector that is turned away, which no fit has: nothing is seen by both."""
    apart = solved.calibration.model_copy(update={"translation_mm": np.array([0.0, 5000.0, 0.0])})
    figure = geometry_figure(replace(solved, calibration=apart))
    assert "both see 0 mm" in panels(figure)["from the side"].get_title()


@pytest.mark.parametrize("draw, size", [("radiometry", (1500, 1050)), ("geometry", (1400, 1450))])
def test_a_png_of_its_size(draw, size, radiometry, solved, tmp_path):
    figure = radiometry_figure(radiometry) if draw == "radiometry" else geometry_figure(solved)
    write_figure(figure, tmp_path / "plot.png")
    content = (tmp_path / "plot.png").read_bytes()
    assert content.startswith(b"\x89PNG") and cv2.imdecode(np.frombuffer(content, np.uint8), 1).shape[1::-1] == size
    with pytest.raises(OutputError, match="create the folder first"):
        write_figure(figure, tmp_path / "none" / "plot.png")
