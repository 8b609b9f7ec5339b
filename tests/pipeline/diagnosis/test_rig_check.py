"""What a rig is checked by, from files: what calibration and settings say of how they are read."""

import numpy as np
import pytest

from pipeline.diagnosis import rig_check
from pipeline.diagnosis.rig_check import check_picture, check_sequence, holds_captures
from pipeline.diagnosis.ripple import Diagnosis
from pipeline.errors import CalibrationError
from pipeline.models import CameraState
from pipeline.output.range_image import write_png
from pipeline.settings import DecodeSettings
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig


@pytest.fixture(scope="module")
def plane(cpu):
    """Return a simulated plane, and its rig as it was calibrated."""
    truth = simulate_frame(simulated_rig((320, 240), period_px=2 * 768 / 44), SimulationSettings(scene="plane"))
    crosstalk = SimulationSettings().crosstalk_matrix
    return truth.image, truth.rig.model_copy(update={"crosstalk_matrix": crosstalk})


def test_a_plane_is_flat_and_a_wrong_crosstalk_can_be_corrected(plane, tmp_path):
    image, rig = plane
    path = tmp_path / "plane.png"
    write_png(path, image)
    found = check_picture(path, rig, DecodeSettings(), "cpu", "plane")
    assert found.surface is not None and found.surface.fine
    assert found.frame.mask.mean() > 0.5
    wrong = rig.model_copy(update={"crosstalk_matrix": np.eye(3)})
    with pytest.warns(match="the colours' fringes differ by"):
        found = check_picture(path, wrong, DecodeSettings(), "cpu")
    assert found.surface is None
    assert any("crosstalk" in finding.causes for finding in found.diagnosis.findings)
    # One frame tells what part of a channel's light leaks, to some hundredths of it.
    parts = rig.crosstalk_matrix / rig.crosstalk_matrix.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(found.corrected().crosstalk_matrix, parts, atol=0.05)


def test_what_the_settings_leave_open_the_calibration_says(plane, tmp_path, monkeypatch):
    image, rig = plane
    asked = []

    def diagnosed(*arguments):
        asked.append(arguments)
        return Diagnosis((), {}, {}, np.nan)

    monkeypatch.setattr(rig_check, "diagnose", diagnosed)
    path = tmp_path / "plane.png"
    rig = rig.model_copy(update={"capture": CameraState(transfer="srgb")})
    write_png(path, np.zeros_like(image))
    with pytest.warns(match="no fringe stands out"):
        assert check_picture(path, rig, DecodeSettings(), "cpu") is None
    assert not asked
    write_png(path, image)
    assert check_picture(path, rig, DecodeSettings(), "cpu").transfer == "srgb"
    with pytest.warns(match="transfer is linear but was srgb at calibration"):
        assert check_picture(path, rig, DecodeSettings(transfer="linear"), "cpu").transfer == "linear"
    assert [arguments[5] for arguments in asked] == ["srgb", "linear"]
    np.testing.assert_array_equal(asked[0][4], rig.crosstalk_matrix)


def test_frames_in_a_row(plane, tmp_path):
    image, rig = plane
    for number in range(3):
        write_png(tmp_path / f"{number}.png", image)
    assert not holds_captures(tmp_path)
    with pytest.raises(CalibrationError, match="holds 3 pictures: at least 12 frames in a row tell anything"):
        check_sequence(tmp_path, rig, DecodeSettings(), "cpu")
