"""What is planned, what is warned of, and motion against simulated frames that move."""

import math
import re

import numpy as np
import pytest
from support.planned_rigs import exposure, inside, phase_error, simulated, simulation

from hardware.errors import RigError
from pipeline.decoder import Decoder
from pipeline.errors import SettingsError
from pipeline.pattern import make_pattern
from pipeline.planning import plan_rig
from pipeline.planning.rig_plan import LEAST_CAMERA_PX, MOST_CAMERA_PX, USUAL_CAMERA_PX
from pipeline.settings import DecodeSettings
from pipeline.simulation import simulate_frame


def test_the_usual_rig_needs_no_warning():
    plan = plan_rig()
    assert plan.warnings == ()
    assert plan.depth_sigma_mm == plan.phase_sigma_rad * plan.fringe.depth_per_rad_mm
    assert plan.fringe.depth_per_cycle_mm == pytest.approx(2 * math.pi * plan.fringe.depth_per_rad_mm, rel=0.01)


def test_the_second_code_places_smaller_surfaces():
    """Of five cycles by eight cells of half a cycle, which are as wide as high."""
    plan = plan_rig()
    assert plan.code_mm == 9 * plan.fringe.pitch_mm
    pitch = plan.fringe.pitch_mm
    assert plan.window_mm == pytest.approx((5 * pitch, 4 * pitch), rel=0.03)
    coarse = plan_rig(camera_px=(320, 240), pixel_um=9.6, period_px=18)
    assert coarse.window_mm[1] == pytest.approx(8 * 4.5 * coarse.fields.mm_per_px)


@pytest.mark.parametrize(
    "values",
    [{}, {"distance_mm": 400.0, "baseline_mm": 80.0}, {"camera_px": (1920, 1200), "lens_mm": 16.0, "pixel_um": 5.86}],
)
def test_the_recommended_period_can_be_seen_and_shown(values):
    """Twelve camera px, or more where the projector's px are coarse; the pattern with the code can be made of it."""
    plan = plan_rig(**values)
    assert LEAST_CAMERA_PX < USUAL_CAMERA_PX <= plan.fringe.period_camera_px <= MOST_CAMERA_PX
    rig = plan.choice.calibration(plan.period_px)
    make_pattern(plan.choice.projector_px, rig.geometry().pattern)
    assert plan_rig(**values, period_px=plan.period_px) == plan_rig(
        **{**values, "period_px": plan.period_px, "exposure_s": None}
    )


def test_coarse_projector_pixels_make_longer_cycles():
    plan = plan_rig(surface="white", camera_px=(4000, 3000), pixel_um=1.85, lens_mm=12.0)
    assert plan.period_px == 8.0 and plan.fringe.period_camera_px > MOST_CAMERA_PX
    assert any("take a projector with more px" in warning for warning in plan.warnings)


NEAR = {"distance_mm": 400.0, "baseline_mm": 80.0, "camera_px": (1440, 1080), "pixel_um": 3.45, "lens_mm": 8.0}


def test_skin_takes_longer_cycles_than_white():
    """Red, which travels by 1.2 mm, keeps 0.6 of its contrast at 7.6 mm a cycle and 0.88 at 15."""
    white, skin = (plan_rig(**NEAR, surface=surface) for surface in ("white", "skin"))
    assert white.contrast_left == (1.0, 1.0, 1.0) and white.fringe.period_camera_px == pytest.approx(12, rel=0.02)
    assert skin.fringe.pitch_mm == pytest.approx(4.9, rel=0.01) and skin.contrast_left[0] == pytest.approx(
        0.3, abs=0.01
    )
    assert not any("scatters" in warning or "precision" in warning for warning in (*skin.warnings, *white.warnings))
    for pitch_mm, left in ((7.6, 0.61), (15.0, 0.88)):
        period_px = skin.period_px * pitch_mm / skin.fringe.pitch_mm
        assert plan_rig(**NEAR, period_px=period_px).contrast_left[0] == pytest.approx(left, abs=0.01)


def test_cycles_too_short_for_skin_are_warned_of_with_the_cure():
    (warning,) = (text for text in plan_rig(**NEAR, period_px=8.5).warnings if "scatters" in text)
    cure = float(re.search(r"give a period of ([\d.]+) px", warning).group(1))
    assert not any("scatters" in text for text in plan_rig(**NEAR, period_px=cure).warnings)


@pytest.mark.parametrize(
    "values, cure",
    [
        ({"throw_ratio": 2.2}, "take a throw ratio of 1.93 or less, or a camera's lens of 6.9 mm or more"),
        ({"baseline_mm": 500.0}, "a step hides half of its height: a fifth is usual, 180 mm"),
        ({"baseline_mm": 40.0}, "little depth is in the phase: a fifth is usual, 180 mm"),
        ({"period_px": 11.0}, "8.0 camera px per cycle lose contrast in the lens: give a longer period, or none"),
        ({"period_px": 30.0}, "22 camera px per cycle lose precision in depth: take a shorter period, or none"),
        (
            {"period_px": 30.0},
            "only 22 cycles are in view, and a frame does not determine the projector's response well",
        ),
        ({"period_px": 90.0}, "only 7 cycles are in view, and the code may not place them"),
        ({"camera_px": (160, 120)}, "the board's squares are 15 camera px, and not surely found below 24"),
        ({"exposure_s": 0.1}, "moves 10 mm in an exposure of 100 ms, and details smaller than that are lost"),
        ({"colour_cycle_s": 1 / 60}, "colours in turn put a ripple of up to 0.23 mm RMS on the depth"),
    ],
)
def test_what_is_wrong_is_warned_of_with_the_cure(values, cure):
    assert sum(cure in warning for warning in plan_rig(**values).warnings) == 1


