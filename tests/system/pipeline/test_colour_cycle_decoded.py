"""A frame whose exposure is not a whole number of colour cycles, decoded."""

import numpy as np
import pytest
from support.exposures_off_cycle import KINDS, moved, simulate_exposure

from hardware.colour_cycle import TOLERANCE, phase_error_limit
from pipeline import Decoder, DecodeSettings
from pipeline.simulation import SimulationSettings


@pytest.mark.parametrize("kind", KINDS)
def test_the_decoded_phase_stays_within_the_limit(kind, cpu):
    decoder = Decoder(DecodeSettings(crosstalk_matrix=SimulationSettings().crosstalk_matrix), arch="cpu")
    straight = simulate_exposure(0.0, "even", size_px=(480, 360))
    for deviation in (TOLERANCE, 0.1):
        by = moved(decoder, straight, simulate_exposure(deviation, kind, size_px=(480, 360)))
        assert np.quantile(np.abs(by), 0.999) < phase_error_limit(deviation)
    assert by.std() > 0.004  # a tenth of the exposure is no trifle: this is what refusing it is for
