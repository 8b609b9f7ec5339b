"""What a modulation that changes from cycle to cycle does to the phase, and how much of it is undone."""

import numpy as np
import pytest

from pipeline.orders.modulation import blur_shift, code_deviations, modulation_corrections
from pipeline.pattern.contrast_code import CYCLES, cycle_modulations
from tikernels.order_evidence.modulation_correction import TABLED


def test_deviations_are_the_codes():
    deviations, slopes = code_deviations(0.43)
    assert len(deviations) == len(slopes) == TABLED * (CYCLES - 1) + 1
    np.testing.assert_allclose(deviations[::TABLED], cycle_modulations() / 0.43 - 1, atol=1e-12)
    # Between two cycles of one symbol nothing changes.
    alike = np.flatnonzero(np.diff(cycle_modulations()) == 0)
    assert np.abs(slopes[TABLED * alike + TABLED // 2]).max() < 0.15


def test_the_usual_modulation_needs_no_correction():
    tables = np.random.default_rng(0).normal(size=(2, 257))
    tables[:, -1] = tables[:, 0]
    assert not modulation_corrections(np.zeros(5 * TABLED), tables).any()
    # What goes with the modulation grows with it.
    deviations = np.full(TABLED, 0.1)
    linear = np.stack([np.ones(257), np.zeros(257)])
    np.testing.assert_allclose(modulation_corrections(deviations, linear), 0.1)
    square = np.stack([np.zeros(257), np.ones(257)])
    np.testing.assert_allclose(modulation_corrections(deviations, square), 1.1**2 - 1)


@pytest.mark.parametrize("shift", [0.0, 0.02, -0.03])
def test_the_shift_by_blur_is_found(shift):
    """On a plane whose phase is off by the shift times the modulation's slope."""
    _, slopes = code_deviations(0.43)
    period, rows = 12.0, 600
    true = 2 * np.pi * (10 + np.arange(rows) / period)
    place = np.clip(np.rint(true * TABLED / (2 * np.pi)), 0, len(slopes) - 1).astype(int)
    phase = np.repeat((true + shift * slopes[place])[:, None], 4, axis=1).astype(np.float32)
    region, absolute = np.ones(phase.shape, np.int32), np.array([False, True])
    assert blur_shift(phase, region, absolute, slopes, period) == pytest.approx(shift, abs=2e-3)
    assert blur_shift(phase, region, np.array([False, False]), slopes, period) == 0.0
