"""Patches on the wrong side of a border between two parts."""

import numpy as np
import pytest
from support.coded_blocks import CODES, grid, reader_of

from pipeline.orders.border_settling import settle_borders

pytestmark = [pytest.mark.usefixtures("cpu"), pytest.mark.parametrize("name", CODES)]

ROWS, COLUMNS = 14, 12
LEFT, RIGHT = 20, 23  # what the orders of either surface lack
TRUE = np.where(np.arange(COLUMNS) < 7, LEFT, RIGHT)


def cut_at(cut, columns=COLUMNS):
    """Return by column the root of a region that was cut before this one."""
    return np.where(np.arange(columns) < cut, 0, columns - 1)


def settled(name, cut, error=0.0, **surface):
    """Settle a region that was cut before this column instead of the seventh."""
    roots = cut_at(cut)
    reader = reader_of(name, ROWS, COLUMNS, TRUE, root=roots, **surface)
    roots = np.tile(roots, ROWS).astype(np.int32)
    lacks = np.where(roots == 0, LEFT, RIGHT)
    found = settle_borders(reader, grid(ROWS, COLUMNS), roots, lacks, np.full(len(roots), error))
    return found.roots.reshape(ROWS, COLUMNS), found.torn.reshape(ROWS, COLUMNS), found.shifts


def differences(name):
    """Return (rows, columns, 2): by how much the code differs, in each patch's blocks, at the two surfaces' orders."""
    reader = reader_of(name, ROWS, COLUMNS, 0)
    which = np.arange(len(reader.blocks.order))
    one, other = (reader.expected(which, reader.blocks.order + lacks) for lacks in (LEFT, RIGHT))
    return np.abs(one - other).reshape(ROWS, COLUMNS, 2)


@pytest.mark.parametrize("cut", [5, 6, 7, 8, 9])
@pytest.mark.parametrize("factor", [0.0, -0.3])
def test_the_cut_moves_to_where_the_contrast_changes(name, cut, factor):
    roots, torn, shifts = settled(name, cut, factor=factor)
    expected = np.where(TRUE == LEFT, 0, COLUMNS - 1)
    differ = (differences(name) > 0.04).all(axis=2)
    assert 0.2 < differ.mean() < 0.9
    assert not ((roots != expected) & ~torn)[differ].any()
    assert not torn[differ].any()
    assert not torn[:, :4].any() and not torn[:, 10:].any()
    assert not shifts.any()


def test_patches_that_both_sides_may_have_are_torn(name):
    """At the true cut, where the symbols of both surfaces are the same."""
    _, torn, _ = settled(name, 7)
    alike = (differences(name)[:, 6:8] < 0.012).all(axis=2)
    assert alike.any()
    assert torn[:, 6:8][alike].all()
    assert not torn[:, :5].any() and not torn[:, 9:].any()


def test_unsure_orders_are_flagged_anyway(name):
    assert not settled(name, 7, error=0.01)[1].any()


def test_orders_of_another_region_change(name):
    """The right surface is a region of its own, whose orders count from elsewhere: what joins it counts as it does."""
    cut, graph = 5, grid(ROWS, COLUMNS)
    reader = reader_of(name, ROWS, COLUMNS, TRUE, root=cut_at(cut))
    roots = np.tile(cut_at(cut), ROWS).astype(np.int32)
    # The left region's orders are two lower, so they lack two more.
    graph = graph._replace(root=roots, offset=graph.offset - 2 * (roots == 0))
    reader.blocks.order[reader.blocks.root == 0] -= 2
    lacks = np.where(roots == 0, LEFT + 2, RIGHT)
    found = settle_borders(reader, graph, roots, lacks, np.zeros(len(roots)))
    moved = found.roots != roots
    assert moved.sum() >= 8
    np.testing.assert_array_equal(found.shifts, np.where(moved, -2, 0))
    assert (np.tile(np.arange(COLUMNS), ROWS)[moved] >= cut).all()


def test_nothing_without_borders(name):
    reader = reader_of(name, ROWS, COLUMNS, TRUE)
    roots = np.zeros(ROWS * COLUMNS, np.int32)
    graph = grid(ROWS, COLUMNS)._replace(borders=None)
    found = settle_borders(reader, graph, roots, roots.astype(int), np.zeros(len(roots)))
    assert not found.torn.any() and not found.shifts.any()
    np.testing.assert_array_equal(found.roots, roots)


@pytest.mark.parametrize("change", [-0.1, 0.1])
@pytest.mark.parametrize("step", [1, 2, 3])
def test_what_light_from_a_surface_close_by_changes_stays(name, change, step):
    """Its contrast is as high as that of the surface close by, but changes from block to block as its own does."""
    columns, cut = 40, 30
    x = np.arange(columns)
    lacks = np.where(x < cut, LEFT, LEFT + step)
    roots = cut_at(cut, columns)
    factor = np.tile(np.repeat(np.where(x >= cut - 3, change, 0.0), 2), ROWS)
    reader = reader_of(name, ROWS, columns, lacks, root=roots, factor=factor)
    roots = np.tile(roots, ROWS).astype(np.int32)
    found = settle_borders(reader, grid(ROWS, columns), roots, np.tile(lacks, ROWS), np.zeros(len(roots)))
    np.testing.assert_array_equal(found.roots.reshape(ROWS, columns)[:, : cut - 1], 0)


def test_a_part_whose_place_is_rather_wrong_takes_nothing(name):
    roots = np.tile(cut_at(5), ROWS).astype(np.int32)
    reader = reader_of(name, ROWS, COLUMNS, TRUE, root=cut_at(5))
    lacks, unsure = np.where(roots == 0, LEFT, RIGHT), np.where(roots == 0, 0.6, 0.0)
    found = settle_borders(reader, grid(ROWS, COLUMNS), roots, lacks, unsure)
    np.testing.assert_array_equal(found.roots, roots)
