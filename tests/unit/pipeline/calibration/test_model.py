"""The calibration that users hand us: each mistake is one line that names the file and the key."""

import json

import cv2
import numpy as np
import pytest

from pipeline import Calibration
from pipeline.calibration import ColorShift, Pattern
from pipeline.calibration.model import choose_pattern
from pipeline.errors import CalibrationError, SettingsError
from pipeline.models import SensorPart
from pipeline.simulation import simulated_rig

LENS = simulated_rig().model_dump(mode="json")["camera"]


def values():
    return json.loads(simulated_rig().model_dump_json())


def test_a_calibration_survives_its_file(tmp_path):
    rig = simulated_rig(stripes="vertical", tilt_deg=7, camera_distortion=(0.1, 0.2, 0.3, 0.4, 0.5))
    rig.write(tmp_path / "calibration.json")
    again = Calibration.read(tmp_path / "calibration.json")
    assert again.digest() == rig.digest()
    np.testing.assert_array_equal(again.rotation, rig.rotation)
    assert again.pattern == rig.pattern
    with pytest.raises(ValueError, match="read-only"):
        again.rotation[0, 0] = 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"baseline": 1}, "baseline: is not a known key"),
        ({"pattern": None}, "pattern"),
        ({"rotation": np.diag([1, 1, 2]).tolist()}, "rotation must be a rotation matrix"),
        ({"rotation": [[1, 0], [0, 1]]}, r"rotation: must have shape \(3, 3\), got \(2, 2\)"),
        ({"translation_mm": [0, 0, "x"]}, "translation_mm: must be 3 numbers"),
        ({"translation_mm": [0, 0, 0]}, "translation_mm must not be zero"),
        ({"translation_mm": [0, 1e300, 0]}, r"translation_mm: must lie from -1e\+09 to 1e\+09"),
        (
            {"depth_range_mm": [500, 1e300]},
            r"depth_range_mm\.1: must be a number above 0 and at most 1000000000, got 1e\+300",
        ),
        ({"camera": LENS | {"distortion": [0, 0, 1e8, 0, 0]}}, r"camera\.distortion: must lie from -10000 to 10000"),
        ({"camera": LENS | {"size_px": [10**5, 10**5]}}, "camera: the lens has 100000x100000 px, .* are read at most"),
        ({"camera": LENS | {"size_px": [10**30, 1]}}, r"camera\.size_px\.0: "),
        ({"crosstalk_matrix": [[1, 0, 0], [1, 0, 0], [0, 0, 1]]}, "crosstalk_matrix cannot be inverted"),
        ({"depth_range_mm": [900, 700]}, "depth_range_mm"),
        ({"response": [[0] * 256] * 3}, "response must rise"),
        (
            {"camera": {"size_px": [640, 480], "matrix": np.eye(3).tolist(), "distortion": [0] * 6}},
            r"camera\.distortion: must have 4, 5, 8, 12 or 14 numbers, in OpenCV's order, got 6",
        ),
        ({"camera": {"size_px": [640, -1], "matrix": np.eye(3).tolist()}}, "camera.size_px.1"),
        ({"projector": {"size_px": [640, 480], "matrix": np.diag([-1, 1, 1]).tolist()}}, "projector: matrix must be"),
    ],
)
def test_a_wrong_calibration_is_refused_by_its_key(tmp_path, change, message):
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps({**values(), **change}))
    with pytest.raises(CalibrationError, match=message) as raised:
        Calibration.read(path)
    assert str(path) in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_missing_key_and_a_broken_file(tmp_path):
    path = tmp_path / "calibration.json"
    broken = values()
    del broken["projector"]
    path.write_text(json.dumps(broken))
    with pytest.raises(CalibrationError, match="projector: is missing"):
        Calibration.read(path)
    path.write_text("{")
    with pytest.raises(CalibrationError, match="not what it should be"):
        Calibration.read(path)
    path.write_text("%YAML:1.0\n---\n")
    with pytest.raises(CalibrationError, match=r"it is no JSON: .* converted by colorphase calibrate import"):
        Calibration.read(path)
    with pytest.raises(CalibrationError, match="No such file"):
        Calibration.read(tmp_path / "none.json")


