"""Strips: every place of every row once, whatever the length of the last strip."""

import numpy as np
import pytest

from tikernels._taichi import I32Array2, i32, ti
from tikernels.strips import STRIP, strip_at, strip_count


@ti.kernel
def visit_kernel(
    size: i32,
    out: I32Array2,  # (H, W) how often a place is visited
):
    for t in range(out.shape[0] * strip_count(out.shape[1], size)):
        y, first, count = strip_at(t, out.shape[1], size)
        for x in range(first, first + count):
            out[y, x] = out[y, x] + 1


@pytest.mark.parametrize("size", [1, 7, STRIP])
@pytest.mark.parametrize("shape", [(1, 1), (3, STRIP - 1), (5, STRIP), (2, 2 * STRIP + 1), (70, 3)])
def test_every_place_is_visited_once(arch, shape, size):
    visits = np.zeros(shape, np.int32)
    visit_kernel(size, visits)
    np.testing.assert_array_equal(visits, 1)
