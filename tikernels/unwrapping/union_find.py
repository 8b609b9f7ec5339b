"""Union-find over patches in one thread: of each patch some patch of the same part, until one stands for itself."""

import numpy as np
import numpy.typing as npt

from tikernels import runtime
from tikernels._taichi import I32Array1, i32, ti

# Mesa's software Vulkan ends a thread's loops without a word after 65,535 rounds in all. Half of them leaves room for
# what a step begins.
_DEVICE_ROUNDS = 1 << 15


def rounds_at_once() -> int:
    """Return how many loop rounds one thread may do in one call of a kernel."""
    return 2**31 - 1 if runtime.started() == "cpu" else _DEVICE_ROUNDS


@ti.func
def part_of(parents: I32Array1, patch: i32) -> i32:
    """Return the patch that stands for a patch's part, and shorten the way to it."""
    part = patch
    while parents[part] != part:
        parents[part] = parents[parents[part]]
        part = parents[part]
    return part


def settled(parents: npt.NDArray[np.int32]) -> npt.NDArray[np.int32]:
    """Return (P,) the patch that stands for each patch's part, from (P,) some patch of the same part."""
    while True:
        further = parents[parents]
        if np.array_equal(further, parents):
            return further
        parents = further