def test_rays_are_the_pixels_of_a_pinhole():
    """And with lateral colour those of a channel that lands beside its place."""
    lens = simulated_rig((64, 48)).camera
    focal, centre = lens.matrix[0, 0], lens.matrix[:2, 2]
    rays = lens.rays()
    assert rays.shape == (48, 64, 2)
    np.testing.assert_allclose(rays[10, 50], (np.array([50, 10]) - centre) / focal, atol=1e-6)
    np.testing.assert_allclose(
        lens.rays(np.array([0.5, -1.0]))[10, 50], (np.array([49.5, 11]) - centre) / focal, atol=1e-6
    )


@pytest.mark.parametrize(
    "distortion",
    [
        (-0.2, 0.05, 1e-3, -1e-3),
        (-0.2, 0.05, 1e-3, -1e-3, 0.0),
        (12.1, 40.2, 1e-3, -2e-3, 3.5, 12.2, 41.5, 5.1),
        (-0.2, 0.05, 1e-3, -1e-3, 0.0, 0, 0, 0, 0.02, -0.03, 0.01, 0.05),
        (0.3, -0.2, 1e-3, 2e-3, 0.1, 0.4, -0.1, 0.1, 0.02, -0.01, 0.01, 0.03, 0.08, -0.05),
    ],
)
def test_a_distorted_ray_comes_back_to_its_pixel(distortion):
    lens = simulated_rig((64, 48), camera_distortion=distortion).camera
    rays = lens.rays()[::9, ::9].reshape(-1, 2)
    points = np.concatenate([rays, np.ones((len(rays), 1))], axis=1).astype(np.float64)
    pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), lens.matrix, lens.distortion)
    y, x = np.mgrid[:48:9, :64:9]
    np.testing.assert_allclose(pixels[:, 0], np.stack([x.ravel(), y.ravel()], axis=1), atol=1e-3)


@pytest.mark.parametrize(
    "distortion",
    [
        (-1.6, 0.0, 0.0, 0.0),
        (-2.2, 0.8, 0.0, 0.0, 0.0),
        (-0.1, 0.0, 0.0, 0.0, -60.0),
        (-1.8, 0.0, 0.0, 0.0, 0.0, 0.3, 0.0, 0.0),
        (-2.0, *[0.0] * 11),
        (-1.8, 0.0, 0.0, 0.0, 0.0, 0.3, *[0.0] * 8),
        (3.0, 0.0, 0.0, 0.0, 0.0),
    ],
)
def test_a_lens_that_folds_has_no_rays_beyond(distortion):
    """All others are those of the exact radial function before its first turn."""
    lens = simulated_rig((128, 96), camera_distortion=distortion).camera
    k1, k2, _, _, k3, k4, *_ = np.append(distortion, np.zeros(2))
    radius = np.linspace(0, 3, 300001)
    bent = radius * (1 + radius**2 * (k1 + radius**2 * (k2 + radius**2 * k3))) / (1 + k4 * radius**2)
    turn = np.flatnonzero(np.append(np.diff(bent) <= 0, True))[0]
    y, x = np.mgrid[:96, :128]
    place = (np.stack([x, y], axis=-1) - lens.matrix[:2, 2]) / lens.matrix[[0, 1], [0, 1]]
    there = np.hypot(*place.T).T
    expected = np.interp(there, bent[: turn + 1], radius[: turn + 1], right=np.nan)
    found = np.hypot(*lens.rays().T).T
    blind = np.isnan(expected)
    assert blind.mean() == 0 if distortion[0] > 0 else 0.005 < blind.mean() < 0.3
    assert np.isnan(found[blind]).all()
    # At the fold itself a step of the picture is no step of the ray, and which pixel is the last is a matter of digits.
    assert not np.isnan(found[there < 0.999 * bent[turn]]).any()
    assert np.nanmax(np.abs(found - expected)) < 1e-4


def test_a_lens_that_folds_everywhere_is_refused():
    with pytest.raises(CalibrationError, match="no lens bends light like this one: its distortion"):
        simulated_rig((64, 48), camera_distortion=(-1e4, 0, 0, 0, 0)).camera.rays()


def test_coefficients_that_are_zero_change_nothing():
    """Files of 4, 8 and 14 numbers hold the lens, and the digest, of the same five."""
    short = simulated_rig(camera_distortion=(-0.2, 0.05, 1e-3, -1e-3))
    for zeros in (1, 4, 8, 10):
        longer = simulated_rig(camera_distortion=(-0.2, 0.05, 1e-3, -1e-3, *[0.0] * zeros))
        assert longer.camera.distortion.shape == (5,) and longer.digest() == short.digest()


