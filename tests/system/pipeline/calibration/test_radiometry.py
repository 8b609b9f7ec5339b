"""Ramps in, response and crosstalk out: against the truth of a simulated rig, and what captures are refused."""

import json

import cv2
import numpy as np
import pytest

from pipeline import Calibration, Decoder, DecodeSettings, DecodeWarning
from pipeline.calibration.captures import SEQUENCE_FILE, CapturedFolder, PictureSequence, write_sequence
from pipeline.calibration.model import ColorShift
from pipeline.calibration.radiometry import (
    RAMP_CODES,
    measure_radiometry,
    radiometry_codes,
    radiometry_sequence,
)
from pipeline.errors import CalibrationError, OutputError
from pipeline.footage.image_file import read_image
from pipeline.models import CameraState
from pipeline.output.report import measure_against_truth
from pipeline.simulation import TYPICAL_CROSSTALK, SimulationSettings, simulate_frame, simulated_rig

SEQUENCE = radiometry_sequence((1024, 768))
GREY = f"{len(SEQUENCE.names) - 1:02d}-grey-255"


def captured(
    gamma=2.0, transfer="linear", noise=1.5, seed=0, shading=True, ambient=0.05, bits=8, matrix=TYPICAL_CROSSTALK
):
    """Return the captures of a rig whose light is known: a white target that is not lit evenly."""
    rng = np.random.default_rng(seed)
    shade = np.linspace(0.5, 1.0, 80)[:, None] if shading else np.ones((80, 1))
    captures = {}
    for name in SEQUENCE.names:
        light = np.array(matrix) @ radiometry_codes(name) ** gamma
        image = np.broadcast_to(0.72 * shade[..., None] * light + ambient, (80, 100, 3))
        if transfer == "srgb":
            image = np.where(image <= 0.0031308, 12.92 * image, 1.055 * image ** (1 / 2.4) - 0.055)
        elif transfer == "own":  # no standard: a toe and a shoulder
            image = image**0.7 * (1.25 - 0.25 * image)
        full = 2**bits - 1
        noisy = full * image + noise * full / 255 * rng.standard_normal(image.shape)
        captures[name] = np.clip(np.rint(noisy), 0, full).astype(np.uint8 if bits == 8 else np.uint16)
    return captures


def rows_divided(matrix):
    return matrix / matrix.sum(axis=1, keepdims=True)


@pytest.mark.parametrize(
    ("gamma", "transfer", "bits"),
    [(1.0, "linear", 8), (1.6, "linear", 16), (2.4, "linear", 8), (2.0, "srgb", 8), (2.2, "srgb", 16)],
)
def test_against_the_truth(gamma, transfer, bits):
    """The goal is a hundredth; a thousandth is what this rig's noise and eight bits leave."""
    found = measure_radiometry(captured(gamma, transfer, bits=bits))
    assert isinstance(found.transfer, str) and found.transfer == transfer
    truth = np.array(TYPICAL_CROSSTALK)
    np.testing.assert_allclose(rows_divided(found.crosstalk_matrix), rows_divided(truth), atol=1e-3)
    codes = np.arange(256) / 255
    np.testing.assert_allclose(found.response, np.tile(codes**gamma, (3, 1)), atol=2e-3)
    assert found.additivity < 2e-3
    np.testing.assert_allclose(found.ambient, 0.05, atol=2e-3)


def test_standard_deviations_cover_the_truth():
    """Twenty noisy rigs: two of their standard deviations hold nine tenths of the coefficients."""
    truth = 0.72 * np.array(TYPICAL_CROSSTALK)
    inside = []
    for seed in range(20):
        found = measure_radiometry(captured(seed=seed, noise=4.0, shading=False))
        inside.append(np.abs(found.crosstalk_matrix - truth) < 2 * found.crosstalk_sigma)
    assert np.mean(inside) > 0.9


