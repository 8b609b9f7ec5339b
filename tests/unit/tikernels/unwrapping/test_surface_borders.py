"""Where surfaces go on and where they step, at the borders of patches."""

import numpy as np
import pytest
import reference
from support.wrapped_surfaces import drafts_and_orders, flat_rates, join

from tikernels import runtime
from tikernels.phase.phase_change import RATE_ACROSS, RATE_ALONG
from tikernels.phase.wrapped_phase import NO_PHASE
from tikernels.unwrapping.surface_borders import measure_borders, sample_cells
from tikernels.unwrapping.tables import CELL_HEIGHT, CELL_WIDTH, Cell, cells_of, numbers_of

SHAPE = (97, 131)


def measured(phase, quality=None):
    """Return the borders of a wrapped phase's patches, and the patch of every pixel (-1: none)."""
    quality = np.ones(phase.shape, np.float32) if quality is None else quality
    patches, rates = join(phase, quality)
    departures = sample_cells(phase, rates, patches.labels).departures
    of_patches = patches.labels, patches.cell_table, patches.draft_bits, patches.table
    borders = measure_borders(phase, quality, rates, *of_patches, departures)
    drafts, _ = drafts_and_orders(np.array(runtime.to_host(patches.labels)))
    cells = runtime.to_host(patches.cell_table)
    patch = np.where(drafts >= 0, numbers_of(np.maximum(drafts, 0), cells, patches.draft_bits), -1)
    assert cells[Cell.PATCHES, -1] == patches.count
    return borders, patch


def test_departures_as_the_twin(arch):
    """One place a cell, along and across: the phase four pixels on, less what the slopes on either side tell."""
    rng = np.random.default_rng(0)
    phase = reference.wrapped(reference.ramp(*SHAPE, 12.0, tilt=0.05) + rng.normal(0, 0.1, SHAPE)).astype(np.float32)
    phase[40:60, 50:52] = NO_PHASE
    rates = flat_rates(along=0.05, across=0.52)
    rows, columns = cells_of(*SHAPE)
    departures = sample_cells(phase, rates, np.zeros(SHAPE, np.int32)).departures
    for axis, rate in ((1, rates[-1, RATE_ALONG]), (0, rates[-1, RATE_ACROSS])):
        for cell in range(rows * columns):
            top, left = cell // columns * CELL_HEIGHT, cell % columns * CELL_WIDTH
            y = (top + min(top + CELL_HEIGHT, SHAPE[0])) // 2
            x = (left + min(left + CELL_WIDTH, SHAPE[1])) // 2
            line, place = (phase[y].astype(float), x) if axis == 1 else (phase[:, x].astype(float), y)
            expected = NO_PHASE
            if 2 <= place < len(line) - 6 and line[[place - 2, place, place + 4, place + 6]].max() < 50:
                one, two, three, four = line[[place - 2, place, place + 4, place + 6]]
                slopes = [reference.wrapped(np.array(b - a - 2 * rate)) / 2 for a, b in ((one, two), (three, four))]
                expected = abs(reference.wrapped(np.array(three - two - 4 * (rate + np.mean(slopes)))))
            assert abs(departures[1 - axis, cell] - expected) < 1e-4


def test_a_smooth_surface_steps_nowhere(arch):
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    bump = 3 * np.exp(-((y - 50) ** 2 + (x - 60) ** 2) / 800)
    rng = np.random.default_rng(1)
    phase = reference.wrapped(reference.ramp(*SHAPE, 12.0) + bump + rng.normal(0, 0.05, SHAPE)).astype(np.float32)
    borders, _ = measured(phase)
    assert borders.going_on.sum() > 500
    assert borders.stepping.sum() < 0.01 * borders.going_on.sum()


def test_how_orders_differ_across_borders(arch):
    """The patches of a smooth surface have the orders that its regions give them."""
    phase = reference.wrapped(reference.ramp(*SHAPE, 12.0, tilt=0.05)).astype(np.float32)
    patches, _ = join(phase, np.ones(SHAPE, np.float32))
    graph = patches.graph()
    assert len(np.unique(graph.root)) == 1 and len(np.unique(graph.offset)) > 5
    assert graph.borders.going_on.sum() > 500
    low, high = graph.borders.ends
    assert (low < high).all()
    np.testing.assert_array_equal(graph.offset[high] - graph.offset[low], graph.borders.shift)


def test_a_step_is_seen_along_the_whole_border(arch):
    """The right part lies 2 rad in front: each row steps, dim ones count less, some twice at cell borders."""
    true = reference.ramp(*SHAPE, 12.0) + 2.0 * (np.arange(SHAPE[1]) >= 67)
    quality = np.full(SHAPE, 10.0, np.float32)
    quality[48:] = 1.0  # less than a quarter of the mean
    borders, patch = measured(reference.wrapped(true).astype(np.float32), quality)
    expected = 48 + 49 * 4 / quality.mean()
    assert 0.8 * expected < borders.stepping.sum() < 2.2 * expected
    # What steps lies on either side.
    right = np.zeros(patch.max() + 1, bool)
    right[patch[:, 67:][patch[:, 67:] >= 0]] = True
    one, other = right[borders.ends[:, borders.stepping > 0]]
    assert (one != other).all()


@pytest.mark.parametrize(("step", "steps"), [(0.0, False), (2.0, True)])
def test_mixed_pixels_at_a_border_say_nothing(arch, step, steps):
    """Two columns that see both sides of a print's edge or of a step, and whose phase is neither's."""
    column = np.arange(SHAPE[1])
    true = reference.ramp(*SHAPE, 12.0) + step * (column >= 73) + 0.9 * ((column >= 72) & (column < 74))
    borders, _ = measured(reference.wrapped(true).astype(np.float32))
    assert (borders.stepping.sum() > 0.8 * SHAPE[0]) == steps
    if not steps:
        assert borders.stepping.sum() < 0.1 * SHAPE[0]
