"""What a modulation that changes by the code does to the phase, and how much of it is undone."""

import numpy as np
import pytest
from support.coded_blocks import CODES, code_and_columns

from pipeline.contrast_code import CYCLES, ContrastCode
from pipeline.orders.modulation import code_ripples, measure_ripples
from pipeline.orders.stripe_columns import column_at
from tikernels.order_evidence.modulation_correction import NODE_PX, TABLED

each_code = pytest.mark.parametrize("name", CODES)
PERIOD = 12.0
# As wide as it takes with the few columns that are looked at.
SHAPE = 432, 512
# Shares, rad and rad: what response, blur and balance usually do, as standard deviations.
USUAL = (0.3, 0.03, 0.3)
# What goes with the contrast, and with its square, over a cycle.
WITHIN = np.stack([np.sin(3 * np.linspace(-np.pi, np.pi, 257)), 0.1 * np.sin(6 * np.linspace(-np.pi, np.pi, 257))])
WITHIN = (0.02 * WITHIN).astype(np.float32)


@each_code
def test_deviations_are_the_codes(name):
    code = code_and_columns(name)[0]
    deviations, slopes, passed = np.moveaxis(code_ripples(code), -1, 0)
    assert deviations.shape == slopes.shape == passed.shape == (TABLED * (CYCLES - 1) + 1, len(code.places_px))
    modulation = code.modulation(np.arange(CYCLES)[:, None], code.places_px)
    np.testing.assert_allclose(deviations[::TABLED], modulation / (1 - modulation) / code.usual - 1, atol=1e-6)
    # Halfway between two cycles the slope is that of the straight line there, of the logarithm.
    halfway, change = (modulation[1:] + modulation[:-1]) / 2, np.diff(modulation, axis=0)
    np.testing.assert_allclose(slopes[TABLED // 2 :: TABLED], change / halfway, atol=1e-6)


def test_the_balance_passes_nothing_of_a_contrast_that_does_not_change():
    code = ContrastCode.named("contrast")
    _, slopes, passed = code_ripples(code)[:, 0].T
    symbols = np.round(100 * code.contrasts[:, 0]).astype(int)
    alike = [k for k in range(4, CYCLES - 4) if len(set(symbols[k - 2 : k + 3])) == 1]
    assert np.abs(passed[TABLED * np.array(alike)]).max() < 0.2 * np.abs(passed).max()
    assert np.abs(slopes[TABLED * np.array(alike)]).max() == 0


def test_the_window_sees_all_cells_of_a_cycle():
    """It is wider than they are: what it passes is the same all along the stripe, and less than of the first code."""
    passed = code_ripples(code_and_columns("contrast2")[0])[..., 2]
    assert np.ptp(passed, axis=1).max() == 0
    first = code_ripples(ContrastCode.named("contrast"))[..., 2]
    assert 0 < np.std(passed) < 0.5 * np.std(first)


def seen(name, shares):
    """Return the raw phase of a plane that the code bends, its absolute phase, and the table of the code's ripples."""
    code, columns = code_and_columns(name)
    y, x = np.indices(SHAPE)
    absolute = 2 * np.pi * (4 + (y + 0.1 * x) / PERIOD)
    cycles = absolute / (2 * np.pi)
    place = np.zeros(cycles.shape, int)
    if code.cell_px is not None:
        terms = columns.terms(np.column_stack([y.ravel(), x.ravel()]).astype(float))
        place = code.place_at(column_at(terms, cycles.ravel())).reshape(cycles.shape)
    table = code_ripples(code)
    deviation, slope, passed = np.moveaxis(table[np.rint(cycles * TABLED).astype(int), place], -1, 0)
    edges = np.linspace(-0.5, 0.5, WITHIN.shape[1])
    linear, square = (np.interp(cycles, edges, row, period=1) for row in WITHIN)
    of_contrast = deviation * (linear + (2 + deviation) * square)
    bent = absolute - of_contrast * shares[0] - shares[1] * slope - shares[2] * passed
    bent += np.random.default_rng(1).normal(0, 0.0002, bent.shape)
    return np.angle(np.exp(1j * bent)).astype(np.float32), absolute.astype(np.float32)


def measured(name, raw, unwrapped, known=True):
    code, columns = code_and_columns(name)
    region, known = np.ones(raw.shape, np.int32), np.array([False, known])
    return measure_ripples(raw, unwrapped, region, known, within=WITHIN, period_px=PERIOD, code=code, columns=columns)


@each_code
@pytest.mark.parametrize("shares", [(1.0, 0.0, 0.0), (1.1, -0.02, 0.3), (0.7, 0.03, -0.1)])
def test_what_the_code_bends_is_found(name, shares):
    """What has to be added is what response, blur and balance have taken, to a fifth of the usual amounts."""
    ripples = measured(name, *seen(name, shares))
    np.testing.assert_allclose((ripples.shares - shares) / USUAL, 0, atol=0.2)


@each_code
def test_nothing_is_added_where_no_order_is_known(name):
    assert not measured(name, *seen(name, (1.0, 0.02, 0.3)), known=False).shares.any()


@each_code
def test_bends_of_the_surface_are_not_the_codes(name):
    """Waves of a cycle and a half, of 0.1 rad, hardly change the shares."""
    raw, absolute = seen(name, (1.0, 0.0, 0.0))
    waves = 0.1 * np.sin(np.indices(raw.shape)[0] * 2 * np.pi / 1.5 / PERIOD)
    ripples = measured(name, np.angle(np.exp(1j * (raw + waves))).astype(np.float32), (absolute + waves).astype("f4"))
    np.testing.assert_allclose((ripples.shares - (1, 0, 0)) / USUAL, 0, atol=1)


@each_code
def test_where_the_ripples_lie(name):
    """Columns come in repeats of the code, at nodes that cover the frame."""
    code, columns = code_and_columns(name)
    ripples = measured(name, *seen(name, (1.0, 0.0, 0.0)))
    np.testing.assert_array_equal(ripples.within, WITHIN)
    if name == "contrast":
        assert ripples.columns.shape[:2] == tuple(n // NODE_PX + 2 for n in SHAPE) and not ripples.columns.any()
    else:
        np.testing.assert_allclose(ripples.columns * code.repeats_px, columns.nodes, rtol=1e-5)