def test_the_axes_meet_where_the_rig_is_turned_to():
    assert simulated_rig().geometry().working_distance_mm() == pytest.approx(900, abs=1e-6)
    parallel = {"rotation": np.eye(3), "translation_mm": np.array([0.0, 180.0, 0.0])}
    assert simulated_rig().model_copy(update=parallel).geometry().working_distance_mm() is None


@pytest.mark.parametrize("stripes", ["horizontal", "vertical"])
def test_a_point_on_the_projectors_axis_has_the_phase_of_its_middle(stripes):
    rig = simulated_rig(stripes=stripes, period_px=16)
    axis = 1 if stripes == "horizontal" else 0
    cycles = rig.geometry().pattern_cycles(np.array([[0.0, 0.0, 900.0]]))
    assert cycles == pytest.approx(rig.projector.matrix[axis, 2] / 16)


def test_a_binned_pixel_looks_where_the_middle_of_its_pixels_did():
    rig = simulated_rig((64, 48), camera_distortion=(-0.2, 0.05, 1e-3, -1e-3, 0.0))
    binned = rig.binned(2, 3)
    assert binned.camera.size_px == (32, 16)
    middles = np.stack(np.meshgrid(2 * np.arange(32) + 0.5, 3 * np.arange(16) + 1.0), axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(binned.camera.rays().reshape(-1, 2), rig.camera.rays_through(middles), atol=1e-6)


def test_a_crop_looks_where_the_whole_frame_looked():
    rig = simulated_rig((64, 48), camera_distortion=(-0.2, 0.0, 0.0, 0.0, 0.0))
    part = rig.cropped(20, 8, (30, 16)).camera.rays()
    np.testing.assert_allclose(part, rig.camera.rays()[8:24, 20:50], atol=1e-6)


def part(x, y, binning=(1, 1), sensor_px=(100, 80)):
    return SensorPart(sensor_px=sensor_px, offset_px=(x, y), binning=binning)


WHOLE = simulated_rig((64, 48), camera_distortion=(-0.2, 0.05, 1e-3, -1e-3)).model_copy(update={"sensor": part(10, 6)})


@pytest.mark.parametrize(
    ("size_px", "now", "columns", "rows"),
    [
        ((64, 48), part(10, 6), 10 + np.arange(64), 6 + np.arange(48)),
        ((30, 20), part(12, 9), 12 + np.arange(30), 9 + np.arange(20)),
        ((20, 10), part(14, 7, (2, 3)), 14.5 + 2 * np.arange(20), 8 + 3 * np.arange(10)),
    ],
)
def test_a_calibration_follows_the_part_of_the_sensor_that_is_read_out(size_px, now, columns, rows):
    """Every pixel looks where the same place of the sensor did, and so do parts of the part."""
    found = WHOLE.as_read_out(size_px, now)
    assert (found.camera.size_px, found.sensor) == (size_px, now)
    places = np.stack(np.meshgrid(columns - 10, rows - 6), axis=-1).reshape(-1, 2).astype(np.float64)
    np.testing.assert_allclose(found.camera.rays().reshape(-1, 2), WHOLE.camera.rays_through(places), atol=1e-6)
    x, y = now.binning
    again = WHOLE.as_read_out((9, 7), part(now.offset_px[0] + x, now.offset_px[1] + 2 * y, now.binning))
    assert again.digest() == found.cropped(1, 2, (9, 7)).digest()


@pytest.mark.parametrize("place", [(0, 0, (48, 64)), (60, 0, (5, 5)), (-1, 0, (5, 5))])
def test_a_part_that_sticks_out_of_the_frame_is_refused(place):
    with pytest.raises(CalibrationError, match=r"stick out of the camera's 64x48 .width x height"):
        WHOLE.cropped(*place)


@pytest.mark.parametrize(
    ("size_px", "now", "key"),
    [
        ((64, 48), part(12, 6), "not calibrated"),  # of the same size, elsewhere
        ((64, 48), part(8, 6), "not calibrated"),
        ((30, 20), part(10, 6, sensor_px=(120, 80)), "another sensor"),
        ((40, 20), part(10, 6, (2, 2)), "not calibrated"),
    ],
)
def test_frames_of_what_was_not_calibrated_are_refused(size_px, now, key):
    with pytest.raises(CalibrationError, match=r"a\.zarr is .* but the calibration is for 64x48 on a sensor of") as e:
        WHOLE.as_read_out(size_px, now, "a.zarr")
    assert e.value.args[0].key == key


def test_a_finer_calibration_cannot_be_made_and_nothing_is_guessed():
    binned = WHOLE.binned(2, 2)
    assert binned.sensor == part(10, 6, (2, 2))
    with pytest.raises(CalibrationError, match="or calibrate all of the sensor without binning"):
        binned.as_read_out((20, 20), part(10, 6))
    with pytest.raises(CalibrationError, match="binned 2x2"):
        binned.as_read_out((20, 20), part(11, 6, (2, 2)))
    for known, now in ((WHOLE, None), (WHOLE.model_copy(update={"sensor": None}), part(12, 6))):
        assert known.as_read_out((64, 48), now) is known
        with pytest.raises(CalibrationError, match="its sides are 2x2 times smaller"):
            known.as_read_out((32, 24), now)


def test_lateral_colour_of_the_projector_is_a_lag_of_the_phase():
    shift = ColorShift(camera=np.zeros((3, 2)), projector=np.array([[9.0, -1.0], [9.0, 0.0], [9.0, 2.0]]))
    rig = simulated_rig(period_px=16).model_copy(update={"color_shift_px": shift})
    np.testing.assert_allclose(rig.projector_lag_rad(), np.array([-1, 0, 2]) * 2 * np.pi / 16)
    assert simulated_rig().projector_lag_rad() is None


def test_the_pattern_that_was_named_wins_over_the_calibrations():
    known = simulated_rig(period_px=20, stripes="vertical")
    assert choose_pattern(known, None, None) == known.pattern
    assert choose_pattern(known, 12, None, "contrast") == Pattern(period_px=12, stripes="vertical", code="contrast")
    assert choose_pattern(None, None, None) == Pattern(period_px=768 / 44, code="contrast")
    assert choose_pattern(None, None, None, "none") == Pattern(period_px=768 / 44)
    coded = simulated_rig(code="contrast")
    assert choose_pattern(coded, None, None) == coded.pattern
    assert choose_pattern(coded, None, None, "none").code is None
    with pytest.raises(SettingsError, match="period_px"):
        choose_pattern(None, 1, None)


@pytest.mark.parametrize("stripes", ["horizontal", "vertical"])
def test_cells_are_half_a_cycle_wide_or_as_wide_as_the_camera_needs(stripes):
    """Of 640 px the camera sees .70 for each of the projector's along the stripe: 4.5 of its px are 6.4 to 6.5."""
    rig = simulated_rig(stripes=stripes, period_px=20)
    assert choose_pattern(rig, None, None, "contrast2").cell_px == 10
    assert choose_pattern(rig, 8, None, "contrast2").cell_px == pytest.approx(6.45, abs=0.06)
    assert choose_pattern(None, 8, stripes, "contrast2").cell_px == 4, "without a geometry"
    assert choose_pattern(None, 4, stripes, "contrast2").cell_px == 2, "and no less"
    seen = simulated_rig((320, 240), stripes=stripes, tilt_deg=30, period_px=20, code="contrast2").pattern
    assert seen.cell_px == pytest.approx(2 * 6.45, rel=0.02)
    shown = rig.with_pattern(code="contrast2")
    assert choose_pattern(shown, None, None) == shown.pattern, "of a calibration the cells stay"
    assert choose_pattern(shown, 30, None).cell_px == 15, "until another pattern is named"
    assert choose_pattern(shown, None, None, "contrast").cell_px is None


def test_a_lens_without_directions_is_refused():
    lens = simulated_rig((64, 48)).camera
    short = lens.model_validate(lens.model_dump() | {"matrix": [[1e-9, 0, 31.5], [0, 1e-9, 23.5], [0, 0, 1]]})
    with pytest.raises(CalibrationError, match="no lens bends light like this one"):
        short.rays()


def test_no_points_have_no_cycles():
    assert simulated_rig().geometry().pattern_cycles(np.zeros((0, 3))).shape == (0,)
