"""Orders that are carried from frame to frame."""

import numpy as np
import pytest

from pipeline import Decoder, DecodeSettings
from pipeline.orders.carried_orders import MAX_CARRIED_ERROR
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig

pytestmark = pytest.mark.usefixtures("cpu")


def test_doubt_grows_until_the_code_is_seen_again():
    """A ball that swings by 0.3 cycles a frame stops being absolute before the next order may pass for its own."""
    rigs = [simulated_rig(code=code) for code in ("contrast", None)]
    decoders = [Decoder(DecodeSettings(), rig, arch="cpu") for rig in rigs]
    ball, wall = (240, 320), (20, 20)
    frame, doubts = None, []
    for number in range(13):
        plain = 0 < number < 12
        settings = SimulationSettings(scene="ball", object_motion_mm=(0.0, 0.0, -11.0 * (number % 2)), seed=number)
        truth = simulate_frame(rigs[plain], settings)
        frame = decoders[plain].decode(truth.image, previous=frame)
        doubts.append([frame.order_error_probability[place] for place in (ball, wall)])
        assert frame.absolute[wall]
        assert frame.absolute[ball] == (doubts[-1][0] < MAX_CARRIED_ERROR)
        known = frame.absolute & truth.mask
        assert np.mean(np.abs(frame.unwrapped_phase - truth.phase)[known] > np.pi) < 1e-3
    of_ball, of_wall = np.array(doubts).T
    assert (np.diff(of_ball[:12]) > 0).all()
    assert of_ball[11] > MAX_CARRIED_ERROR > 5 * of_wall.max()  # a carried order errs once in a thousand at least
    assert of_ball[12] < 1e-3
