"""Trees of patches and the best edges between them, against what the table of edges says."""

import numpy as np
import pytest
import reference
from support.wrapped_surfaces import drafts_and_orders, flat_rates

from tikernels import runtime
from tikernels.unwrapping.drafts import Drafts
from tikernels.unwrapping.edge_reliability import NO_EDGE, weigh_edges_kernel
from tikernels.unwrapping.tables import Cell, Contact, Edge, Patch, Tree
from tikernels.unwrapping.unwrap_methods import SpanningForest

ANYTHING = 10.0


def drafted(phase):
    """Return the method that has drafted a phase's patches, the drafts and its trees, on the host."""
    method = SpanningForest(*phase.shape, ANYTHING)
    drafts = Drafts(*phase.shape, method.draft_bits)
    quality = runtime.to_device(np.ones(phase.shape, np.float32))
    method.grow(runtime.to_device(phase), quality, runtime.to_device(flat_rates()), drafts)
    return method, drafts, runtime.to_host(method._trees)


def noisy(shape, noise, seed=1):
    true = reference.ramp(*shape, 14.0, tilt=0.1)
    return reference.wrapped(true + noise * np.random.default_rng(seed).standard_normal(shape))


@pytest.mark.parametrize("noise", [0.1, 0.6])
def test_trees_are_parts_of_the_forest(arch, noise):
    """Inside every tree, orders differ as the twin's do, across the borders of cells, too."""
    phase = noisy((64, 40), noise)
    _, drafts, trees = drafted(phase)
    expected, _ = reference.unwrap_by_reliability(phase, np.ones(phase.shape, bool), (0.0, 0.0), ANYTHING)
    own, order = drafts_and_orders(runtime.to_host(drafts.labels))
    root, order = trees[Tree.ROOT, own], order + trees[Tree.ROOT_SHIFT, own]
    for tree in np.unique(root):
        assert np.ptp((order - expected)[root == tree]) == 0
    assert len(np.unique(root)) < 0.5 * len(np.unique(own))
    np.testing.assert_array_equal(trees[Tree.ROOT, np.unique(root)], np.unique(root))


@pytest.mark.parametrize("noise", [0.1, 0.6])
def test_between_two_trees_the_best_edge_is_noted(arch, noise):
    """Of all edges between two trees, and in each cell that sees them, by the costs in the table."""
    phase = noisy((64, 40), noise, seed=2)
    _, drafts, trees = drafted(phase)
    edges = runtime.empty((len(Edge), 65, 41), np.int32)
    weigh_edges_kernel(phase, runtime.to_device(flat_rates()), ANYTHING, edges)
    edges = runtime.to_host(edges)[:, 1:, 1:]
    own, _ = drafts_and_orders(runtime.to_host(drafts.labels))
    root = trees[Tree.ROOT, own]
    best: dict[tuple[int, int], int] = {}
    for plane, here, there in ((Edge.RIGHT, np.s_[:, :-1], np.s_[:, 1:]), (Edge.DOWN, np.s_[:-1], np.s_[1:])):
        costs = edges[plane][here]
        for a, b, cost in zip(root[here].ravel(), root[there].ravel(), costs.ravel(), strict=True):
            if a != b and cost < NO_EDGE:
                pair = (min(a, b), max(a, b))
                best[pair] = min(best.get(pair, NO_EDGE), int(cost))
    cells, contacts = runtime.to_host(drafts.cell_table), runtime.to_host(drafts.contacts)
    noted: dict[tuple[int, int], int] = {}
    for cell in range(drafts.cells):
        start = cell << (drafts.bits + 2)
        for a, b, _, votes, _ in contacts[:, start : start + cells[Cell.CONTACTS, cell]].T:
            assert a < b
            noted[a, b] = max(noted.get((a, b), 0), int(votes))
    assert {pair: NO_EDGE - cost for pair, cost in best.items()} == noted


def test_patches_hang_under_their_tree(arch):
    phase = noisy((48, 32), 0.3)
    method, drafts, trees = drafted(phase)
    counts = runtime.to_host(drafts.cell_table)[Cell.PATCHES, :-1].copy()
    first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
    cells = runtime.to_host(drafts.cell_table).copy()
    cells[Cell.PATCHES] = first
    drafts.cell_table = runtime.to_device(cells)
    table = runtime.to_device(np.zeros((len(Patch), int(counts.sum())), np.int32))
    method.hang_together(drafts, table)
    own = np.concatenate([(cell << drafts.bits) + np.arange(count) for cell, count in enumerate(counts)])
    heads = runtime.to_host(table)[Patch.HEAD]
    np.testing.assert_array_equal(own[heads], trees[Tree.ROOT, own])
    np.testing.assert_array_equal(runtime.to_host(table)[Patch.HEAD_SHIFT], trees[Tree.ROOT_SHIFT, own])
    ends, votes = method.complete_graph(heads, np.zeros((2, 0), np.int32), np.zeros(0, np.int32))
    assert ends.shape[1] == (heads != np.arange(len(heads))).sum() == len(votes)
    assert (heads[ends[1]] == ends[0]).all()


def test_contacts_keep_their_claims(arch):
    """On a clean plane every contact says what the plane's orders say."""
    phase = noisy((64, 40), 0.0)
    _, drafts, trees = drafted(phase)
    expected, _ = reference.unwrap_by_reliability(phase, np.ones(phase.shape, bool), (0.0, 0.0), ANYTHING)
    own, order = drafts_and_orders(runtime.to_host(drafts.labels))
    root, zero = trees[Tree.ROOT, own], expected - order - trees[Tree.ROOT_SHIFT, own]
    cells, contacts = runtime.to_host(drafts.cell_table), runtime.to_host(drafts.contacts)
    for cell in range(drafts.cells):
        start = cell << (drafts.bits + 2)
        noted = contacts[:, start : start + cells[Cell.CONTACTS, cell]]
        for a, b, shift in noted[[Contact.FROM, Contact.TO, Contact.SHIFT]].T:
            assert zero[root == b][0] - zero[root == a][0] == shift
