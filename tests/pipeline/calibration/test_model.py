"""The calibration that users hand us: each mistake is one line that names the file and the key."""

import json

import numpy as np
import pytest

from pipeline import Calibration
from pipeline.errors import CalibrationError
from pipeline.simulation import simulated_rig


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
        ({"crosstalk_matrix": [[1, 0, 0], [1, 0, 0], [0, 0, 1]]}, "crosstalk_matrix cannot be inverted"),
        ({"depth_range_mm": [900, 700]}, "depth_range_mm"),
        ({"response": [[0] * 256] * 3}, "response must rise"),
        ({"camera": {"size_px": [640, 480], "matrix": np.eye(3).tolist(), "distortion": [0] * 4}}, "camera.distortion"),
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
    with pytest.raises(CalibrationError, match="No such file"):
        Calibration.read(tmp_path / "none.json")
