"""Every fault is named on a rig that has it and no other, and none on a rig without."""

from math import isfinite

import numpy as np
import pytest

from pipeline.acquisition.camera_effects import CameraEffects
from pipeline.acquisition.exposure import ExposureFinder
from pipeline.acquisition.focus import FocusMeter
from pipeline.acquisition.light_cycle import FlashMeter
from pipeline.acquisition.light_fields import measure_fields
from pipeline.acquisition.rig_faults import RigProbe
from pipeline.acquisition.simulated_camera import CameraFaults
from pipeline.acquisition.simulated_studio import SimulatedStudio, StudioFaults
from pipeline.acquisition.tone_curve import measure_tone_curve
from pipeline.calibration.model import DEFAULT_PERIOD_PX
from pipeline.simulation import simulated_rig

#: A camera of few pixels, and of a black level that clips nothing.
TRUTH = simulated_rig((400, 300), code="contrast")
BLACK = {"black_levels": 5.0}
EXPOSURE_S = 1 / 60


def rig(exposure_s=EXPOSURE_S, camera=None, **faults):
    """Return a simulated rig before a white sheet."""
    developed = CameraFaults(**BLACK | (camera or {}))
    return SimulatedStudio(
        None, exposure_s, truth=TRUTH, faults=StudioFaults(**{"light": 0.9} | faults, camera=developed), seed=3
    )


def probed(studio):
    """Return a probe that has looked at black and white and knows the scale."""
    probe = RigProbe(studio)
    assert probe.look() is None
    probe.mirrored()
    return probe


@pytest.mark.parametrize(
    "faults, key",
    [
        ({}, None),
        ({"light": 0.02}, "no light"),
        ({"light": 2.0}, "too bright"),
        ({"mirrored": True}, "mirrored picture"),
        ({"swapped": True}, "swapped colours"),
        ({"scale": 0.95}, "resampled picture"),
        ({"keystone": 0.1}, "resampled picture"),
    ],
)
def test_faults_of_the_picture(faults, key):
    assert [fault.key for fault in RigProbe(rig(**faults)).faults()] == ([] if key is None else [key])


@pytest.mark.parametrize(
    "camera, projector_blur_px, key",
    [
        ({}, 0, None),
        ({"curve": "srgb"}, 0, None),
        ({"curve": "srgb", "sharpening": 0.5}, 0, "sharpening"),
        ({"curve": "srgb", "chroma": "interpolated"}, 0, "chroma subsampling"),
        ({"auto_exposure": True}, 0, "automatic exposure"),
        ({"auto_white_balance": True}, 0, "automatic white balance"),
        ({"sharpening": 0.5}, 0, "sharpening"),
        ({"jpeg_quality": 80}, 0, "compression"),
        ({"chroma": "replicated"}, 0, "chroma subsampling"),
        ({"chroma": "interpolated"}, 0, "chroma subsampling"),
        ({"blur_px": 2.0}, 0, "focus"),
        ({}, 5, "focus"),
    ],
)
def test_faults_of_the_camera(camera, projector_blur_px, key):
    probe = probed(rig(camera={"curve": "linear"} | camera, focus_px=projector_blur_px))
    code = 0.7  # which automatic exposure does not saturate
    effects = CameraEffects(probe, measure_tone_curve(probe, code), code, DEFAULT_PERIOD_PX, 0)
    found = effects.find()
    assert [fault.key for fault in found] == ([] if key is None else [key])
    assert all(0 < fault.cost_rad < 3 for fault in found)


@pytest.mark.parametrize("automatic", [False, True])
@pytest.mark.parametrize("curve", ["linear", "srgb"])
def test_a_known_tone_curve_has_its_name(curve, automatic):
    found = measure_tone_curve(probed(rig(camera={"curve": curve, "auto_exposure": automatic})), 0.7)
    assert found.is_named
    assert found.transfer == curve
    half = found.to_light(found.levels) / found.to_light(found.levels[-1:])
    # Of light between black's and white's, to a hundredth: what a sensor is linear to.
    np.testing.assert_allclose((half - half[0]) / (1 - half[0]), [0, 0.25, 0.5, 0.75, 1], atol=0.01)


def test_an_s_curve_is_none_that_is_known():
    found = measure_tone_curve(probed(rig(camera={"curve": "s", "curve_strength": 0.7})), 0.9)
    assert not found.is_named
    light = found.to_light(found.levels)
    np.testing.assert_allclose(light / light[-1], [0, 0.25, 0.5, 0.75, 1], atol=1e-6)


def test_clipped_black():
    lost = measure_tone_curve(probed(rig(camera={"black_levels": -12.0})), 0.9)
    kept = measure_tone_curve(probed(rig()), 0.9)
    assert kept.clipped < 0.05 < lost.clipped
    # 12 levels less than none, of which black's own 4 are missing: of 255 * 0.8.
    assert 0.02 < lost.lost < 0.06
    assert kept.lost == 0


