<<<<<<< HEAD
"""What a rig is checked by, from files: what calibration and settings say of how they are read."""
=======
"""A rig's check from files: which kind of check a folder or a picture is good for."""
>>>>>>> refs/heads/tests

import numpy as np
import pytest

<<<<<<< HEAD
from pipeline.diagnosis import rig_check
from pipeline.diagnosis.rig_check import check_picture, check_sequence, holds_captures
from pipeline.diagnosis.ripple import Diagnosis
from pipeline.errors import CalibrationError
from pipeline.models import CameraState
from pipeline.output.range_image import write_png
from pipeline.settings import DecodeSettings
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig
from tikernels import runtime


@pytest.fixture(scope="module")
def plane():
    """Return a simulated plane, and its rig as it was calibrated."""
    runtime.init("cpu")
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
=======
from pipeline import DecodeSettings
from pipeline.calibration import Pattern
from pipeline.diagnosis.rig_check import check_captures, check_picture, check_sequence, holds_captures
from pipeline.errors import CalibrationError, FootageError
from pipeline.output.range_image import write_png
from pipeline.simulation import TYPICAL_CROSSTALK, SimulationSettings, simulate_frame, simulated_rig

pytestmark = [pytest.mark.usefixtures("cpu"), pytest.mark.filterwarnings("ignore:the colours' fringes differ")]


@pytest.fixture
def rig():
    """Return a rig of half the usual picture, that knows its light."""
    light = {"crosstalk_matrix": np.array(TYPICAL_CROSSTALK), "response": np.tile(np.linspace(0, 1, 256) ** 2, (3, 1))}
    return simulated_rig((320, 240), period_px=2 * 768 / 44).model_copy(update=light)


def test_a_picture_tells_shape_and_light_and_corrects_the_latter(rig, tmp_path):
    write_png(tmp_path / "plane.png", simulate_frame(rig, SimulationSettings(scene="plane")).image)
    good = check_picture(tmp_path / "plane.png", rig, DecodeSettings(), "cpu", shape="plane")
    assert good.surface.fine and good.diagnosis.findings == () and good.transfer == "linear"
    assert good.frame.mask.mean() > 0.9
    wrong = rig.model_copy(update={"crosstalk_matrix": np.eye(3), "response": None})
    found = check_picture(tmp_path / "plane.png", wrong, DecodeSettings(equalize=False), "cpu")
    assert found.surface is None and found.diagnosis.findings
    np.testing.assert_allclose(
        found.corrected().crosstalk_matrix,
        TYPICAL_CROSSTALK / np.sum(TYPICAL_CROSSTALK, axis=1, keepdims=True),
        atol=0.05,
    )


def test_stripes_are_the_calibrations_where_nobody_says_otherwise(tmp_path):
    upright = simulated_rig((320, 240), period_px=2 * 768 / 44, stripes="vertical")
    upright = upright.model_copy(update={"crosstalk_matrix": np.array(TYPICAL_CROSSTALK)})
    assert upright.pattern == Pattern(period_px=2 * 768 / 44, stripes="vertical")
    write_png(tmp_path / "plane.png", simulate_frame(upright, SimulationSettings(scene="plane")).image)
    found = check_picture(tmp_path / "plane.png", upright, DecodeSettings(), "cpu")
    assert found.frame.mask.mean() > 0.9


def test_a_picture_without_fringes_says_so_and_nothing_else(rig, tmp_path):
    write_png(tmp_path / "black.png", np.zeros((240, 320, 3), np.uint8))
    with pytest.warns(UserWarning, match="no fringe stands out"):
        assert check_picture(tmp_path / "black.png", rig, DecodeSettings(), "cpu") is None


def test_too_few_frames_are_no_sequence(rig, tmp_path):
    write_png(tmp_path / "1.png", np.zeros((240, 320, 3), np.uint8))
    with pytest.raises(CalibrationError, match="holds 1 pictures: at least 12 frames in a row"):
        check_sequence(tmp_path, rig, DecodeSettings(), "cpu")


def test_a_folder_of_captures_is_known_by_its_white(rig, tmp_path):
    assert not holds_captures(tmp_path)
    write_png(tmp_path / "00-white.png", np.zeros((240, 320, 3), np.uint8))
    assert holds_captures(tmp_path)
    with pytest.raises(CalibrationError, match="lacks the capture 01-black"):
        check_captures(tmp_path, rig, DecodeSettings())


def test_a_picture_that_is_none(rig, tmp_path):
    with pytest.raises(FootageError, match="No such file"):
        check_picture(tmp_path / "none.png", rig, DecodeSettings(), "cpu")
>>>>>>> refs/heads/tests
