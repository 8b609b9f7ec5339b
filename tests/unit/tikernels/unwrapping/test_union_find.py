"""Which patch stands for a part, and how long one thread may go on."""

import numpy as np
import pytest

from tikernels import runtime
from tikernels._taichi import I32Array1, i32, ti
from tikernels.unwrapping.union_find import part_of, rounds_at_once, settled


@ti.kernel
def parts_of_kernel(parents: I32Array1, out: I32Array1):
    for patch in range(out.shape[0]):
        out[patch] = part_of(parents, patch)


@ti.kernel
def count_rounds_kernel(rounds: i32, out: I32Array1):
    ti.loop_config(serialize=True)
    for _ in range(1):
        done = 0
        while done < rounds:
            done += 1
        out[0] = done


def test_a_chain_has_one_part():
    parents = np.array([0, 0, 1, 2, 3, 5, 5], np.int32)
    np.testing.assert_array_equal(settled(parents), [0, 0, 0, 0, 0, 5, 5])


def test_nothing_is_settled():
    assert settled(np.empty(0, np.int32)).shape == (0,)


def test_the_kernel_finds_the_same(arch):
    rng = np.random.default_rng(1)
    parents = np.array([0, *(rng.integers(0, k + 1) for k in range(1, 500))], np.int32)
    out = np.empty(500, np.int32)
    parts_of_kernel(parents.copy(), out)
    np.testing.assert_array_equal(out, settled(parents))


def test_every_round_is_done(arch):
    """Mesa's software Vulkan ends loops after 65,535 rounds, and says nothing."""
    done = np.zeros(1, np.int32)
    rounds = min(rounds_at_once(), 10**6)
    count_rounds_kernel(rounds, done)
    assert done[0] == rounds


@pytest.mark.parametrize("arch", ["cpu"], indirect=True)
def test_the_cpu_need_not_stop(arch):
    assert runtime.started() == "cpu"
    assert rounds_at_once() > 10**9
