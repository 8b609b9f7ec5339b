"""The usual change of the phase, against a plane and the sequential twin."""

import numpy as np
import pytest
import reference

from tikernels import runtime
from tikernels.phase.phase_change import MEAN_QUALITY, RATE_ACROSS, RATE_ALONG, measure_rates


def test_rates_are_those_of_a_plane(arch):
    """To 1e-6 rad a px, and the quality's mean over every eighth pixel."""
    phase = reference.wrapped(reference.ramp(64, 96, 12.0, tilt=0.03))
    quality = np.random.default_rng(7).random((64, 96), np.float32)
    last = runtime.to_host(measure_rates(phase, quality))[-1]
    assert last[RATE_ALONG] == pytest.approx(0.03, abs=2e-6)
    assert last[RATE_ACROSS] == pytest.approx(2 * np.pi / 12, abs=2e-6)
    assert last[MEAN_QUALITY] == pytest.approx(reference.usual_change(phase, quality)[2], rel=1e-5)


def test_rates_are_those_of_what_is_bright(arch):
    """Even light that fills three quarters of a frame, at a tenth of the modulation, changes the rate by 3 %."""
    phase, quality = reference.wrapped(reference.ramp(64, 96, 12.0)), np.full((64, 96), 100, np.float32)
    phase[:, 24:], quality[:, 24:] = 1.0, 10
    last = runtime.to_host(measure_rates(phase, quality))[-1]
    assert last[RATE_ACROSS] == pytest.approx(2 * np.pi / 12, rel=0.03)
    assert last[RATE_ACROSS] == pytest.approx(reference.usual_change(phase, quality)[1], rel=1e-4)


def test_menu(menu):
    phase = reference.wrapped(reference.ramp(17, 23)).astype(np.float32)

    def rates(out=None, **inputs):
        found = measure_rates(**inputs, out=out)
        return runtime.to_host(found) if out is None else found

    menu(rates, np.empty((4, 5), np.float32), phase=phase, quality=np.full((17, 23), 400, np.float32))
