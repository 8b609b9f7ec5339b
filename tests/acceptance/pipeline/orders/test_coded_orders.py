"""Orders and their probabilities over many frames."""

import numpy as np
import pytest
import reference
from support.uncertain_frames import judged_regions, uncertain_frame

from pipeline import Decoder, DecodeSettings, DecodeWarning
from pipeline.output.report import measure_against_truth
from pipeline.simulation import TYPICAL_CROSSTALK, SimulationSettings, simulate_frame, simulated_rig

pytestmark = pytest.mark.usefixtures("cpu")


@pytest.mark.parametrize("turn", [1, 7])
def test_what_is_small_and_has_any_order_is_left_out(turn):
    """The nose's tip of these busts hangs together with nothing, and shows too few cycles to be placed."""
    settings = SimulationSettings(
        seed=turn,
        pixel_rays=3,
        projector_blur_px=(0.6, 0.6, 0.6),
        object_motion_mm=(3.0 * turn, -4.0 * turn, 2.0 * turn),
    )
    truth = simulate_frame(simulated_rig(code="contrast"), settings)
    calibration = truth.rig.model_copy(update={"crosstalk_matrix": np.array(TYPICAL_CROSSTALK)})
    frame = Decoder(calibration=calibration, arch="cpu").decode(truth.image)
    measured = measure_against_truth(frame, truth)
    assert measured["depth_rms_mm"] < 0.2 and measured["coverage"] > 0.97


def test_the_error_probability_is_what_it_says():
    """Of uncertain regions about as many are wrong as their probabilities promise; more frames are a benchmark's."""
    regions = np.array([region for seed in range(900, 924) for region in judged_regions(*uncertain_frame(seed))])
    uncertain = regions[:, 0] > 0.1
    expected, observed = regions[uncertain].sum(axis=0)
    assert expected > 15
    assert expected / 2 < observed < 2 * expected
    assert regions[regions[:, 0] < 1e-3, 1].sum() == 0
    assert (regions[:, 0] < 1e-3).sum() > 20


def test_motion_during_the_exposure_is_flagged():
    """Head and shoulders move by 20 mm: they are flagged, not placed with the wall; what is wrong is their rim."""
    rig = simulated_rig(code="contrast")
    frames = [
        simulate_frame(rig, SimulationSettings(object_motion_mm=(0.7 * s, s, 0.0), exposure=1.0, noise_levels=0.0))
        for s in np.linspace(-10, 10, 7)
    ]
    mean = np.mean([frame.image for frame in frames], axis=0)
    image = np.clip(mean + np.random.default_rng(0).normal(0, 1.5, mean.shape), 0, 255).astype(np.uint8)
    calibration = rig.model_copy(update={"crosstalk_matrix": np.array(TYPICAL_CROSSTALK)})
    with pytest.warns(DecodeWarning, match="of the code"):
        frame = Decoder(DecodeSettings(), calibration, arch="cpu").decode(image)
    truth = frames[3]
    lit = reference.eroded(truth.mask, 4) & (truth.image.mean(axis=2) > 20)
    known = lit & frame.absolute
    right = np.abs(np.nan_to_num(frame.unwrapped_phase) - truth.phase) < np.pi
    assert (known & right).sum() / lit.sum() > 0.6
    assert (known & ~right).sum() / lit.sum() < 0.04
