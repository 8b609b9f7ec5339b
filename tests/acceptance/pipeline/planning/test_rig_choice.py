"""The planned geometry, against the calibration that such a rig has, and against frames."""

import math

import numpy as np
import pytest
from support.planned_rigs import RIGS, simulated, simulation

from pipeline.decoder import Decoder
from pipeline.planning import RigChoice, plan_rig
from pipeline.planning.rig_choice import angle_deg, fringe_geometry, seen_fields
from pipeline.settings import DecodeSettings
from pipeline.simulation import simulate_frame

# How far the simulator's plane leans back, a mm downwards and to the right.
LEANS = {"horizontal": 0.2, "vertical": 0.25}


@pytest.mark.parametrize("name", ["usual", "hand-size, near", "narrow, beside"])
@pytest.mark.usefixtures("cpu")
def test_a_radian_of_a_decoded_frame_is_as_much_depth_as_planned(name):
    """A plane is moved by a hundredth of its distance; what its phase changes by in the middle, within 1 %."""
    plan = plan_rig(**RIGS[name])
    rig, larger = simulated(plan)
    decoder, phases = Decoder(DecodeSettings(stripes=plan.choice.stripes), rig), []
    rows, columns = (slice(length // 2 - 20, length // 2 + 20) for length in plan.choice.camera_px[::-1])
    for depth_mm in (-4.5, 4.5):
        frame = decoder.decode(simulate_frame(rig, simulation(plan, object_motion_mm=(0, 0, depth_mm))).image)
        phases.append(np.median(frame.unwrapped_phase[rows, columns]))
    seen = 9 / larger / abs(phases[1] - phases[0])
    assert seen == pytest.approx(plan.fringe.depth_per_rad_mm, rel=0.01)


@pytest.mark.parametrize("name", RIGS)
@pytest.mark.usefixtures("cpu")
def test_a_cycle_is_as_many_camera_px_as_planned(name):
    """Of a plane that leans back, whose cycles are longer by what they gain in depth: in the middle, within 0.5 %."""
    plan = plan_rig(**RIGS[name])
    truth = simulate_frame(*simulated(plan)[:1], simulation(plan))
    across = 0 if plan.choice.phase_axis == 1 else 1
    slope = np.abs(np.gradient(truth.phase, axis=across))
    rows, columns = (slice(length // 2 - 5, length // 2 + 5) for length in slope.shape)
    lean = LEANS[plan.choice.stripes] * plan.choice.baseline_mm / plan.choice.distance_mm
    seen = 2 * np.pi / slope[rows, columns].mean()
    assert seen == pytest.approx(plan.fringe.period_camera_px / (1 - lean), rel=5e-3)


@pytest.mark.parametrize("name", RIGS)
def test_depths_are_those_of_the_calibration(name):
    """Along the camera's axis: a cycle's, and where the projector's picture ends, to a millionth."""
    plan = plan_rig(**RIGS[name])
    choice, geometry = plan.choice, plan.choice.calibration(plan.period_px).geometry()

    def cycles(depth_mm):
        return geometry.pattern_cycles(np.array([[0.0, 0.0, depth_mm]]))[0]

    step = 1e-3
    rate = (cycles(choice.distance_mm + step) - cycles(choice.distance_mm - step)) / (2 * step)
    assert 1 / abs(2 * np.pi * rate) == pytest.approx(plan.fringe.depth_per_rad_mm, rel=1e-6)
    middle = (choice.projector_px[choice.phase_axis] - 1) / 2 / plan.period_px
    assert cycles(choice.distance_mm) == pytest.approx(middle)
    near, far = plan.fringe.lit_range_mm
    half = choice.projector_px[choice.phase_axis] / 2 / plan.period_px
    assert abs(cycles(near) - middle) == pytest.approx(half, rel=1e-6)
    if far < math.inf:
        assert abs(cycles(far) - middle) == pytest.approx(half, rel=1e-6)
    else:
        assert abs(cycles(1e9) - middle) < half


@pytest.mark.usefixtures("cpu")
def test_what_is_lit_is_what_the_simulator_lights():
    """Of a rig whose projector's picture is too small: within 6 % of the camera's, as the simulator's plane leans."""
    choice = RigChoice(throw_ratio=2.2)
    rig = choice.calibration(17.0)
    mask = simulate_frame(rig, simulation(plan_rig(throw_ratio=2.2))).mask
    fields = seen_fields(choice)
    assert fields.lit_share == pytest.approx(mask.mean(), abs=0.06)
    assert fields.lit_share < 0.9 and fields.picture_over_needed < 1
    enough = seen_fields(RigChoice(throw_ratio=2.2 * fields.picture_over_needed))
    assert enough.lit_share == 1 and enough.picture_over_needed == pytest.approx(1, abs=0.02)


def test_fields_follow_from_similar_triangles():
    fields = seen_fields(RigChoice(baseline_mm=10.0))
    sensor_mm, image_mm = 640 * 4.8e-3, 1 / (1 / 6 - 1 / 900)
    assert fields.camera_mm[0] == pytest.approx(sensor_mm * 900 / image_mm)
    assert fields.projector_mm[0] == pytest.approx(900 / 1.75, rel=1e-3)
    assert fields.overlap_mm == pytest.approx(fields.camera_mm)


def test_stripes_both_ways_are_alike_but_for_the_pictures_sides():
    level, upright = (RigChoice(stripes=stripes) for stripes in ("horizontal", "vertical"))
    assert fringe_geometry(level, 17.0).depth_per_rad_mm == fringe_geometry(upright, 17.0).depth_per_rad_mm
    assert fringe_geometry(level, 17.0).pitch_mm == pytest.approx(fringe_geometry(upright, 17.0).pitch_mm)
    assert fringe_geometry(level, 17.0).lit_range_mm[0] > fringe_geometry(upright, 17.0).lit_range_mm[0]
    assert angle_deg(level) == pytest.approx(math.degrees(math.atan(0.2)))