def test_a_transfer_that_no_standard_names():
    found = measure_radiometry(captured(transfer="own"))
    assert not isinstance(found.transfer, str)
    np.testing.assert_allclose(
        rows_divided(found.crosstalk_matrix), rows_divided(np.array(TYPICAL_CROSSTALK)), atol=0.01
    )
    np.testing.assert_allclose(found.response, np.tile((np.arange(256) / 255) ** 2, (3, 1)), atol=0.01)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda c: c.update({n: np.minimum(2 * c[n].astype(int), 255).astype(np.uint8) for n in c}), "at full scale"),
        (lambda c: c.update({n: (c[n] // 32) for n in c}), "hardly brighter"),
        (lambda c: c.update({"05-red-160": c["02-red-064"]}), "04-red-128|05-red-160 is darker"),
        (lambda c: c.update({n: np.ascontiguousarray(c[n][..., ::-1]) for n in c}), "BGR"),
        # A white segment: grey is brighter than its parts.
        (lambda c: c.update({n: (1.08 * c[n]).astype(np.uint8) for n in c if "grey" in n}), "colour mode"),
        (
            lambda c: c.update(captured(noise=0.0, bits=16, matrix=0.33 + 0.005 * np.eye(3))),
            "hardly distinguishes the projector's colours",
        ),
        (lambda c: c.update({n: np.minimum(20 * c[n].astype(np.uint16), 4095) for n in c}), "end at 4095"),
    ],
)
def test_refused_captures(spoil, message):
    captures = captured()
    spoil(captures)
    with pytest.raises(CalibrationError, match=message) as raised:
        measure_radiometry(captures)
    assert "\n" not in str(raised.value)


def test_a_transfer_named_wrongly():
    with pytest.raises(CalibrationError, match="transfer"):
        measure_radiometry(captured(transfer="srgb"), transfer="linear")


def test_the_sequence_and_its_captures(tmp_path):
    folder = tmp_path / "make"
    small = radiometry_sequence((40, 30))
    write_sequence(folder, small, lambda name: np.broadcast_to(radiometry_codes(name), (30, 40, 3)))
    assert PictureSequence.model_validate_json((folder / SEQUENCE_FILE).read_text()) == small
    assert len(small.names) == 1 + 4 * len(RAMP_CODES)
    np.testing.assert_array_equal(read_image(folder / "08-red-255.png")[0, 0], (255, 0, 0))
    with pytest.raises(OutputError, match="not an empty folder"):
        write_sequence(folder, small, lambda name: np.zeros((30, 40, 3)))
    captures = CapturedFolder(folder, small.names)
    assert captures[GREY].shape == (30, 40, 3)
    cv2.imwrite(str(folder / "03-red-096.png"), np.zeros((20, 40, 3), np.uint8))
    with pytest.raises(CalibrationError, match=r"03-red-096.png is 40x20 .* others are 40x30"):
        captures["03-red-096"]
    (folder / "02-red-064.png").unlink()
    with pytest.raises(CalibrationError, match=r"lacks the capture 02-red-064.png"):
        CapturedFolder(folder, small.names)


def test_a_calibration_of_light_alone(tmp_path):
    """It has no millimetres, but phases; a geometry keeps it; it is never overwritten by accident."""
    found = measure_radiometry(captured())
    path = tmp_path / "calibration.json"
    light = found.add_to(None, CameraState(exposure_s=0.01))
    light.write(path)
    again = Calibration.read(path)
    assert not again.has_geometry
    assert json.loads(path.read_text())["capture"]["transfer"] == "linear"
    with pytest.raises(CalibrationError, match="no geometry"):
        again.geometry()
    with pytest.raises(OutputError, match="exists already"):
        again.write(path, force=False)
    with pytest.warns(DecodeWarning, match="exposure_s is 0.02 but was 0.01"):
        Decoder(DecodeSettings(capture=CameraState(exposure_s=0.02)), again, arch="cpu")
    image = simulate_frame(simulated_rig((160, 120), period_px=4 * 768 / 44)).image
    frame = Decoder(DecodeSettings(), again, arch="cpu").decode(image)
    assert frame.points is None and frame.mask.any()
    whole = found.add_to(simulated_rig())
    assert whole.has_geometry and whole.response is not None


def test_response_and_lateral_colour_together():
    """The response bends fringes that lie beside their place: 0.12 rad if its table takes them to lie in place.

    What stays, 0.03 rad, is the balance's, which takes the light for sinusoids.
    """
    rig = simulated_rig((320, 240))
    shift = np.array([[0.0, 0.7], [0.0, 0.0], [0.0, -0.5]])
    truth = simulate_frame(
        rig, SimulationSettings(scene="plane", gamma=2.0, projector_shift_px=shift, noise_levels=0.3)
    )
    codes = np.linspace(0, 1, 256)
    calibration = rig.model_copy(
        update={
            "crosstalk_matrix": np.array(TYPICAL_CROSSTALK),
            "response": np.tile(codes**2.0, (3, 1)),
            "pattern": rig.pattern.model_copy(update={"compensated": False}),
            "color_shift_px": ColorShift(camera=np.zeros((3, 2)), projector=shift),
        }
    )
    frame = Decoder(DecodeSettings(), calibration, arch="cpu").decode(truth.image)
    assert measure_against_truth(frame, truth)["phase_rms_rad"] < 0.04
