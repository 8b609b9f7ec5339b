"""The ripple doctor names what is wrong with a frame, at the usual size of the fault and at half of it."""

import numpy as np
import pytest
from support.single_faults import FAULTS, MIXING, diagnosed, diagnosed_as_known, photographed, shifted

from pipeline import Decoder, DecodeSettings
from pipeline.calibration import Calibration, ColorShift
from pipeline.diagnosis.channel_spectra import KnownLight
from pipeline.diagnosis.rig_check import correct_light
from pipeline.diagnosis.ripple import diagnose
from pipeline.errors import CalibrationError
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig

# Frames of rigs that differ from what their settings say.
pytestmark = [
    pytest.mark.usefixtures("cpu"),
    pytest.mark.filterwarnings("ignore:the colours' fringes differ"),
    pytest.mark.filterwarnings("ignore:no matrix explains"),
    pytest.mark.filterwarnings("ignore:.*of what is lit has a colour at full scale"),
    pytest.mark.filterwarnings("ignore:(only .*|nothing) of this frame could be measured"),
]


HALF = (320, 240)  # of the usual picture, its fringes as fine


@pytest.mark.parametrize("size_px", [HALF, (640, 480)])
@pytest.mark.parametrize(("cause", "fault"), FAULTS)
def test_one_fault_is_named(cause, fault, size_px):
    """Alone, or in a set of what one frame cannot tell apart, which holds at most four."""
    for seed, scene in enumerate(("plane", "ball")):
        found = diagnosed(*photographed(scene, seed, size_px=size_px, **fault))
        assert len(found.findings) == 1, (scene, [finding.causes for finding in found.findings])
        finding = found.findings[0]
        assert cause in finding.causes and len(finding.causes) <= 4
        assert max(finding.ripple_rad.values()) > found.limit_rad
        assert 0 < finding.confidence <= 1 and finding.size and finding.advice


@pytest.mark.parametrize("scene", ["plane", "ball", "waves", "bust"])
@pytest.mark.parametrize("gain", [None, (1.1, 1.0, 1.0)])
def test_a_clean_frame_is_fine(scene, gain):
    """So is one whose colours are not balanced: that is what a surface's colour looks like."""
    assert not diagnosed(*photographed(scene, 3, size_px=HALF, gain=gain)).findings


@pytest.mark.parametrize("exposure", [1.4, 2.5])
def test_over_exposure(exposure):
    """However much: what is cut off tells nothing else."""
    found = diagnosed(*photographed("plane", 1, exposure=exposure))
    assert [finding.causes for finding in found.findings] == [("clipping",)]


def test_hardly_anything_but_clipped():
    found = diagnosed(*photographed("plane", 1, exposure=5.0))
    assert not found.findings and "expose less" in found.notes[0]


def test_what_decoding_undoes_is_no_fault():
    """Neither a response that the calibration holds, nor lateral colour; without them both are found."""
    rig = simulated_rig()
    shift = np.array([[0, 0.7], [0, 0], [0, -0.7]])
    faults = {"gamma": 2.0, "projector_shift_px": shift, "crosstalk_matrix": np.eye(3)}
    truth = simulate_frame(rig, SimulationSettings(scene="plane", **faults))
    known = rig.model_copy(
        update={
            "crosstalk_matrix": np.eye(3),
            "response": np.tile(np.linspace(0, 1, 256) ** 2, (3, 1)),
            "color_shift_px": ColorShift(camera=np.zeros((3, 2)), projector=shift),
        }
    )
    frame = Decoder(DecodeSettings(equalize=False), known, arch="cpu").decode(truth.image)
    seen = (truth.image, 255, frame.unwrapped_phase, frame.mask)
    assert {cause for finding in diagnose(*seen).findings for cause in finding.causes} >= {
        "response",
        "lateral colour of the projector",
    }
    assert not diagnose(*seen, KnownLight.of(DecodeSettings(), known, known.pattern.code)).findings


@pytest.mark.parametrize("compensated", [True, False])
@pytest.mark.parametrize(
    "scene",
    ["plane", "ball", "waves", "bust"],
)
def test_a_code_a_lens_and_a_response_that_are_known_are_no_fault(scene, compensated):
    """White and skin under the coded pattern, its response undone in it or not, blurred by 0.6 px."""
    for seed in (0, 1):
        blur = (0.6, 0.6, 0.6)
        assert not diagnosed_as_known(scene, seed, compensated=compensated, projector_blur_px=blur).findings


def test_cells_along_the_stripe_are_no_fault():
    assert not diagnosed_as_known("waves", 0, compensated=False, code="contrast2").findings


@pytest.mark.parametrize("code", ["contrast", "contrast2"])
def test_what_is_known_wrongly_is_named_for_what_it_is(code):
    """A crosstalk that is not in the calibration, and sRGB that looks linear behind a projector of gamma 2."""
    unmixed = diagnosed_as_known("plane", 0, compensated=False, known={"crosstalk_matrix": np.eye(3)}, code=code)
    assert [finding.causes for finding in unmixed.findings] == [("crosstalk",)]
    encoded = diagnosed_as_known("plane", 0, compensated=False, transfer="srgb", code=code)
    assert [finding.causes for finding in encoded.findings] == [("transfer",)]
    other = np.tile(np.linspace(0, 1, 256) ** 1.2, (3, 1))
    unlike = diagnosed_as_known("plane", 0, compensated=False, known={"response": other}, code=code)
    assert {cause for finding in unlike.findings for cause in finding.causes} == {"response"}


def test_motion_in_a_part_is_found_beside_a_crosstalk_that_is_not_known():
    """A bust moves by 1.5 mm between the colours, and the wall behind it does not."""
    found = diagnosed(*photographed("bust", 1, crosstalk_matrix=MIXING, field_motion_mm=(0.0, 0.0, 1.5)))
    assert {finding.causes for finding in found.findings} == {("crosstalk",), ("motion between colour fields",)}


def test_a_wrong_transfer_is_turned_round():
    """Against what the frame was decoded with, whatever the calibration says."""
    image, white = photographed("plane", 1)
    frame = Decoder(DecodeSettings(equalize=False, crosstalk_matrix=np.eye(3), transfer="srgb"), arch="cpu").decode(
        image
    )
    found = diagnose(image, white, frame.unwrapped_phase, frame.mask, transfer="srgb")
    assert [finding.causes for finding in found.findings] == [("transfer",)]
    fixed = correct_light(Calibration(crosstalk_matrix=np.eye(3)), found, image, white, frame, "srgb")
    assert fixed.capture.transfer == "linear"


def test_too_little_to_say_anything():
    found = diagnose(np.zeros((40, 40, 3), np.uint8), 255, np.zeros((40, 40), np.float32), np.zeros((40, 40), bool))
    assert not found.findings and np.isnan(found.limit_rad)


def test_a_fixed_calibration():
    """Response and crosstalk that a calibration does not hold are put into it from the frame that shows them."""
    truth = simulate_frame(simulated_rig((400, 300), period_px=1.6 * 768 / 44), SimulationSettings(scene="plane"))
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
