"""Whole cycles of the contrast, and their steps."""

import numpy as np
import pytest
from pipeline.orders.contrast_cycles import read_cycles
from support.coded_steps import WIDTH, grid

from tikernels.order_evidence.contrast_reading import BACKGROUND, MODULATION, ORDER_SLOTS, PHASE, TOTAL


def sums_of(contrast, share=(0.4, 0.6), weights=None):
    """Return what two columns of patches show of blurred cycles which the border between two patches cuts."""
    weights = np.full(len(contrast), 13.0) if weights is None else weights
    sums = np.zeros((2 * (len(contrast) + 1), ORDER_SLOTS, 4), np.float32)
    for k, (value, weight) in enumerate(zip(contrast * blur_leaves(weights * 15 / 16), weights, strict=True)):
        for row, part in zip((k, k + 1), share, strict=True):
            for column in range(2):
                cycle = sums[2 * row + column, k - row + ORDER_SLOTS // 2]
                cycle[[TOTAL, MODULATION, BACKGROUND]] = part * weight * np.array([1, 80 * value, 80])
                cycle[PHASE] = 6 * part * (1 if row == k else -share[0] / share[1])
    return sums


def blur_leaves(period_px):
    """Return what a lens and a pixel's area leave of the contrast of cycles: a Gaussian of a third of a px squared."""
    return np.exp(-2 * np.pi**2 / 3 / period_px**2)


@pytest.mark.parametrize("rising", [True, False])
def test_cut_cycles_are_put_together(rising):
    contrast = np.array([0.8, 1.0, 0.7, 0.9, 0.75])
    sums, graph = sums_of(contrast), grid(6, 2)
    if not rising:
        graph = graph._replace(offset=-graph.offset)
        sums = sums[:, ::-1]
    cycles, steps = read_cycles(sums, graph, WIDTH, rising)
    order = cycles.order if rising else -cycles.order
    np.testing.assert_allclose(cycles.contrast, np.log(contrast)[order], atol=1e-5)
    np.testing.assert_allclose(cycles.share, np.where(cycles.patch // 2 == order, 0.4, 0.6), atol=1e-5)
    np.testing.assert_allclose(cycles.brightness, 80, rtol=1e-5)
    assert len(steps.rise) == 8  # four in either column
    lower = steps.order if rising else -steps.order - 1
    sign = 1 if rising else -1
    np.testing.assert_allclose(steps.rise, sign * np.diff(np.log(contrast))[lower], atol=1e-5)


def test_blur_is_undone_where_the_fringe_gets_finer():
    """Of one column only half of the pixels are left, so that the other one tells how long its cycles are."""
    contrast = np.array([0.8, 1.0, 0.7, 0.9, 0.75])
    sums = sums_of(contrast, weights=np.array([13.0, 12.0, 10.0, 8.0, 7.0]))
    sums[1::2] *= 0.5
    cycles, steps = read_cycles(sums, grid(6, 2), WIDTH, True)
    np.testing.assert_allclose(cycles.contrast, np.log(contrast)[cycles.order], atol=1e-5)
    np.testing.assert_allclose(steps.rise, np.diff(np.log(contrast))[steps.order], atol=1e-5)


def test_torn_cycles_do_not_count():
    sums = sums_of(np.array([0.8, 1.0, 0.7]))
    sums[2:4, ORDER_SLOTS // 2 - 1] = 0  # what the second row shows of the first cycle
    cycles, steps = read_cycles(sums, grid(4, 2), WIDTH, True)
    assert set(cycles.order) == {1, 2}
    assert len(steps.rise) == 2


def test_no_cycles_at_all():
    cycles, steps = read_cycles(np.zeros((12, ORDER_SLOTS, 4), np.float32), grid(6, 2), WIDTH, True)
    assert len(cycles.patch) == len(steps.rise) == 0
