"""Patches on the wrong side of a border between two parts."""

import numpy as np
import pytest
from support.coded_steps import WIDTH, grid, shown

from pipeline.orders.border_settling import settle_borders
from pipeline.pattern import contrast_levels

ROWS, COLUMNS = 14, 12
LEFT, RIGHT = 30, 33  # what the orders of either surface lack
TRUE = np.where(np.arange(COLUMNS) < 7, LEFT, RIGHT)


def settled(cut, error=0.0, **surface):
    """Settle a region that was cut before this column instead of the seventh."""
    cycles, _ = shown(ROWS, COLUMNS, TRUE, **surface)
    x = np.arange(ROWS * COLUMNS) % COLUMNS
    roots = np.where(x < cut, 0, COLUMNS - 1).astype(np.int32)
    lacks = np.where(x < cut, LEFT, RIGHT)
    found = settle_borders(cycles, grid(ROWS, COLUMNS), WIDTH, 1.0, roots, lacks, np.full(len(x), error))
    return found.roots.reshape(ROWS, COLUMNS), found.torn.reshape(ROWS, COLUMNS), found.shifts


@pytest.mark.parametrize("cut", [5, 6, 7, 8, 9])
@pytest.mark.parametrize("factor", [0.0, -0.3])
def test_the_cut_moves_to_where_the_contrast_changes(cut, factor):
    roots, torn, shifts = settled(cut, factor=factor)
    expected = np.where(TRUE == LEFT, 0, COLUMNS - 1)
    wrong = (roots != expected) & ~torn
    differ = np.abs(contrast_levels()[np.arange(ROWS) + LEFT] - contrast_levels()[np.arange(ROWS) + RIGHT]) > 0.05
    assert 4 <= differ.sum() < ROWS
    assert not wrong[differ].any()
    assert not torn[differ].any()
    assert torn.sum() <= 4 * (~differ).sum()
    assert not shifts.any()


def test_patches_that_both_sides_may_have_are_torn():
    """At the true cut, where the symbols of both surfaces are the same."""
    _, torn, _ = settled(7)
    alike = np.abs(contrast_levels()[np.arange(ROWS) + LEFT] - contrast_levels()[np.arange(ROWS) + RIGHT]) < 0.01
    assert alike.any()
    assert torn[alike][:, 6:8].all()
    assert not torn[:, :5].any() and not torn[:, 9:].any()


def test_unsure_orders_are_flagged_anyway():
    assert not settled(7, error=0.01)[1].any()


def test_orders_of_another_region_change():
    """The right surface is a region of its own, whose orders count from elsewhere: what joins it counts as it does."""
    cycles, _ = shown(ROWS, COLUMNS, TRUE)
    x = np.arange(ROWS * COLUMNS) % COLUMNS
    cut, graph = 5, grid(ROWS, COLUMNS)
    roots = np.where(x < cut, 0, COLUMNS - 1).astype(np.int32)
    # The left region's orders are two lower, so they lack two more.
    offset = graph.offset - 2 * (x < cut)
    cycles.order[x[cycles.patch] < cut] -= 2
    lacks = np.where(x < cut, LEFT + 2, RIGHT)
    graph = graph._replace(root=roots, offset=offset)
    found = settle_borders(cycles, graph, WIDTH, 1.0, roots, lacks, np.zeros(len(x)))
    moved = found.roots != roots
    assert moved.sum() >= 8
    np.testing.assert_array_equal(found.shifts, np.where(moved, -2, 0))
    assert (x[moved] >= cut).all()


def test_nothing_without_borders():
    cycles, _ = shown(ROWS, COLUMNS, TRUE)
    roots = np.zeros(ROWS * COLUMNS, np.int32)
    graph = grid(ROWS, COLUMNS)._replace(borders=None)
    found = settle_borders(cycles, graph, WIDTH, 1.0, roots, roots.astype(int), np.zeros(len(roots)))
    assert not found.torn.any() and not found.shifts.any()
    np.testing.assert_array_equal(found.roots, roots)


@pytest.mark.parametrize("change", [-0.1, 0.1])
@pytest.mark.parametrize("step", [1, 2, 3])
def test_what_light_from_a_surface_close_by_changes_stays(change, step):
    """Its contrast is as high as that of the surface close by, but rises from cycle to cycle as its own does."""
    columns, cut = 40, 30
    x = np.arange(ROWS * columns) % columns
    lacks = np.where(x < cut, LEFT, LEFT + step)
    cycles, _ = shown(ROWS, columns, lacks[:columns], factor=np.where(x >= cut - 3, change, 0.0))
    roots = np.where(x < cut, 0, columns - 1).astype(np.int32)
    found = settle_borders(cycles, grid(ROWS, columns), WIDTH, 1.0, roots, lacks, np.zeros(len(x)))
    np.testing.assert_array_equal(found.roots[x < cut - 1], 0)


def test_a_part_whose_place_is_rather_wrong_takes_nothing():
    cycles, _ = shown(ROWS, COLUMNS, TRUE)
    x = np.arange(ROWS * COLUMNS) % COLUMNS
    roots = np.where(x < 5, 0, COLUMNS - 1).astype(np.int32)
    lacks, unsure = np.where(x < 5, LEFT, RIGHT), np.where(x < 5, 0.6, 0.0)
    found = settle_borders(cycles, grid(ROWS, COLUMNS), WIDTH, 1.0, roots, lacks, unsure)
    np.testing.assert_array_equal(found.roots, roots)