@pytest.mark.parametrize("at_once", [False, True])
def test_the_cycle_of_the_light(at_once):
    studio = rig(colour_cycle_s=1 / 143.7, at_once=at_once, room=0.1)
    meter = FlashMeter(probed(studio), 0.6, EXPOSURE_S, 0.0, lambda values: values)
    cycle = meter.cycle()
    # A quarter of what an exposure may be off (colour_cycle.py).
    assert cycle.period_s == pytest.approx(1 / 143.7, rel=5e-4)
    assert cycle.in_turns is not at_once
    assert meter.variation(cycle.nearest_s(EXPOSURE_S)).sigma < 0.001
    assert meter.variation(2.4 * cycle.period_s).sigma > 0.02
    assert meter.variation(0.015).room > 0.005
    assert meter.variation(0.020).room < 0.002  # two turns of light that flickers at 100 Hz


def test_constant_light_has_no_cycle():
    assert FlashMeter(probed(rig()), 0.6, EXPOSURE_S, 0.0, lambda values: values).cycle() is None


@pytest.mark.parametrize(
    "faults, curve",
    [
        # Blue, green, red and a dark gap, before a rolling shutter; red, blue and green before a global one.
        ({"shown": np.array([[0.55, 0.85], [0.3, 0.55], [0.0, 0.3]]), "row_s": 20e-6, "jitter_s": 2e-4}, "linear"),
        ({"shown": np.array([[0.0, 0.35], [0.7, 1.0], [0.4, 0.7]]), "jitter_s": 1e-6, "room": 0.1}, "srgb"),
    ],
)
def test_times_of_colours_and_rows(faults, curve):
    studio = rig(colour_cycle_s=1 / 118, camera={"curve": curve}, **faults)
    probe = probed(studio)
    curve = measure_tone_curve(probe, 0.8)
    found = measure_fields(probe, curve.to_light, 1.001 / 118, 0.9 / EXPOSURE_S)
    assert found.doubt is None
    assert found.period_s == pytest.approx(1 / 118, rel=5e-5)
    shown = faults["shown"] - faults["shown"][0, 0]
    errors = 118 * found.shown_s - shown
    # A hundredth of a cycle costs what a third of one costs, times .03: motion of one field is undone to that.
    assert np.abs(errors - np.rint(errors)).max() < 0.01
    assert np.abs(errors - np.rint(errors)).max() / 118 < 3 * found.shown_sigma_s
    assert found.row_s == pytest.approx(faults.get("row_s", 0.0), abs=0.1e-6)
    assert abs(found.white) < 0.05


def test_exposures_that_are_too_long_for_fields():
    studio = rig(colour_cycle_s=1 / 118)
    probe = probed(studio)
    slow = measure_fields(probe, lambda values: values, 5e-5, 0.9 / EXPOSURE_S)
    assert slow == "the camera's shortest exposure, 0.020 ms, is longer than a third of the cycle"


def find(studio, exposure_s=EXPOSURE_S):
    return ExposureFinder(studio, exposure_s, 0.0, DEFAULT_PERIOD_PX, 0).find()


def test_a_rig_without_faults():
    found = find(rig())
    assert found.faults == ()
    assert found.level == pytest.approx(0.9, abs=0.02)
    assert found.gain_db == 0
    assert found.cycle is None
    assert found.fields is None
    assert found.contrast.min() > 0.9


def test_brightness_room_and_cycle():
    """Four faults at once, and exposure and gain that cure two of them; the room is bright, and it flickers."""
    found = find(rig(0.0137, colour_cycle_s=1 / 87, light=0.2, room=0.05), 0.0137)
    keys = {fault.key for fault in found.faults}
    assert keys == {"too dark", "exposure off the cycle", "flickering room light", "bright black"}
    costs = [fault.cost_rad for fault in found.faults]
    assert costs == sorted(costs, reverse=True)
    assert all(isfinite(cost) for cost in costs)
    assert found.exposure_s == pytest.approx(2 / 87, rel=5e-4)  # a third cycle is longer than a frame
    assert found.level == pytest.approx(0.9, abs=0.03)
    # Of full scale, white has 0.19 at the first exposure, the room 0.05, and the camera's black 0.02.
    assert found.gain_db == pytest.approx(20 * np.log10(0.9 / (0.26 * (2 / 87) / 0.0137)), abs=1)


def test_focus_grows_with_sharpness():
    blurred, sharp = (
        FocusMeter(probed(rig(camera={"blur_px": blur_px})), lambda values: values, 0.9, DEFAULT_PERIOD_PX, 0)
        for blur_px in (1.5, 0.0)
    )
    # exp(-2 (pi sigma / period)^2), of 7.6 camera px per period and 1.5 px of blur.
    assert (blurred.contrast() / sharp.contrast()) == pytest.approx(np.full(3, 0.46), abs=0.08)
    assert blurred.scene_sharpness() < sharp.scene_sharpness() + 1e-3
