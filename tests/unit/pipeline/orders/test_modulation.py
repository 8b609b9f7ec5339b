"""What a modulation that changes from cycle to cycle does to the phase, and how much of it is undone."""

import numpy as np
import pytest

from pipeline.orders.modulation import code_deviations, code_ripples, modulation_corrections, ripple_left
from pipeline.pattern import CYCLES, cycle_contrasts
from tikernels.order_evidence.modulation_correction import TABLED


def test_deviations_are_the_codes():
    deviations, (slopes, passed) = code_deviations(0.86), code_ripples()
    assert len(deviations) == len(slopes) == len(passed) == TABLED * (CYCLES - 1) + 1
    np.testing.assert_allclose(deviations[::TABLED], cycle_contrasts() / 0.86 - 1, atol=1e-12)
    # Between two cycles of one symbol nothing changes.
    alike = np.flatnonzero(np.diff(cycle_contrasts()) == 0)
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


@pytest.mark.parametrize("shares", [(0.0, 0.0, 0.0), (0.02, -0.1, 0.3), (-0.03, 0.2, -0.1)])
def test_what_the_code_leaves_is_found(shares):
    """On a plane whose phase is off by what blur and balance make of the code, and the response's correction lacks."""
    rng, period, rows = np.random.default_rng(1), 12.0, 600
    corrections = 0.02 * np.sin(3 * 2 * np.pi * np.arange(TABLED * (CYCLES - 1) + 1) / TABLED)
    corrections *= np.repeat(rng.choice([-1.0, 1.0], CYCLES), TABLED)[: len(corrections)]
    expected = shares @ np.vstack([code_ripples(), corrections])
    true = 2 * np.pi * (10 + np.arange(rows) / period)
    place = np.clip(np.rint(true * TABLED / (2 * np.pi)), 0, len(expected) - 1).astype(int)
    phase = np.repeat((true + (expected - corrections)[place])[:, None], 4, axis=1).astype(np.float32)
    region, absolute = np.ones(phase.shape, np.int32), np.array([False, True])
    seen = slice(10 * TABLED, 58 * TABLED)
    left = ripple_left(phase, region, absolute, corrections, period)
    np.testing.assert_allclose(left[seen], expected[seen], atol=2e-3)
    assert not ripple_left(phase, region, np.array([False, False]), corrections, period).any()


def test_the_balance_passes_nothing_of_a_contrast_that_does_not_change():
    slopes, passed = code_ripples()
    symbols = np.round(100 * cycle_contrasts()).astype(int)
    alike = [k for k in range(4, CYCLES - 4) if len(set(symbols[k - 2 : k + 3])) == 1]
    assert np.abs(passed[TABLED * np.array(alike)]).max() < 0.2 * np.abs(passed).max()
    assert np.abs(slopes[TABLED * np.array(alike)]).max() == 0
