"""What is planned, what is warned of, and motion against simulated frames that move."""

import math

import numpy as np
import pytest
from support.planned_rigs import exposure, inside, simulated, simulation

from pipeline.decoder import Decoder
from pipeline.planning import plan_rig
from pipeline.settings import DecodeSettings
from pipeline.simulation import simulate_frame


@pytest.mark.usefixtures("cpu")
def test_motion_within_the_longest_exposure_moves_the_shape_to_its_middle():
    """A plane's frame is the mean over seven places, with noise: its depth is the middle's, as noisy as at rest.

    The one to a twentieth of a pixel's noise, the other to 10 %.
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
    assert abs(np.median(off) - np.median(rest)) < 0.05 * plan.depth_sigma_mm
    assert np.std(off) == pytest.approx(np.std(rest), rel=0.1)
    assert passed / math.sqrt(12) == pytest.approx(plan.depth_sigma_mm)
