"""Figures of a check, and captures of anything that holds still, against a rig's epipolar lines."""

import cv2
import numpy as np
import pytest
from support.board_rig import BoardCaptures

from pipeline.calibration import Uncertainty
from pipeline.calibration.board import Board
from pipeline.calibration.multishot import multishot_codes, multishot_sequence
from pipeline.diagnosis.rig_check import BLIND_SPOTS, CheckResult, Measure, check_epipolar
from pipeline.errors import CalibrationError
from pipeline.simulation import TYPICAL_CROSSTALK, simulated_rig

# Frames of rigs that differ from what their settings say.
pytestmark = [pytest.mark.usefixtures("cpu"), pytest.mark.filterwarnings("ignore:the colours' fringes differ")]


KNOWN = {
    "crosstalk_matrix": np.array(TYPICAL_CROSSTALK),
    "uncertainty": Uncertainty(depth_bias_mm=0.3, reprojection_px=(0.05, 0.08)),
}


@pytest.mark.parametrize("measured, fine", [(0.0, True), (0.2, True), (0.201, False), (-0.2, True), (-0.201, False)])
def test_twice_the_prediction_is_fine_and_more_is_not(measured, fine):
    assert Measure("flatness", measured, 0.1, "mm").fine == fine


def test_one_figure_that_is_not_spoils_the_check():
    good, bad = Measure("flatness", 0.1, 0.1, "mm"), Measure("scale", 0.5, 0.1, "mm")
    assert CheckResult((good, good), None, None).fine
    assert not CheckResult((good, bad), None, None).fine


def test_every_kind_of_check_says_what_shows_more():
    assert BLIND_SPOTS.keys() == {"plane", "ball", "epipolar"}
    assert all("radius" in text for text in BLIND_SPOTS.values())


@pytest.mark.parametrize(("degrees", "fine"), [((0.0, 0.0, 0.0), True), ((0.1, 0.2, 0.0), False)])
def test_epipolar_lines(degrees, fine):
    """A tenth of a degree is 3 px in the projector."""
    names = multishot_sequence((1024, 768)).names
    rig = simulated_rig((320, 240)).model_copy(update=KNOWN)
    captures = BoardCaptures(
        rig, Board(squares=(9, 6), square_mm=40.0), (0.2, 0.2, 0), (0, 0, 900), names,
        lambda name: multishot_codes(name, (1024, 768)), samples=2,
    )  # fmt: skip
    rotation = cv2.Rodrigues(np.radians(degrees))[0] @ rig.rotation
    found = check_epipolar(captures, rig.model_copy(update={"rotation": rotation}))
    assert found.fine == fine and "baseline" in found.blind_spot
    if fine:
        back = rig.rotation.T
        swapped = {
            "camera": rig.projector,
            "projector": rig.camera,
            "rotation": back,
            "translation_mm": -back @ rig.translation_mm,
        }
        with pytest.raises(CalibrationError, match="is for 1024x768"):
            check_epipolar(captures, rig.model_copy(update={"camera": rig.projector}))
        narrow = rig.model_copy(update=swapped)
        with pytest.raises(CalibrationError, match="the two are swapped"):
            check_epipolar(captures, narrow)
