"""Phases of cycles whose modulation is not the usual one, against the twin and a closed form."""

import numpy as np
import pytest
import reference

import tikernels
from pipeline.orders.modulation import modulation_corrections
from tikernels.order_evidence import correct_by_modulation
from tikernels.order_evidence.modulation_correction import SLOPE_REACH, TABLED
from tikernels.phase.equalization import modulation_tables


def test_correction_as_the_twin(arch):
    rng = np.random.default_rng(5)
    phase = rng.uniform(0, 2 * np.pi * 11, (33, 70))
    edges = np.linspace(-np.pi, np.pi, 257)
    table = (0.2 * np.sin(3 * edges) + 0.03 * np.sin(6 * edges)).astype(np.float32)
    tables = modulation_tables(table)
    deviations = rng.uniform(-0.16, 0.16, 12)
    region = np.ones(phase.shape, np.int32)
    region[:, 35:] = 2
    region[0] = 0
    wrapped, unwrapped = reference.wrapped(phase), phase.astype(np.float32)
    known = np.array([False, True, False])
    place = np.arange(11 * TABLED + 1) / TABLED
    corrections = modulation_corrections(np.interp(place, np.arange(12), deviations), tables)
    correct_by_modulation(region, known, corrections, out=(wrapped, unwrapped))
    expected = reference.correct_by_modulation(phase, deviations, tables, 0.0, SLOPE_REACH)
    expected = np.where(region == 1, expected, phase)
    # Between the table's places a line stands for 0.03 rad of the sixth harmonic: 1e-4 rad; and float32 of 70 rad.
    np.testing.assert_allclose(unwrapped, expected, atol=3e-4)
    np.testing.assert_allclose(wrapped - reference.wrapped(phase), expected - phase, atol=3e-4)


def test_tables_undo_a_square_response():
    """The phase of cycles whose modulation departs by 16 % comes back to 2 mrad from what is 30 mrad without."""
    phase = np.linspace(-np.pi, np.pi, 4096, endpoint=False)
    shifts = np.array([-1, 0, 1]) * 2 * np.pi / 3

    def seen(modulation):
        light = (0.5 + modulation * np.cos(phase[:, None] + shifts)) ** 2
        return np.angle(light @ np.exp(-1j * shifts))

    usual = 0.43
    edges = np.linspace(-np.pi, np.pi, 257)
    bare = np.unwrap(seen(usual))
    table = np.interp(edges, bare, phase - bare, period=2 * np.pi).astype(np.float32)
    for modulation in (0.36, 0.5):
        measured = seen(modulation)
        corrected = measured + np.interp(measured, edges, table)
        deviations, tables = np.full(3, modulation / usual - 1), modulation_tables(table)
        absolute = reference.wrapped(corrected) + 2 * np.pi
        better = reference.correct_by_modulation(absolute, deviations, tables, 0.0, SLOPE_REACH)
        before, after = (np.abs(reference.wrapped(p - phase)).max() for p in (corrected, better))
        assert before > 0.025
        assert after < 0.008


def test_a_ramp_of_corrections_is_interpolated(arch):
    """0.1 rad a cycle from the middle of the first cycle on: a phase of n cycles gets 0.1 n, to float32 of 70 rad."""
    cycles = np.random.default_rng(1).uniform(0, 10, (20, 40))
    unwrapped, phase = (2 * np.pi * cycles).astype(np.float32), np.zeros((20, 40), np.float32)
    corrections = 0.1 * np.arange(10 * TABLED + 1) / TABLED
    correct_by_modulation(np.ones((20, 40), np.int32), np.array([False, True]), corrections, out=(phase, unwrapped))
    np.testing.assert_allclose(phase, 0.1 * cycles, atol=1e-5)
    np.testing.assert_allclose(unwrapped, (2 * np.pi + 0.1) * cycles, atol=1e-5)


def test_what_is_refused(arch):
    region, known, corrections = np.ones((4, 5), np.int32), np.array([False, True]), np.zeros(9)
    phase = np.zeros((4, 5), np.float32)
    read_only = phase.copy()
    read_only.setflags(write=False)
    for out in ((phase, phase[1:]), (phase, read_only), (phase.astype(np.float64), phase)):
        with pytest.raises(tikernels.ShapeError):
            correct_by_modulation(region, known, corrections, out=out)
    with pytest.raises(tikernels.ShapeError, match="region has shape"):
        correct_by_modulation(region[1:], known, corrections, out=(phase, phase.copy()))
