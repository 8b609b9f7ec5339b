"""Checks of a calibration from files, and light that one frame corrects in a calibration."""

import cv2
import numpy as np
import pytest

from pipeline.decoder import Decoder
from pipeline.decoding.footage_light import with_transfer_of
from pipeline.diagnosis import rig_check
from pipeline.diagnosis.rig_check import check_picture, check_sequence, holds_captures
from pipeline.diagnosis.ripple import Diagnosis
from pipeline.errors import CalibrationError, FootageError
from pipeline.footage.opening import open_footage
from pipeline.models import CameraState
from pipeline.output.range_image import write_png
from pipeline.settings import DecodeSettings
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig
from tikernels.raw.development import develop

# Frames of rigs that differ from what their settings say.
pytestmark = [pytest.mark.usefixtures("cpu"), pytest.mark.filterwarnings("ignore:the colours' fringes differ")]


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
    found = check_picture(open_footage(path), rig, DecodeSettings(), "cpu", "plane")
    assert found.surface is not None and found.surface.fine
    assert found.frame.mask.mean() > 0.5
    wrong = rig.model_copy(update={"crosstalk_matrix": np.eye(3)})
    with pytest.warns(match="the colours' fringes differ by"):
        found = check_picture(open_footage(path), wrong, DecodeSettings(), "cpu")
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
        assert check_picture(open_footage(path), rig, DecodeSettings(), "cpu") is None
    assert not asked
    write_png(path, image)
    with pytest.warns(match="no matrix explains"):  # the picture is linear
        assert check_picture(open_footage(path), rig, DecodeSettings(), "cpu").transfer == "srgb"
    with pytest.warns(match="settings say that transfer is linear and the calibration has measured srgb: omit it"):
        linear = check_picture(open_footage(path), rig, DecodeSettings(transfer="linear"), "cpu")
    assert linear.transfer == "linear"
    assert [arguments[5] for arguments in asked] == ["srgb", "linear"]
    np.testing.assert_array_equal(asked[0][4].crosstalk_matrix, rig.crosstalk_matrix)


def test_frames_in_a_row(plane, tmp_path):
    image, rig = plane
    for number in range(3):
        write_png(tmp_path / f"{number}.png", image)
    assert not holds_captures(tmp_path)
    with pytest.raises(CalibrationError, match="holds 3 pictures: at least 12 frames in a row are needed"):
        check_sequence(open_footage(tmp_path), rig, DecodeSettings(), "cpu")
    with pytest.raises(FootageError, match="holds 3 frames: give one picture"):
        check_picture(open_footage(tmp_path), rig, DecodeSettings(), "cpu")


def test_a_picture_is_read_as_decoding_reads_it(tmp_path, cpu):
    """A JPEG in sRGB with one colour for four pixels: nothing but what the file does not hold is wrong with it."""
    geometry = simulated_rig((400, 300), period_px=1.6 * 768 / 44)
    truth = simulate_frame(geometry, SimulationSettings(scene="plane", transfer="srgb"))
    rig = geometry.model_copy(update={"crosstalk_matrix": SimulationSettings().crosstalk_matrix})
    path = tmp_path / "plane.jpg"
    cv2.imwrite(str(path), truth.image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
    source = open_footage(path)
    settings, _ = with_transfer_of(source, DecodeSettings(), rig)
    found = check_picture(source, rig, settings, "cpu", "plane")
    assert found.transfer == "srgb" and found.surface.fine
    (stored,) = source.frames()
    decoded = Decoder(settings, rig, arch="cpu").decode(develop(stored.planes, stored.format))
    np.testing.assert_array_equal(found.frame.wrapped_phase, decoded.wrapped_phase)
    assert stored.format.subsampling == (2, 2)  # chroma as the file has it, and not what OpenCV makes of it
