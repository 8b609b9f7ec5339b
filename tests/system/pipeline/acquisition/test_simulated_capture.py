"""The rig of `colorphase capture --rig simulated`: its frames, and the pictures that take turns in them."""

import numpy as np
import pytest

from pipeline import Decoder
from pipeline.acquisition import simulated_capture
from pipeline.acquisition.simulated_capture import SETTINGS, simulated_instruments


@pytest.mark.usefixtures("cpu")
def test_a_bust_that_turns_before_a_pattern_that_takes_turns(monkeypatch):
    """The second picture has 0.85 of the light, and decodes to the same phase."""
    monkeypatch.setattr(simulated_capture, "_SIZE_PX", (320, 240))
    monkeypatch.setattr(simulated_capture, "_POSES", 2)
    told = []
    open_instruments, calibration = simulated_instruments(SETTINGS, "cpu", told.append)
    assert told[-2:] == ["simulating pose 1 of 2", "simulating pose 2 of 2"]
    trigger, camera = open_instruments()
    assert trigger.limits.counts_strobes and camera.limits.size_px == (320, 240)
    bright, dim, turned = (camera._expose(time_s) for time_s in (0.0, 0.0, 1.0))
    trigger.projector(0.0)
    dim = camera._expose(0.0)
    lit = bright.mean(axis=-1) > 60
    assert np.median(dim[lit] / bright[lit]) == pytest.approx(0.85, abs=0.02)
    assert np.abs(turned.astype(int) - bright)[lit].mean() > 5
    decoder = Decoder(calibration=calibration, arch="cpu")
    phases = [decoder.decode(image).wrapped_phase for image in (bright, dim)]
    assert np.nanmedian(np.abs(np.angle(np.exp(1j * (phases[0] - phases[1]))))) < 0.05
