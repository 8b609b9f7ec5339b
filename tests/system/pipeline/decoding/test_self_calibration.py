"""Crosstalk and response out of ordinary frames, without a calibration; also of real captures with known phase."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline import Decoder, DecodeSettings
from pipeline.decoding.self_calibration import estimate_light
from pipeline.errors import CalibrationError
from pipeline.footage.image_file import read_image
from pipeline.simulation import WHITE, SimulationSettings, simulate_frame, simulated_rig
from tikernels.phase.frame_statistics import FrameLevels

# Frames of rigs that differ from what their settings say.
pytestmark = [pytest.mark.usefixtures("cpu"), pytest.mark.filterwarnings("ignore:the colours' fringes differ")]

PLANE = Path(__file__).resolve().parents[5] / "shared" / "data" / "kamino_plane"


def phase_error(found, truth, mask):
    """RMS of the phase error, rad, one constant removed, and the constant."""
    error = np.exp(1j * (found - truth)[mask])
    constant = np.angle(error.mean())
    return float(np.sqrt((np.angle(error * np.exp(-1j * constant)) ** 2).mean())), float(constant)


def decoded(truth, **settings):
    decoder = Decoder(DecodeSettings(equalize=False, **settings), arch="cpu")
    frame = decoder.decode(truth.image)
    inside = cv2.erode((frame.mask & truth.mask).astype(np.uint8), np.ones((9, 9))) > 0
    return decoder, frame, *phase_error(frame.wrapped_phase, truth.phase, inside)


def test_later_frames_use_what_the_first_told():
    rig = simulated_rig((320, 240), period_px=2 * 768 / 44)
    first, second = (simulate_frame(rig, SimulationSettings(scene=scene)) for scene in ("bust", "ball"))
    decoder = Decoder(DecodeSettings(), arch="cpu")
    decoder.decode(first.image)
    told = decoder.state.light
    frame = decoder.decode(second.image)
    assert decoder.state.light is told and told.reliable
    inside = cv2.erode((frame.mask & second.mask).astype(np.uint8), np.ones((9, 9))) > 0
    assert phase_error(frame.wrapped_phase, second.phase, inside)[0] < 0.04


def test_nothing_to_win_is_not_lost():
    """Neither crosstalk nor response: the estimate must not make it worse."""
    truth = simulate_frame(
        simulated_rig(), SimulationSettings(scene="plane", gamma=1.0, crosstalk_matrix=np.eye(3), reflectance=WHITE)
    )
    *_, plain, _ = decoded(truth, crosstalk_matrix=np.eye(3))
    *_, own, _ = decoded(truth)
    assert own < 1.05 * plain


def test_pixels_that_have_no_phase_say_nothing():
    """And nothing is warned of beside that."""
    levels = FrameLevels(1.0, read_noise=0.005, noise_gain=0.0, noise=0.005, intensity=0.05, modulation=0.05)
    with pytest.raises(CalibrationError, match="0 samples of a surface"):
        estimate_light(np.full((64, 64, 3), 0.5, np.float32), levels, 12.0, cycles=5.0)


def test_too_small_an_object_says_nothing():
    truth = simulate_frame(simulated_rig(), SimulationSettings(scene="plane"))
    small = np.zeros_like(truth.image)
    small[200:240, 300:340] = truth.image[200:240, 300:340]
    decoder = Decoder(DecodeSettings(camera_period_px=12), arch="cpu")
    frame = decoder.decode(small)
    assert not frame.constant_known
    assert decoder.state.light is None or not decoder.state.light.reliable


@pytest.mark.parametrize(("name", "bound"), [("gp075", 0.06), ("gp125", 0.078)])
def test_a_real_plane(name, bound):
    """Real non-linearity, five cycles in view: plain arctangent leaves 0.194 and 0.078 rad."""
    if not PLANE.exists():
        pytest.skip("the real captures are not here (shared/data/kamino_plane)")
    truth = np.load(PLANE / "plane_truth.npz")
    shrunk = cv2.resize(read_image(PLANE / f"plane_{name}_rgb.png"), None, fx=0.25, fy=0.25, interpolation=3)
    phase = cv2.resize(truth["phase_abs"].astype(np.float64), shrunk.shape[1::-1], interpolation=cv2.INTER_AREA)
    mask = cv2.resize(truth["mask"].astype(np.float32), shrunk.shape[1::-1], interpolation=cv2.INTER_AREA) > 0.999
    decoder = Decoder(DecodeSettings(stripes="vertical"), arch="cpu")
    frame = decoder.decode(np.ascontiguousarray(shrunk))
    assert decoder.state.light.reliable
    error, _ = phase_error(frame.wrapped_phase, phase, mask & frame.mask)
    assert error < bound
