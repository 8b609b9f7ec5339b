"""Kernels that are launched again with what their last launch left behind: other arrays, shapes, numbers, constants."""

import threading

import numpy as np
import pytest

from tikernels import launching, runtime
from tikernels._taichi import AnyArray2, F32Array1, F32Array2, Static, Vec16Array1, Vec16Array2, f32, i32, ti
from tikernels.launching import kernel


@kernel
def add_kernel(values: F32Array2, times: Static, factor: f32, offset: i32, out: F32Array2):
    for y, x in ti.ndrange(values.shape[0], values.shape[1]):
        total = ti.cast(offset, ti.f32)
        for _ in ti.static(range(times)):
            total += factor * values[y, x]
        out[y, x] = total


@kernel
def double_kernel(values: AnyArray2, out: F32Array1):
    for y in range(values.shape[0]):
        out[y] = 2.0 * values[y, 0]


@kernel
def add_vectors_kernel(values: Vec16Array2, out: Vec16Array1):
    for y in range(values.shape[0]):
        total = values[y, 0]
        for x in range(1, values.shape[1]):
            total += values[y, x]
        out[y] = total


def added(values, times, factor, offset):
    out = np.zeros_like(values)
    add_kernel(values, times, factor, offset, out)
    return out


def test_other_arguments(arch):
    rng = np.random.default_rng(0)
    for turn in range(12):
        values = rng.normal(size=(2 + turn % 5, 3 + turn % 4)).astype(np.float32)
        times, factor, offset = 1 + turn % 2, float(rng.normal()), turn
        expected = times * factor * values + offset
        np.testing.assert_allclose(added(values, times, factor, offset), expected, rtol=1e-5, atol=1e-5)


def test_element_types_take_turns(arch):
    out = np.zeros(3, np.float32)
    for dtype in (np.float32, np.int32, np.float32, np.int32):
        values = np.arange(6, dtype=dtype).reshape(3, 2)
        double_kernel(values, out)
        np.testing.assert_array_equal(out, 2 * values[:, 0])


def test_arrays_of_vectors(arch):
    rng = np.random.default_rng(1)
    for rows, columns in ((3, 2), (5, 4), (1, 1), (3, 2)):
        values, out = rng.normal(size=(rows, columns, 16)).astype(np.float32), np.zeros((rows, 16), np.float32)
        add_vectors_kernel(values, out)
        np.testing.assert_allclose(out, values.sum(axis=1), atol=1e-5)


def test_little_is_kept(arch):
    """One context for each combination of types, however many shapes there are; none where launching is not ours."""
    before = [len(kept) for kept in launching._kept]
    for rows in range(1, 40):
        added(np.ones((rows, 2), np.float32), 1, 1.0, 0)
    more = sum(len(kept) for kept in launching._kept) - sum(before)
    assert more <= 1
    if arch != "cpu" or not launching._kept:
        assert more == 0


def test_a_device_that_is_started_anew(arch):
    values = np.ones((3, 4), np.float32)
    np.testing.assert_array_equal(added(values, 2, 0.5, 1), 2.0)
    other = next((name for name in runtime.supported_archs() if name != arch), None)
    if other is None:
        pytest.skip("this machine has one arch only")
    for name in (other, arch):
        runtime.init(name)
        np.testing.assert_array_equal(added(values, 2, 0.5, 1), 2.0)


def test_what_a_kernel_refuses_it_refuses_again(arch):
    good, out = np.ones((3, 4), np.float32), np.zeros((3, 4), np.float32)
    for _ in range(2):
        add_kernel(good, 1, 1.0, 0, out)
        with pytest.raises(ValueError, match="dtype"):
            add_kernel(good.astype(np.int32), 1, 1.0, 0, out)
        with pytest.raises(ValueError, match="ndim"):
            add_kernel(good[0], 1, 1.0, 0, out)
        with pytest.raises(ValueError, match="contiguous"):
            add_kernel(good[:, ::2], 1, 1.0, 0, out)
        with pytest.raises(Exception, match=r"[Mm]issing|needed"):
            add_kernel(good, 1, 1.0, 0)


def test_threads_take_turns(arch):
    """Each gets its own result, though all set the arguments of one context."""
    wrong = []

    def work(offset):
        values = np.full((16, 16), offset, np.float32)
        for _ in range(50):
            if not np.array_equal(added(values, 1, 1.0, offset), 2 * values):
                wrong.append(offset)

    added(np.ones((16, 16), np.float32), 1, 1.0, 1)
    threads = [threading.Thread(target=work, args=(offset,)) for offset in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert not wrong


@kernel
def wrong_kernel(out: F32Array1):
    for y in range(out.shape[0]):
        out[y] = out.no_such_thing


def test_errors_in_kernels_name_their_line(arch):
    with pytest.raises(Exception, match=r"test_launching\.py.*, line \d+"):
        wrong_kernel(np.zeros(3, np.float32))
