"""Orders and their probabilities over many frames."""

import numpy as np
import pytest
from support.uncertain_frames import judged_regions, uncertain_frame

from pipeline import Decoder
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
