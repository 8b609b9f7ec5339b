"""What a cell decides alone of the forest of the most reliable edges, against the sequential twin."""

import numpy as np
import pytest
import reference
from support.wrapped_surfaces import drafts_and_orders, flat_rates

from tikernels import runtime
from tikernels.phase.wrapped_phase import NO_PHASE, STEP_PHASE
from tikernels.unwrapping.drafts import Drafts
from tikernels.unwrapping.edge_reliability import weigh_edges_kernel
from tikernels.unwrapping.spanning_forest import grow_trees_kernel
from tikernels.unwrapping.tables import BETWEEN, NOTHING, Cell, Edge, Patch, Tree, cells_of

BITS, ANYTHING = 6, 10.0


def grown(phase, bits=BITS, max_departure=ANYTHING):
    """Return labels, patches, trees and cells of a phase, on the host."""
    drafts = Drafts(*phase.shape, bits)
    rows, columns = cells_of(*phase.shape)
    edges = runtime.empty((len(Edge), 16 * rows + 1, 8 * columns + 1), np.int32)
    rates = runtime.to_device(flat_rates())
    weigh_edges_kernel(phase, rates, max_departure, edges)
    labels = np.full(phase.shape, -9, np.int32)
    shapes = (drafts.patches.shape, (len(Tree), drafts.patches.shape[1]), drafts.cell_table.shape)
    tables = [np.full(shape, -9, np.int32) for shape in shapes]
    grow_trees_kernel(edges, np.ones(phase.shape, np.float32), rates, bits, labels, *tables)
    return labels, *tables


def noisy(shape, noise, seed=1):
    true = reference.ramp(*shape, 14.0, tilt=0.1)
    return reference.wrapped(true + noise * np.random.default_rng(seed).standard_normal(shape))


@pytest.mark.parametrize("noise", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("shape", [(16, 8), (13, 8), (16, 5), (1, 7)])
def test_a_cell_alone_decides_all(arch, noise, shape):
    """No edge leaves it, so its one patch has the twin's orders: no other forest has, where noise makes residues."""
    phase = noisy(shape, noise)
    labels, patches, trees, cells = grown(phase)
    expected, region = reference.unwrap_by_reliability(phase, np.ones(shape, bool), (0.0, 0.0), ANYTHING)
    assert np.ptp(region) == 0 and cells[Cell.PATCHES, 0] == 1
    drafts, order = drafts_and_orders(labels)
    assert (drafts == 0).all() and np.ptp(order - expected) == 0
    assert patches[Patch.PIXELS, 0] == phase.size and patches[Patch.WEIGHT, 0] == 4 * phase.size
    assert trees[Tree.EXIT, 0] == -1


@pytest.mark.parametrize("noise", [0.1, 0.6])
def test_patches_are_parts_of_the_forest(arch, noise):
    """Inside every patch, orders differ as the twin's do over the whole picture."""
    shape = (64, 40)
    phase = noisy(shape, noise)
    labels, patches, trees, cells = grown(phase)
    expected, _ = reference.unwrap_by_reliability(phase, np.ones(shape, bool), (0.0, 0.0), ANYTHING)
    drafts, order = drafts_and_orders(labels)
    assert 1 < cells[Cell.PATCHES, :-1].mean() < 40
    for draft in np.unique(drafts):
        inside = drafts == draft
        assert np.ptp((order - expected)[inside]) == 0
        assert patches[Patch.PIXELS, draft] == inside.sum()
        assert inside.ravel()[patches[Patch.FIRST, draft]]
        assert trees[Tree.EXIT, draft] >= 0


def test_steps_and_missing_pixels(arch):
    phase = noisy((32, 16), 0.0)
    phase[:, 12:] += 2.0  # rad, more than the 1.5 below
    phase = reference.wrapped(phase)
    phase[5, 3], phase[20, 4] = NO_PHASE, STEP_PHASE
    labels, _, _, cells = grown(phase, max_departure=1.5)
    assert labels[5, 3] == NOTHING and labels[20, 4] == BETWEEN
    np.testing.assert_array_equal(cells[Cell.STEPS, :-1], [0, 0, 1, 0])
    drafts, _ = drafts_and_orders(labels)
    assert not set(drafts[:, :12].ravel()) & set(drafts[:, 12:].ravel())


def test_crowded_cells_count_on(arch):
    phase = np.random.default_rng(2).uniform(-np.pi, np.pi, (48, 48)).astype(np.float32)
    ample, tight = (grown(phase, bits)[3][Cell.PATCHES, :-1] for bits in (7, 0))
    np.testing.assert_array_equal(tight, ample)
    assert ample.max() > 1
