"""What is planned, the noise that is expected, and motion, against simulated frames."""

import numpy as np
import pytest
from support.planned_rigs import RIGS, exposure, inside, limits_over_planned, measured, simulated, simulation

from pipeline.decoder import Decoder
from pipeline.planning import plan_rig
from pipeline.planning.rig_plan import expected_phase_sigma
from pipeline.settings import DecodeSettings
from pipeline.simulation import simulate_frame

CAMERA = {"brightness": 0.7, "contrast": 0.9, "noise_levels": 1.5, "bits": 8, "sensor": "rgb", "cycles_in_view": 40.0}


@pytest.mark.parametrize("sensor", ["rgb", "bayer"])
@pytest.mark.parametrize("name", RIGS)
@pytest.mark.usefixtures("cpu")
def test_lateral_resolution_is_as_planned(name, sensor):
    """Along the stripes within 5 %; across them shading counts, too: within 35 %."""
    across, along = limits_over_planned(plan_rig(**{**RIGS[name], "sensor": sensor}))
    assert along == pytest.approx(1, abs=0.05) and across == pytest.approx(1, abs=0.35)


@pytest.mark.parametrize("name", RIGS)
@pytest.mark.usefixtures("cpu")
def test_a_plane_is_as_noisy_as_planned(name):
    """Every pixel's error counts, phase and depth: within 10 %, or 25 % where few cycles tell the response badly."""
    plan = plan_rig(**RIGS[name])
    found, bound = measured(plan, "plane"), 0.1 if plan.cycles_in_view > 28 else 0.25
    assert found.phase_rad == pytest.approx(plan.phase_sigma_rad, rel=bound)
    assert found.depth_mm == pytest.approx(plan.depth_sigma_mm, rel=bound)


@pytest.mark.parametrize("name", ["usual", "few cycles, 12 bits"])
@pytest.mark.usefixtures("cpu")
def test_half_the_light_costs_what_is_planned(name):
    """Within 15 %."""
    plan = plan_rig(**RIGS[name])
    found = measured(plan, "plane", share=0.5)
    assert found.phase_rad == pytest.approx(plan.dark_phase_sigma_rad, rel=0.15)
    assert found.depth_mm == pytest.approx(plan.dark_depth_sigma_mm, rel=0.15)


@pytest.mark.parametrize("name", ["usual", "hand-size, near"])
@pytest.mark.usefixtures("cpu")
def test_a_mosaic_costs_what_is_planned(name):
    """Of a plane: within 15 %."""
    plan = plan_rig(**{**RIGS[name], "sensor": "bayer"})
    found = measured(plan, "plane")
    assert found.phase_rad == pytest.approx(plan.phase_sigma_rad, rel=0.15)
    assert found.depth_mm == pytest.approx(plan.depth_sigma_mm, rel=0.15)


@pytest.mark.parametrize("name", ["usual", "hand-size, near"])
@pytest.mark.usefixtures("cpu")
def test_a_mosaic_costs_more_at_edges(name):
    """Most of a bust's errors are within 30 % of the plan."""
    plan = plan_rig(**{**RIGS[name], "sensor": "bayer"})
    assert measured(plan, "bust").most_phase_rad == pytest.approx(plan.phase_sigma_rad, rel=0.3)


@pytest.mark.parametrize("name", ["usual", "hand-size, near", "narrow, beside"])
@pytest.mark.usefixtures("cpu")
def test_a_bust_is_as_noisy_as_planned(name):
    """Most of its errors within 15 %; edges and steep places, which no plan knows, make the RMS up to 30 % larger."""
    plan = plan_rig(**RIGS[name])
    found = measured(plan, "bust")
    assert found.most_phase_rad == pytest.approx(plan.phase_sigma_rad, rel=0.15)
    assert found.most_depth_mm == pytest.approx(plan.depth_sigma_mm, rel=0.15)
    assert 0.85 < found.phase_rad / plan.phase_sigma_rad < 1.3


def test_noise_and_brightness_count_in_proportion():
    """Where what decoding leaves without noise is small beside it: to 3 %."""
    noisy = {**CAMERA, "noise_levels": 6.0, "bits": 12}
    usual = expected_phase_sigma("white", **noisy)
    assert expected_phase_sigma("white", **{**noisy, "noise_levels": 12.0}) == pytest.approx(2 * usual, rel=0.03)
    assert expected_phase_sigma("white", **{**noisy, "brightness": 0.35}) == pytest.approx(2 * usual, rel=0.03)


def test_contrast_fewer_bits_and_a_darker_colour_cost():
    usual = expected_phase_sigma("white", **CAMERA)
    assert expected_phase_sigma("white", **{**CAMERA, "contrast": 0.5}) > 1.25 * usual
    assert expected_phase_sigma("skin", **CAMERA) > 1.2 * usual
    assert 0.98 < expected_phase_sigma("white", **CAMERA, code="contrast2") / usual < 1.0, "higher contrasts"
    quiet = {**CAMERA, "noise_levels": 0.0}
    assert expected_phase_sigma("white", **{**quiet, "bits": 8}) > expected_phase_sigma(
        "white", **{**quiet, "bits": 12}
    )


@pytest.mark.usefixtures("cpu")
def test_motion_within_the_longest_exposure_moves_the_shape_to_its_middle():
    """A plane's frame is the mean over seven places, with noise: its depth is the middle's, as noisy as at rest.

    The one to a fifth of a pixel's noise, the other to 10 %.
    """
    plan = plan_rig(sensor="rgb")
    rig, _ = simulated(plan)
    settings = simulation(plan, noise_levels=0.0, bits=16)
    settings = settings.model_copy(update={"exposure": exposure(rig, settings)})
    passed = plan.choice.speed_mm_s * plan.longest_exposure_s
    places = passed * ((np.arange(7) + 0.5) / 7 - 0.5)
    light = [
        simulate_frame(rig, settings.model_copy(update={"object_motion_mm": (0, 0, place)})).image for place in places
    ]
    noise = np.random.default_rng(0).normal(0, plan.choice.noise_levels, light[0].shape)
    image = np.clip(np.rint(np.mean(light, axis=0) / 257 + noise), 0, 255).astype(np.uint8)
    truth = simulate_frame(rig, settings)
    frame = Decoder(DecodeSettings(), rig).decode(image)
    middle = inside(frame, truth, 60)
    off = frame.points[..., 2][middle] - truth.points[..., 2][middle]
    noisy = settings.model_copy(update={"noise_levels": plan.choice.noise_levels, "bits": 8})
    still = Decoder(DecodeSettings(), rig).decode(simulate_frame(rig, noisy).image)
    rest = still.points[..., 2][middle] - truth.points[..., 2][middle]
    assert abs(np.median(off) - np.median(rest)) < 0.2 * plan.depth_sigma_mm
    assert np.std(off) == pytest.approx(np.std(rest), rel=0.1)
    assert passed == pytest.approx(DecodeSettings().smoothing_px * plan.fields.mm_per_px)
