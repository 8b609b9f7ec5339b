"""A calibration whose light is corrected by one frame, where a diagnosis has found it at fault."""

from typing import Any

import numpy as np

from pipeline.calibration.model import Calibration
from pipeline.decoding.frame import DecodedFrame
from pipeline.decoding.self_calibration import estimate_light
from pipeline.diagnosis.ripple import Diagnosis, other_transfer
from pipeline.errors import CalibrationError
from pipeline.models import CameraState, ImageArray
from tikernels import runtime
from tikernels.raw.linearization import Transfer, linearize


def correct_light(
    calibration: Calibration,
    diagnosis: Diagnosis,
    image: ImageArray,
    white_level: float,
    frame: DecodedFrame,
    transfer: Transfer = "linear",
) -> Calibration:
    """Return the calibration with what a frame tells of the light in place of what it held.

    Crosstalk and response are estimated anew from the frame, where they, or what looks like them, were found at fault.
    The response is that of the pattern as it was projected, so measure the radiometry before making a new pattern. A
    transfer is set. What needs more than a frame (lateral colour, motion, a black level) stays, as the advice says.

    Parameters
    ----------
    calibration : Calibration
        The one at fault.
    diagnosis : Diagnosis
        What was found.
    image : (H, W, 3)
        The image that the frame was decoded from, levels as they came.
    white_level : float
        Full scale.
    frame : DecodedFrame
        The frame, decoded.
    transfer : {"linear", "srgb", "bt709"} or (N,) floats
        By which the levels were read.

    Raises
    ------
    CalibrationError
        Nothing is at fault that a frame could correct, or the frame tells too little.
    """
    if any(finding.causes == ("transfer",) for finding in diagnosis.findings):
        camera = calibration.capture or CameraState()
        changed = camera.model_copy(update={"transfer": other_transfer(transfer)})
        return calibration.model_copy(update={"capture": changed})
    causes = {cause for finding in diagnosis.findings for cause in finding.causes}
    if not causes & {"response", "crosstalk", "even crosstalk"}:
        raise CalibrationError("no fault was found that one frame can correct: do what the check advises")
    if not isinstance(transfer, str) or transfer != "linear":
        image, white_level = runtime.to_host(linearize(image, transfer, white_level)), 1.0
    light = estimate_light([image], white_level, [frame.unwrapped_phase], [frame.mask], frame.period_px or 0.0)
    if not light.reliable:
        raise CalibrationError("the frame tells too little of the light to correct it: capture a larger smooth surface")
    update: dict[str, Any] = {"crosstalk_matrix": light.crosstalk_matrix}
    if "response" in causes or calibration.response is None:
        update["response"] = np.tile(light.response, (3, 1))
        if calibration.pattern is not None:
            # The response that a frame shows is what the pattern has not undone.
            update["pattern"] = calibration.pattern.model_copy(update={"compensated": False})
    return calibration.model_copy(update=update)
