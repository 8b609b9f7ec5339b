"""When parts are read anew because patches have moved between them."""

import numpy as np
import pytest
from support.coded_blocks import grid

from pipeline.orders.coded_orders import _much_moved, _standing


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
