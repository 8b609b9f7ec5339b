"""Buffers come back to the pool when nothing looks at them any more, and not before."""

import gc

import numpy as np

from pipeline.decoding.buffers import BufferPool, clear_buffers
from tikernels import runtime


def address(array):
    return array.__array_interface__["data"][0]


def test_a_slice_keeps_the_memory_it_looks_at(cpu):
    pool = BufferPool()
    _, surface = pool.lend((16, 32), points=False)
    first = address(surface.unwrapped)
    surface.unwrapped.fill(7)
    row = surface.unwrapped.view(np.int32)[3:4, ::2]
    del surface
    gc.collect()
    others = [pool.lend((16, 32), points=False)[1] for _ in range(3)]
    assert first not in [address(other.unwrapped) for other in others]
    for other in others:
        other.unwrapped.fill(0)
    np.testing.assert_array_equal(row.view(np.float32), 7)
    del row
    assert address(pool.lend((16, 32), points=False)[1].unwrapped) == first


def test_what_nobody_holds_is_used_again(arch):
    pool = BufferPool()
    phases, surface = pool.lend((16, 32), points=True)
    on_host = runtime.started() == "cpu"
    kept = {address(phases.variance)} if on_host else {id(phases.variance)}
    assert surface.points.shape == (16, 32, 3)
    del phases, surface
    gc.collect()
    phases, _ = pool.lend((16, 32), points=True)
    seen = (phases.variance, phases.modulation, phases.precision)
    assert kept <= ({address(array) for array in seen} if on_host else {id(array) for array in seen})


def test_the_pool_keeps_two_sets_and_no_more(cpu):
    pool = BufferPool()
    many = [pool.lend((16, 32), points=False) for _ in range(20)]
    assert len({address(surface.mask) for _, surface in many}) == 20
    del many
    gc.collect()
    assert {len(waiting) for waiting in pool._free.values()} == {2}


def test_another_size_drops_what_waits(cpu):
    pool = BufferPool()
    pool.lend((16, 32), points=False)
    gc.collect()
    assert any(len(waiting) for waiting in pool._free.values())
    _, surface = pool.lend((32, 16), points=False)
    assert surface.mask.shape == (32, 16)
    assert not any(len(waiting) for waiting in pool._free.values())


def test_cleared_buffers_hold_nothing(cpu):
    phases, surface = BufferPool().lend((4, 5), points=True)
    clear_buffers(phases, surface)
    for array in (phases.precision, surface.unwrapped, surface.points):
        assert np.isnan(array).all()
    for array in (phases.modulation, phases.variance, surface.mask, surface.region):
        assert not array.any()
