"""The ripple doctor names what is wrong with a frame, at the usual size of the fault and at half of it."""

import numpy as np
import pytest

from pipeline import Decoder, DecodeSettings
from pipeline.calibration import Calibration, ColorShift
from pipeline.diagnosis.corrected_light import correct_light
from pipeline.diagnosis.ripple import diagnose
from pipeline.errors import CalibrationError
from pipeline.pattern.fringes import make_pattern
from pipeline.simulation import SKIN, TYPICAL_CROSSTALK, WHITE, SimulationSettings, simulate_frame, simulated_rig
from tikernels import runtime

# Frames of rigs that are not what they are taken for.
pytestmark = pytest.mark.filterwarnings("ignore:the colours' fringes differ")

MIXING = np.array(TYPICAL_CROSSTALK)
HALF_MIXING = np.diag(np.diag(MIXING)) + (MIXING - np.diag(np.diag(MIXING))) / 2


def shifted(px):
    return np.array([[0, -px], [0, 0], [0, px]])


def photographed(scene, seed, *, modulation=None, offset=None, gain=None, **settings):
    """Return a frame of a rig without faults but those that are named, and full scale."""
    rig = simulated_rig(tilt_deg=(-12.0, 0.0, 9.0)[seed % 3])
    chosen = {"gamma": 1.0, "crosstalk_matrix": np.eye(3), "reflectance": (SKIN, WHITE)[seed % 2], "seed": seed}
    codes = None
    if modulation is not None:
        geometry = rig.geometry()
        plain = make_pattern(geometry.projector.size_px, geometry.pattern)
        codes = (0.5 + (plain - 0.5) * np.array(modulation)).astype(np.float32)
    if offset is not None or gain is not None:
        chosen.update(noise_levels=0.0, bits=16)
    truth = simulate_frame(rig, SimulationSettings(**{**chosen, "scene": scene, **settings}), codes=codes)
    if offset is None and gain is None:
        return truth.image, truth.white_level
    light = 0.9 * truth.image / truth.white_level * np.array(gain or (1, 1, 1)) + np.array(offset or (0, 0, 0))
    light += 1.5 / 255 * np.random.default_rng(seed).standard_normal(light.shape)
    return np.rint(255 * np.clip(light, 0, 1)).astype(np.uint8), 255


def diagnosed(image, white_level):
    runtime.init("cpu")
    settings = DecodeSettings(equalize=False, crosstalk_matrix=np.eye(3))
    frame = Decoder(settings, arch="cpu").decode(image)
    return diagnose(image, white_level, frame.unwrapped_phase, frame.mask)


@pytest.mark.parametrize(
    ("cause", "fault"),
    [
        ("crosstalk", {"crosstalk_matrix": MIXING}),
        ("crosstalk", {"crosstalk_matrix": HALF_MIXING}),
        ("response", {"gamma": 2.0}),
        ("response", {"gamma": 1.4}),
        ("transfer", {"transfer": "srgb"}),
        ("black level", {"offset": (0.05, 0.0, 0.0)}),
        ("black level", {"offset": (0.0, 0.0, 0.025)}),
        ("projector amplitude", {"modulation": (1.0, 0.8, 1.0)}),
        ("projector amplitude", {"modulation": (1.0, 0.9, 1.0)}),
        ("lateral colour of the camera", {"camera_shift_px": shifted(0.5)}),
        ("lateral colour of the camera", {"camera_shift_px": shifted(0.25)}),
        ("lateral colour of the projector", {"projector_shift_px": shifted(0.7)}),
        ("motion between colour fields", {"field_motion_mm": (0.0, 0.0, 0.7)}),
        ("motion between colour fields", {"field_motion_mm": (0.0, 0.0, 0.36)}),
        ("camera defocus", {"camera_blur_px": (1.2, 0.0, 0.0)}),
    ],
)
def test_one_fault_is_named(cause, fault):
    """Alone, or in a set of what one frame cannot tell apart, which holds at most four."""
    runtime.init("cpu")
    for seed, scene in enumerate(("plane", "ball")):
        found = diagnosed(*photographed(scene, seed, **fault))
        assert len(found.findings) == 1, (scene, [finding.causes for finding in found.findings])
        finding = found.findings[0]
        assert cause in finding.causes and len(finding.causes) <= 4
        assert max(finding.ripple_rad.values()) > found.limit_rad
        assert 0 < finding.confidence <= 1 and finding.size and finding.advice


@pytest.mark.parametrize("scene", ["plane", "ball", "waves", "bust"])
@pytest.mark.parametrize("gain", [None, (1.1, 1.0, 1.0)])
def test_a_clean_frame_is_fine(scene, gain):
    """So is one whose colours are not balanced: that is what a surface's colour looks like."""
    runtime.init("cpu")
    assert not diagnosed(*photographed(scene, 3, gain=gain)).findings


@pytest.mark.parametrize("exposure", [1.4, 2.5])
def test_over_exposure(exposure):
    """However much: what is cut off tells nothing else."""
    runtime.init("cpu")
    found = diagnosed(*photographed("plane", 1, exposure=exposure))
    assert [finding.causes for finding in found.findings] == [("clipping",)]


def test_hardly_anything_but_clipped():
    runtime.init("cpu")
    found = diagnosed(*photographed("plane", 1, exposure=5.0))
    assert not found.findings and "expose less" in found.notes[0]


def test_what_decoding_undoes_is_no_fault():
    """Neither a response that the calibration holds, nor lateral colour; without them both are found."""
    runtime.init("cpu")
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
    seen = (truth.image, 255, frame.unwrapped_phase, frame.mask, np.eye(3), "linear")
    assert {cause for finding in diagnose(*seen).findings for cause in finding.causes} >= {
        "response",
        "lateral colour of the projector",
    }
    assert not diagnose(*seen, known.response, known.projector_lag_rad()).findings


def test_a_wrong_transfer_is_turned_round():
    """Against what the frame was decoded with, whatever the calibration says."""
    runtime.init("cpu")
    image, white = photographed("plane", 1)
    frame = Decoder(DecodeSettings(equalize=False, crosstalk_matrix=np.eye(3), transfer="srgb"), arch="cpu").decode(
        image
    )
    found = diagnose(image, white, frame.unwrapped_phase, frame.mask, np.eye(3), "srgb")
    assert [finding.causes for finding in found.findings] == [("transfer",)]
    fixed = correct_light(Calibration(crosstalk_matrix=np.eye(3)), found, image, white, frame, "srgb")
    assert fixed.capture.transfer == "linear"


def test_too_little_to_say_anything():
    found = diagnose(np.zeros((40, 40, 3), np.uint8), 255, np.zeros((40, 40), np.float32), np.zeros((40, 40), bool))
    assert not found.findings and np.isnan(found.limit_rad)


def test_a_fixed_calibration():
    """Response and crosstalk that a calibration does not hold are put into it from the frame that shows them."""
    runtime.init("cpu")
    truth = simulate_frame(simulated_rig(), SimulationSettings(scene="plane"))
    old = truth.rig.model_copy(update={"crosstalk_matrix": np.eye(3)})
    frame = Decoder(DecodeSettings(equalize=False), old, arch="cpu").decode(truth.image)
    found = diagnose(truth.image, 255, frame.unwrapped_phase, frame.mask, np.eye(3))
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
