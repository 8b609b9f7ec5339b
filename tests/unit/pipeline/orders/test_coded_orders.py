"""When parts are read anew because patches have moved between them."""

import numpy as np
import pytest
from support.coded_blocks import grid

from pipeline.orders.coded_orders import _cut_off, _much_moved, _standing


@pytest.mark.parametrize(("moved", "much"), [(0, False), (4, False), (5, True), (40, True)])
def test_a_tenth_of_the_smaller_part(moved, much):
    """Of the larger part, of 160 patches, some are now the smaller one's, which has 40."""
    before = np.repeat([0, 160], [160, 40]).astype(np.int32)
    roots = before.copy()
    roots[160 - moved : 160] = 160
    assert _much_moved(before, roots, grid(10, 20)) == much


def test_a_part_whose_root_has_moved():
    """It is known by another of its patches from now on."""
    graph, before = grid(10, 20), np.repeat([0, 100], 100).astype(np.int32)
    roots = before.copy()
    roots[100] = 0
    assert _much_moved(before, roots, graph)
    standing = _standing(roots, graph)
    np.testing.assert_array_equal(standing[roots], np.where(np.arange(200) > 100, 101, 0))


@pytest.mark.parametrize("rows", [7, 3])
def test_what_only_moved_patches_held_together_is_no_part_any_more(rows):
    """A row of patches goes to another part; the smaller side of it stays alone, also if it holds the root."""
    graph, before = grid(10, 20), np.tile(np.arange(20) // 10 * 10, 10).astype(np.int32)
    row, column = np.divmod(np.arange(200), 20)
    roots = np.where((row == rows) & (column < 10), 10, before).astype(np.int32)
    alone = (column < 10) & (row > rows if rows == 7 else row < rows)
    found = _cut_off(before, roots, graph)
    np.testing.assert_array_equal(found[~alone], roots[~alone])
    (name,) = np.unique(found[alone])
    assert alone[name]
    assert name not in roots
    assert _much_moved(before, found, graph)


def test_a_part_of_several_pieces_stays_one():
    """Those that were put back to it hang together through other parts."""
    graph, before = grid(10, 20), np.where(np.arange(200) // 20 == 5, 100, 0).astype(np.int32)
    np.testing.assert_array_equal(_cut_off(before, before, graph), before)