@pytest.mark.parametrize("values", [{"throw_ratio": 2.2}, {"throw_ratio": 1.95}, {"throw_ratio": 3.0}])
def test_the_cure_of_a_small_picture_is_one(values):
    """With the throw ratio that the plan names, or the lens, nothing is dark any more."""
    plan = plan_rig(**values)
    room = plan.fields.picture_over_needed
    for cured in (plan_rig(throw_ratio=room * values["throw_ratio"]), plan_rig(**values, lens_mm=6.0 / room)):
        assert cured.fields.lit_share > 0.98 and not any("lights" in warning for warning in cured.warnings)


@pytest.mark.parametrize(
    "values, message",
    [
        ({"baseline_mm": 1000.0}, "the rig: a baseline of 1000 mm is as long as the distance"),
        (
            {"throw_ratio": 0.15, "baseline_mm": 500.0},
            "an edge of the projector's picture never meets the object's plane, as its throw ratio is 0.15: take a",
        ),
        ({"throw_ratio": 9.0}, "the projector lights 5.2 % of what the camera sees"),
        (
            {"period_px": 5.0},
            "the code distinguishes 136 cycles, but 768 px hold 154 of 5 px: give a period of 16.5 px",
        ),
        ({"period_px": 300.0}, "fewer than four cycles on the projector's 768 px: give a period of 16.5 px"),
        ({"period_px": 8.0}, "a period of 8 px is 5.84 camera px, too short to be seen: give 16.5 px"),
        ({"camera_px": (64, 64), "lens_mm": 0.6, "throw_ratio": 2.6}, "not even four cycles would be seen"),
        ({"speed_mm_s": -1.0}, "speed_mm_s"),
        ({"shoe_size": 43}, "shoe_size: is not a known key"),
    ],
)
def test_what_cannot_be_is_one_line(values, message):
    with pytest.raises(SettingsError, match=message) as refused:
        plan_rig(**values)
    assert "\n" not in str(refused.value)


def test_an_exposure_is_a_whole_number_of_colour_cycles():
    with pytest.raises(RigError, match=r"is 1\.2 colour cycles"):
        plan_rig(exposure_s=0.02, colour_cycle_s=1 / 60)
    plan = plan_rig(colour_cycle_s=1 / 240, speed_mm_s=10.0)
    cycles = plan.exposure_s * 240
    assert cycles == pytest.approx(round(cycles)) and cycles > 1
    assert plan.exposure_s <= plan.longest_exposure_s < plan.exposure_s + 1 / 240


def test_what_holds_still_may_be_exposed_for_any_time():
    plan = plan_rig(speed_mm_s=0.0)
    assert plan.longest_exposure_s == math.inf and plan.exposure_s is None and plan.passed_mm == 0
    assert plan_rig(speed_mm_s=0.0, exposure_s=1.0).warnings == ()


@pytest.mark.usefixtures("cpu")
def test_motion_in_the_longest_exposure_costs_no_more_than_the_noise():
    """A bust moves across the stripes, where motion costs most; the truth is that of the exposure's middle."""
    plan, rng = plan_rig(), np.random.default_rng(0)
    rig, _ = simulated(plan)
    settings, squares = simulation(plan, noise_levels=0.0, bits=16, scene="bust"), []
    settings = settings.model_copy(update={"exposure": exposure(rig, settings)})
    for passed_mm in (0.0, plan.passed_mm):
        places = passed_mm * (np.arange(9) - 4) / 9
        taken = [simulate_frame(rig, settings.model_copy(update={"object_motion_mm": (0, y, 0)})) for y in places]
        light = np.mean([frame.image / frame.white_level for frame in taken], axis=0)
        image = np.rint(np.clip(255 * light + rng.normal(0, plan.choice.noise_levels, light.shape), 0, 255))
        frame = Decoder(DecodeSettings(), rig).decode(image.astype(np.uint8))
        here = inside(frame, taken[4], 4)
        error = phase_error(frame, taken[4], here)
        squares.append(np.mean(error**2))
        assert np.sqrt(np.mean((error / frame.phase_sigma[here]) ** 2)) < 1.25
    assert 1 < squares[1] / squares[0] < 2


@pytest.mark.usefixtures("cpu")
def test_colours_in_turn_leave_no_more_ripple_than_planned():
    """A white ball before a wall that stands still moves between red, green and blue; without noise.

    The plan is the plain arctangent's; the decoder's model of the light takes off a third, and no more than half. The
    shape is that of the middle colour, to a tenth of what the ball moves from one to the next.
    """
    plan = plan_rig(surface="white", colour_cycle_s=1 / 60, speed_mm_s=150.0)
    rig, _ = simulated(plan)
    between_mm = plan.choice.speed_mm_s * plan.choice.colour_cycle_s / 3
    settings = simulation(plan, noise_levels=0.0, bits=16, texture=0.0, scene="ball")
    off = []
    for motion in (0.0, between_mm):
        truth = simulate_frame(rig, settings.model_copy(update={"field_motion_mm": (0, 0, motion)}))
        frame = Decoder(DecodeSettings(white_level=truth.white_level), rig).decode(truth.image)
        off.append(frame.points[..., 2] - truth.points[..., 2])
    moved = (off[1] - off[0])[inside(frame, truth, 12) & (truth.points[..., 2] < 880)]
    moved = moved[np.isfinite(moved)]
    assert np.mean(moved) == pytest.approx(between_mm, rel=0.1)
    assert 0.5 < np.std(moved) / plan.colour_bias_mm < 0.9


def test_orders_are_carried_while_a_third_of_a_cycle_goes_by():
    plan = plan_rig(speed_mm_s=150.0)
    assert plan.least_rate_hz == pytest.approx(150 / (plan.fringe.depth_per_cycle_mm / 3))
