"""Rows as vectors: they are loaded and stored as the same rows are number by number."""

from functools import cache
from typing import Any

import numpy as np
import pytest
from support.array_forms import on_device

from tikernels import runtime
from tikernels._taichi import ti
from tikernels.lanes import (
    VECTOR_BYTES,
    Lanes,
    as_lanes,
    in_vectors,
    lane_count,
    lanes_at,
    load_around,
    load_lanes,
    load_lanes_of,
    planes,
    put_back,
    store_lanes,
    store_lanes_of,
    whole_rows,
    width_of,
)
from tikernels.launching import kernel


@cache
def _filter_kernel(wide: bool) -> Any:
    lanes = Lanes.of(wide)

    @kernel(whole_vectors=wide)
    def filter_kernel(
        values: planes(wide),  # (H, W)
        mask: planes(wide, ti.u8),  # (H, W)
        out: planes(wide, ndim=3),  # (2, H, W)
        out_last: planes(wide),  # (H, W)
    ):
        height, width = values.shape[0], width_of(values, wide)
        for t in range(height * lane_count(width, wide)):
            y, place = lanes_at(t, width, wide)
            near = load_around(values, lanes.three_floats, y, place, width, 3, -1.0, wide)
            holds = load_lanes(mask, lanes.bytes, y, place, width, wide)
            differences, kept = lanes.floats(0.0), lanes.floats(0.0)
            for k in range(lanes.count):
                differences[k] = near[lanes.count + k + 3] - near[lanes.count + k - 1]
                kept[k] = ti.select(holds[k] != 0, near[lanes.count + k], ti.math.nan)
            store_lanes_of(out, 0, y, place, width, differences, wide)
            store_lanes_of(out, 1, y, place, width, kept, wide)
            store_lanes(out_last, y, place, width, load_lanes_of(out, lanes.floats, 1, y, place, width, wide), wide)

    return filter_kernel


@pytest.mark.parametrize("shape", [(3, 32), (3, 40), (2, 3, 17), (1, 1)])
def test_rows_are_made_whole_and_put_back(cpu, shape):
    values = np.arange(np.prod(shape), dtype=np.float32).reshape(shape)
    (rows, more), wide = whole_rows(values, values, beyond=-1.0)
    assert wide and in_vectors(rows, more)
    np.testing.assert_array_equal(rows[..., : shape[-1]], values)
    assert (rows[..., shape[-1] :] == -1).all() and (more[..., shape[-1] :] == 0).all()
    assert whole_rows(rows)[0][0] is rows
    rows += 1
    put_back(rows, values)
    np.testing.assert_array_equal(values.ravel(), np.arange(1, 1 + values.size))


def test_rows_of_a_gpu_stay_as_they_are(arch):
    """On the CPU an ndarray of the kernel language is copied, too."""
    values, buffer = np.zeros((3, 17), np.float32), on_device(np.ones((3, 17), np.float32))
    rows, wide = whole_rows(values, buffer)
    assert wide == (arch == "cpu")
    if not wide:
        assert rows[0] is values and rows[1] is buffer
        return
    np.testing.assert_array_equal(rows[1][:, :17], 1)
    rows[1] += 1
    put_back(rows[1], buffer)
    np.testing.assert_array_equal(buffer.to_numpy(), 2)


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
