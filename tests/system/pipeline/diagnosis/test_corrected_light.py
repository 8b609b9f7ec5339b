"""Light that one frame corrects in a calibration."""

import numpy as np
import pytest
from support.single_faults import diagnosed, photographed, shifted

from pipeline import Decoder, DecodeSettings
from pipeline.calibration import Calibration
from pipeline.diagnosis.rig_check import correct_light
from pipeline.diagnosis.ripple import diagnose
from pipeline.errors import CalibrationError
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig

# Frames of rigs that differ from what their settings say.
pytestmark = [pytest.mark.usefixtures("cpu"), pytest.mark.filterwarnings("ignore:the colours' fringes differ")]


def test_a_fixed_calibration():
    """Response and crosstalk that a calibration does not hold are put into it from the frame that shows them."""
    truth = simulate_frame(simulated_rig(), SimulationSettings(scene="plane"))
    old = truth.rig.model_copy(update={"crosstalk_matrix": np.eye(3)})
    frame = Decoder(DecodeSettings(equalize=False), old, arch="cpu").decode(truth.image)
    found = diagnose(truth.image, 255, frame.unwrapped_phase, frame.mask)
    fixed = correct_light(old, found, truth.image, 255, frame)
    assert isinstance(fixed, Calibration) and fixed.has_geometry
    errors = []
    for rig in (old, fixed):
        frame = Decoder(DecodeSettings(equalize=False), rig, arch="cpu").decode(truth.image)
        error = np.exp(1j * (frame.wrapped_phase - truth.phase)[8:-8, 8:-8])
        error = error[np.isfinite(error)]
        errors.append(np.sqrt((np.angle(error / error.mean()) ** 2).mean()))
    assert errors[0] > 0.1 and errors[1] < 0.03
    shifted_frame = photographed("plane", 0, camera_shift_px=shifted(0.5))
    with pytest.raises(CalibrationError, match="what the check advises"):
        correct_light(old, diagnosed(*shifted_frame), *shifted_frame, frame)
