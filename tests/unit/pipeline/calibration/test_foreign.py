"""The same rig in other programs' files: OpenCV's, Moreno and Taubin's, Kalibr's, MATLAB's."""

import json

import cv2
import numpy as np
import pytest
from support.foreign_calibrations import CAMERA_PX, PROJECTOR_PX, kalibr, matlab, opencv, rig

from pipeline.calibration import Pattern
from pipeline.calibration.foreign import read_foreign
from pipeline.errors import CalibrationError

RATIONAL = (12.1, 40.2, 1e-3, -2e-3, 3.5, 12.2, 41.5, 5.1)
PATTERN = Pattern(period_px=16)


def read(path, sizes=(None, None), mm_per_unit=None):
    return read_foreign(path, PATTERN, *sizes, mm_per_unit)


def assert_same(found, truth):
    """Every ray and every point of the projector is the same."""
    assert found.camera.size_px == CAMERA_PX and found.projector.size_px == PROJECTOR_PX
    assert found.pattern == PATTERN
    np.testing.assert_allclose(found.camera.rays(), truth.camera.rays(), atol=1e-7)
    points = np.random.default_rng(1).uniform((-200, -150, 800), (200, 150, 1000), (50, 3))
    cycles = truth.geometry().pattern_cycles(points)
    np.testing.assert_allclose(found.geometry().pattern_cycles(points), cycles, atol=1e-6)


@pytest.mark.parametrize("suffix", ["yml", "xml"])
@pytest.mark.parametrize("names", [("M1", "D1", "M2", "D2"), ("cam_K", "cam_kc", "proj_K", "proj_kc")])
def test_opencv(tmp_path, suffix, names):
    truth = rig(camera=RATIONAL)
    opencv(tmp_path / f"stereo.{suffix}", truth, names, unit_mm=24.0)
    assert_same(read(tmp_path / f"stereo.{suffix}", (CAMERA_PX, PROJECTOR_PX), 24.0), truth)


@pytest.mark.parametrize("suffix", ["yml", "xml"])
def test_opencvs_vectors_of_one_axis(tmp_path, suffix):
    opencv(tmp_path / f"stereo.{suffix}", rig(), vectors=np.asarray)
    assert_same(read(tmp_path / f"stereo.{suffix}", (CAMERA_PX, PROJECTOR_PX), 1.0), rig())


def test_kalibr(tmp_path):
    truth = rig(camera=(-0.2, 0.05, 1e-3, -1e-3))
    (tmp_path / "camchain.yaml").write_text(kalibr(truth))
    assert_same(read(tmp_path / "camchain.yaml"), truth)


@pytest.mark.parametrize("units", ["millimeters", "mm"])
def test_matlab(tmp_path, units):
    (tmp_path / "stereo.json").write_text(json.dumps(matlab(rig(), units)))
    assert_same(read(tmp_path / "stereo.json"), rig())


def test_our_own_stays_as_it_is(tmp_path):
    rig().write(tmp_path / "calibration.json")
    assert read(tmp_path / "calibration.json").digest() == rig().digest()


def test_what_is_missing_or_of_another_model_is_named(tmp_path):
    opencv(tmp_path / "stereo.yml", rig())
    storage = cv2.FileStorage(str(tmp_path / "one.yml"), cv2.FILE_STORAGE_WRITE)
    storage.write("camera_matrix", np.eye(3))
    storage.release()
    skewed = matlab(rig())
    skewed["CameraParameters1"]["IntrinsicMatrix"][1][0] = 0.5
    for name, text in (
        ("fisheye.yaml", kalibr(rig(), "equidistant")),
        ("skewed.json", json.dumps(skewed)),
        ("nothing.yml", "hello: 1\n"),
        ("half.yaml", "cam0:\n  camera_model: pinhole\n"),
        ("half.json", '{"CameraParameters1": {}}'),
    ):
        (tmp_path / name).write_text(text)
    both = (CAMERA_PX, PROJECTOR_PX)
    for name, sizes, message in (
        ("stereo.yml", both, "does not state its unit: give --mm-per-unit"),
        ("one.yml", both, "it holds one lens, and a rig has two"),
        ("fisheye.yaml", both, "cam0 is pinhole-equidistant, and pinhole-radtan is read"),
        ("skewed.json", both, "the pixels are skewed"),
        ("nothing.yml", both, "it holds no calibration of OpenCV"),
        ("half.yaml", both, "'distortion_model' is missing"),
        ("half.json", both, "'IntrinsicMatrix' is missing"),
        ("gone.yml", both, "cannot read"),
    ):
        with pytest.raises(CalibrationError, match=message) as raised:
            read(tmp_path / name, sizes)
        assert "\n" not in str(raised.value)
    with pytest.raises(CalibrationError, match="does not state the camera's size: give --camera-size"):
        read(tmp_path / "stereo.yml", mm_per_unit=1.0)
