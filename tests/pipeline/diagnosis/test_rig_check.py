"""A rig's check from files: which kind of check a folder or a picture is good for."""

import numpy as np
import pytest

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
