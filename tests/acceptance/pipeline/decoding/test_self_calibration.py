"""Crosstalk and response out of ordinary frames, without a calibration."""

import cv2
import numpy as np
import pytest

from pipeline import Decoder, DecodeSettings
from pipeline.simulation import TYPICAL_CROSSTALK, SimulationSettings, simulate_frame, simulated_rig

# Frames of rigs that differ from what their settings say.
pytestmark = [pytest.mark.usefixtures("cpu"), pytest.mark.filterwarnings("ignore:the colours' fringes differ")]


def decoded(truth, calibration=None, **settings):
    """Return the decoder, its frame, the RMS of its phase's error (rad), and the constant that was removed from it."""
    decoder = Decoder(DecodeSettings(equalize=False, **settings), calibration, arch="cpu")
    frame = decoder.decode(truth.image)
    inside = cv2.erode((frame.mask & truth.mask).astype(np.uint8), np.ones((9, 9))) > 0
    error = np.exp(1j * (frame.wrapped_phase - truth.phase)[inside])
    constant = np.angle(error.mean())
    return decoder, frame, np.sqrt((np.angle(error * np.exp(-1j * constant)) ** 2).mean()), constant


@pytest.mark.parametrize(
    ("scene", "gamma", "matrix"),
    [
        ("bust", 2.0, TYPICAL_CROSSTALK),
        ("plane", 1.6, ((0.8, 0.2, 0.0), (0.15, 0.7, 0.15), (0.0, 0.2, 0.8))),
        ("waves", 2.4, TYPICAL_CROSSTALK),
        ("ball", 1.0, TYPICAL_CROSSTALK),
    ],
)
@pytest.mark.filterwarnings("ignore:no matrix explains")  # of a frame that is told that there is no crosstalk
def test_a_frame_tells_the_light(scene, gamma, matrix):
    """It wins at least 0.8 of what the true matrix and response win against balance alone."""
    truth = simulate_frame(
        simulated_rig(), SimulationSettings(scene=scene, gamma=gamma, crosstalk_matrix=np.array(matrix))
    )
    *_, balance_alone, _ = decoded(truth, crosstalk_matrix=np.eye(3))
    decoder, frame, own, constant = decoded(truth)
    response = np.tile(np.linspace(0, 1, 256) ** gamma, (3, 1))
    rig = truth.rig.model_copy(
        update={
            "crosstalk_matrix": np.array(matrix),
            "response": response,
            "pattern": truth.rig.pattern.model_copy(update={"compensated": False}),
        }
    )
    *_, best, _ = decoded(truth, rig)
    assert balance_alone > 4 * best
    assert balance_alone - own > 0.8 * (balance_alone - best)
    assert decoder.state.light.reliable
    # A linear response leaves a turn about grey unknown, and says so.
    assert frame.constant_known == (gamma > 1.1)
    assert not frame.constant_known or abs(constant) < 0.02
