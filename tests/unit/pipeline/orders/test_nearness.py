"""Where placed parts lead one to expect the others."""

import numpy as np
from support.coded_blocks import WIDTH, grid

from pipeline.orders.nearness import log_nearness, nearness


def test_parts_near_a_plane():
    """The left half is placed; the right one, whose orders count from elsewhere, lacks 5 cycles to be on its plane."""
    graph = grid(6, 10)
    right = np.arange(60) % 10 >= 5
    roots = np.where(right, 5, 0).astype(np.int32)
    graph = graph._replace(offset=(graph.offset - 5 * right).astype(np.int32))
    lacking = nearness(graph, roots, WIDTH, {0: 12})
    np.testing.assert_allclose(lacking[[0, 5]], [12, 17])
    likely = log_nearness(lacking[5], np.arange(40))
    assert likely.argmax() == 17 and likely[17] == 0
    np.testing.assert_allclose(likely[[13, 21]], -np.log(2))
