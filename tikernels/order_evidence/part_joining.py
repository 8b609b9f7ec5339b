"""Join patches to parts along their contacts, unless their evidence shows that they lie whole cycles apart.

A region may hold several surfaces with a hidden step of whole cycles between them. Each patch brings evidence: by how
much it deviates from each of a few candidate offsets. Contacts are gone through once, the best supported first; the
evidence of what they join adds up. Two parts stay apart where each prefers its own offset by a clear margin.
"""

import numpy as np
import numpy.typing as npt

from tikernels import checks
from tikernels._taichi import F32Array2, I32Array1, I32Array2, f32, i32, ti, u1
from tikernels.launching import kernel
from tikernels.unwrapping.tables import add_alone
from tikernels.unwrapping.union_find import part_of, rounds_at_once, settled

#: Offsets that the evidence of a region is weighed for.
CANDIDATES = 8
# Loop rounds that a contact costs: what is added up, and what it takes to find the parts.
_ROUNDS_A_CONTACT = 16


@ti.func
def likeliest(evidence: F32Array2, part: i32) -> i32:
    """Return the offset that the part deviates least from."""
    best = 0
    for k in ti.static(range(1, CANDIDATES)):
        if evidence[part, k] < evidence[part, best]:
            best = k
    return best


@ti.func
def lie_apart(
    a: i32, b: i32, span: i32, min_margin: f32, margin_a_pair: f32, orders: I32Array2, evidence: F32Array2
) -> u1:
    """Return whether two parts show enough orders, and each prefers its own offset to the other's."""
    best_a, best_b = likeliest(evidence, a), likeliest(evidence, b)
    need_a = ti.max(min_margin, margin_a_pair * evidence[a, CANDIDATES])
    need_b = ti.max(min_margin, margin_a_pair * evidence[b, CANDIDATES])
    apart = ti.min(orders[a, 1] - orders[a, 0], orders[b, 1] - orders[b, 0]) >= span
    apart &= evidence[a, best_b] - evidence[a, best_a] >= need_a
    apart &= evidence[b, best_a] - evidence[b, best_b] >= need_b
    return apart


@ti.func
def unite(a: i32, b: i32, orders: I32Array2, evidence: F32Array2, parents: I32Array1):
    """Make one part of two, which the patch with the smaller number stands for."""
    low, high = ti.min(a, b), ti.max(a, b)
    parents[high] = low
    for k in range(CANDIDATES + 1):
        add_alone(evidence[low, k], evidence[high, k])
    orders[low, 0] = ti.min(orders[low, 0], orders[high, 0])
    orders[low, 1] = ti.max(orders[low, 1], orders[high, 1])


@kernel
def join_parts_kernel(
    first: i32,  # contact to begin with,
    stop: i32,  # and the one to stop before
    ends: I32Array2,  # (2, C) the patches of each contact, the best supported ones first
    span: i32,  # orders that a part must show before it counts
    min_margin: f32,  # by how much a part must prefer its offset to another part's,
    margin_a_pair: f32,  # and by how much for each pair of cycles it has
    orders: I32Array2,  # (P, 2) first and last order of each patch, then of each part
    evidence: F32Array2,  # (P, CANDIDATES + 1) deviation from each offset, and pairs of cycles; then of each part
    parents: I32Array1,  # (P,) a patch of the same part
):
    """Go through the contacts one by one, in one thread."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        for contact in range(first, stop):
            a, b = part_of(parents, ends[0, contact]), part_of(parents, ends[1, contact])
            if a != b:
                if not lie_apart(a, b, span, min_margin, margin_a_pair, orders, evidence):
                    unite(a, b, orders, evidence, parents)


def join_parts(
    ends: npt.NDArray[np.int32],
    span: int,
    min_margin: float,
    margin_a_pair: float,
    orders: npt.NDArray[np.int32],
    evidence: npt.NDArray[np.float32],
) -> npt.NDArray[np.int32]:
    """Join patches along their contacts, but not two parts whose evidence shows that they lie whole cycles apart.

    Parameters
    ----------
    ends : (2, C) int32
        The patches of each contact, the best supported contact first.
    span : int
        Orders that a part must show before it counts.
    min_margin, margin_a_pair : float
        By how much a part must prefer its offset to another part's: in all, and for each pair of cycles that it has.
    orders : (P, 2) int32
        First and last order of each patch.
    evidence : (P, CANDIDATES + 1) float32
        By how much each patch deviates from each offset, and how many pairs of cycles it has.

    Returns
    -------
    (P,) int32
        The patch that stands for the part of each patch.

    Raises
    ------
    ShapeError
        A shape or dtype is another one.
    """
    count = len(evidence)
    ends = checks.read_array("ends", ends, (2, None), np.int32)
    orders = checks.read_array("orders", orders, (count, 2), np.int32)
    evidence = checks.read_array("evidence", evidence, (count, CANDIDATES + 1), np.float32)
    parents = np.arange(count, dtype=np.int32)
    # The kernel adds up in place.
    rules, sums = (span, min_margin, margin_a_pair), (orders.copy(), evidence.copy())
    at_once = rounds_at_once() // _ROUNDS_A_CONTACT
    for first in range(0, ends.shape[1], at_once):
        join_parts_kernel(first, min(first + at_once, ends.shape[1]), ends, *rules, *sums, parents)
    return settled(parents)
