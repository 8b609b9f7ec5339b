"""Rows as vectors: they are loaded and stored as the same rows are number by number."""

from functools import cache
from typing import Any

import numpy as np
import pytest

from tikernels import runtime
from tikernels._taichi import ti
from tikernels.lanes import (
    LANES,
    VECTOR_BYTES,
    as_lanes,
    byte_lanes,
    float_lanes,
    in_vectors,
    lane_count,
    lanes_at,
    load_around,
    load_lanes,
    load_lanes_of,
    planes,
    store_lanes,
    store_lanes_of,
    width_of,
)
from tikernels.launching import kernel


@cache
def _filter_kernel(wide: bool) -> Any:
    @kernel(whole_vectors=wide)
    def filter_kernel(
        values: planes(wide),  # (H, W)
        mask: planes(wide, ti.u8),  # (H, W)
        out: planes(wide, ndim=3),  # (2, H, W)
        out_last: planes(wide),  # (H, W)
    ):
        height, width = values.shape[0], width_of(values, wide)
        for t in range(height * lane_count(width)):
            y, place = lanes_at(t, width)
            near = load_around(values, float_lanes, y, place, width, -1.0, wide)
            holds = load_lanes(mask, byte_lanes, y, place, width, wide)
            differences, kept = float_lanes(0.0), float_lanes(0.0)
            for k in range(LANES):
                differences[k] = near[LANES + k + 3] - near[LANES + k - 1]
                kept[k] = ti.select(holds[k] != 0, near[LANES + k], ti.math.nan)
            store_lanes_of(out, 0, y, place, width, differences, wide)
            store_lanes_of(out, 1, y, place, width, kept, wide)
            store_lanes(out_last, y, place, width, load_lanes_of(out, 1, y, place, width, wide), wide)

    return filter_kernel


def filtered(values: np.ndarray, mask: np.ndarray) -> tuple[bool, np.ndarray, np.ndarray]:
    out = runtime.empty((2, *values.shape), np.float32), runtime.empty(values.shape, np.float32)
    arrays = values, mask, *out
    wide = in_vectors(*arrays)
    _filter_kernel(wide)(*(as_lanes(array, wide) for array in arrays))
    return wide, *(runtime.to_host(array) for array in out)


def aligned(array: np.ndarray) -> np.ndarray:
    copy = runtime.empty_on_host(array.shape, array.dtype.type)
    copy[...] = array
    return copy


@pytest.mark.parametrize("shape", [(5, 64), (1, 16), (7, 67), (3, 5), (2, 1), (4, 32)])
def test_rows_of_any_width(arch, shape):
    rng = np.random.default_rng(0)
    values, mask = rng.random(shape).astype(np.float32), (rng.random(shape) > 0.3).astype(np.uint8)
    framed = np.pad(values, ((0, 0), (1, 3)), constant_values=-1)
    differences, kept = framed[:, 4:] - framed[:, :-4], np.where(mask != 0, values, np.nan)
    for inputs in ((values, mask), (aligned(values), aligned(mask))):
        _, out, last = filtered(*inputs)
        np.testing.assert_array_equal(out, [differences, kept])
        np.testing.assert_array_equal(last, kept)


def test_vectors_are_whole_and_begin_where_they_may(cpu):
    fits = aligned(np.zeros((3, 32), np.float32))
    assert fits.ctypes.data % VECTOR_BYTES == 0
    assert in_vectors(fits, fits[:2], fits[1:]) and filtered(fits, aligned(np.ones((3, 32), np.uint8)))[0]
    assert not in_vectors(fits, fits.ravel()[4:36].reshape(1, 32))
    assert not in_vectors(aligned(np.zeros((3, 40), np.float32)))


def test_other_kernels_take_vectors_apart_as_before(cpu):
    """Keeping vectors is a setting of the whole language, and holds for one kernel."""
    fits = aligned(np.zeros((3, 32), np.float32))
    filtered(fits, aligned(np.ones((3, 32), np.uint8)))
    assert ti.lang.impl.current_cfg().real_matrix_scalarize
