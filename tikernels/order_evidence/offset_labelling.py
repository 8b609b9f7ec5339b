"""Label the patches of a region with the offsets that their code names, weighing all offsets and all patches at once.

Each patch has evidence: by how much its blocks deviate from the code at every offset. A patch alone shows little. The
labels start from the windows and pieces that show another offset than the region's (`offset_windows.py`), and from
evidence pooled along contacts, and settle between what a patch shows and what its neighbours are labelled with, a step
at every contact that separates two labels costing more the better the contact is supported: a Potts model, by iterated
conditional modes (J. Besag, On the statistical analysis of dirty pictures, J. R. Statist. Soc. B 48, 259, 1986).
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tikernels import runtime
from tikernels._taichi import (
    F32Array1,
    F32Array2,
    I32Array1,
    Static,
    Vec16Array3,
    f32,
    i32,
    ti,
    vec16,
)
from tikernels.launching import kernel
from tikernels.unwrapping.patches import one_thread_is_faster
from tikernels.unwrapping.tables import add_alone

#: Offsets that are looked at together (a vec16).
LANES = 16
# How far evidence is pooled, in patches, and how often all patches' labels settle at most.
_ROUNDS, _SWEEPS = 3, 8


@kernel(whole_vectors=True)
def weigh_offsets_kernel(
    serial: Static,  # whether one thread does it
    block: I32Array1,  # (M,) of each share; those of a block follow each other
    patch: I32Array1,  # (M,) and the patch that holds it
    share: F32Array1,  # (M,) how much it counts
    order: I32Array1,  # (N,) of each block
    level: F32Array1,  # (N,) logarithm of its contrast
    sigma: F32Array1,  # (N,) its standard deviation
    columns: F32Array2,  # (N, 4) where it looks along the stripe: a polynomial of its cycle, in repeats of the code
    code: F32Array2,  # (cycles, places) the code's levels
    first_offset: i32,
    most: f32,  # what a block may deviate by, in standard deviations
    out_sums: Vec16Array3,  # (P, groups of offsets, 2) see `OffsetEvidence`; 0 to begin with
):
    """Sum up by how much the blocks deviate from the code, and the squares of that."""
    ti.loop_config(serialize=serial)
    for group in range(out_sums.shape[1]):
        last, square, depart = -1, vec16(0.0), vec16(0.0)
        for m in range(block.shape[0]):
            n = block[m]
            if n != last:
                last, square, depart = n, vec16(most * most), vec16(0.0)
                first, per_sigma = order[n] + first_offset + group * LANES, 1 / sigma[n]
                for k in range(ti.max(-first, 0), ti.min(code.shape[0] - first, LANES)):
                    place = 0
                    if code.shape[1] > 1:
                        along = columns[n, 2] + (first + k) * columns[n, 3]
                        along = columns[n, 0] + (first + k) * (columns[n, 1] + (first + k) * along)
                        place = ti.cast((along - ti.floor(along)) * code.shape[1], ti.i32)
                        place = ti.max(ti.min(place, code.shape[1] - 1), 0)  # not a number where nothing is met
                    depart[k] = ti.max(ti.min((level[n] - code[first + k, place]) * per_sigma, most), -most)
                    square[k] = depart[k] * depart[k]
            add_alone(out_sums[patch[m], group, 0], share[m] * square)
            add_alone(out_sums[patch[m], group, 1], share[m] * depart)


class OffsetEvidence(NamedTuple):
    """Evidence of each patch's blocks for each offset."""

    sums: npt.NDArray[np.float32]
    """(P, groups, 2, LANES) squared deviations from the code, in variances, and deviations, in standard deviations."""
    weight: npt.NDArray[np.float32]
    """(P,) as how many blocks they count."""
    offsets: int
    """Number of offsets."""

    def only(self, offsets: npt.NDArray[np.integer]) -> "OffsetEvidence":
        """Return the evidence of some offsets (n,), counted from the first one."""
        to = np.arange(len(offsets))
        sums = np.zeros((len(self.sums), -(-len(to) // LANES), 2, LANES), np.float32)
        sums[:, to // LANES, :, to % LANES] = self.sums[:, offsets // LANES, :, offsets % LANES]
        return self._replace(sums=sums, offsets=len(to))

    def of(self, offsets: npt.NDArray[np.integer]) -> npt.NDArray[np.float32]:
        """Return the squared deviations (P, n) at some offsets, counted from the first one."""
        return np.ascontiguousarray(self.sums[:, offsets // LANES, 0, offsets % LANES])


def weigh_offsets(
    held: tuple[npt.NDArray[np.integer], npt.NDArray[np.integer], npt.NDArray[np.floating]],
    order: npt.NDArray[np.integer],
    level: npt.NDArray[np.floating],
    sigma: npt.NDArray[np.floating],
    columns: npt.NDArray[np.float32],
    code: npt.NDArray[np.floating],
    offsets: range,
    count: int,
    most: float,
) -> OffsetEvidence:
    """Sum up for every patch and offset by how much its blocks deviate from the code.

    Parameters
    ----------
    held : three (M,)
        A block, a patch that holds some of it, and how much that counts.
    order : (N,) int
        Every block's cycle.
    level : (N,) float
        The logarithm of its contrast.
    sigma : (N,) float
        Its standard deviation.
    columns : (N, 4) float32
        Places along the stripe: terms of a polynomial of its cycle, in repeats of the code.
    code : (cycles, places) float
        The code's levels.
    offsets : range
        Whole cycles that the orders may lack to be absolute.
    count : int
        Of patches, P.
    most : float
        Largest deviation of a block, in standard deviations; by so much does one outside the code.
    """
    sums = runtime.empty_on_host((count, -(-len(offsets) // LANES), 2, LANES), np.float32)
    sums[...] = 0
    block, patch = (np.ascontiguousarray(numbers, np.int32) for numbers in held[:2])
    share = held[2].astype(np.float32)
    seen = (np.ascontiguousarray(order, np.int32), level.astype(np.float32), sigma.astype(np.float32))
    expected = np.ascontiguousarray(columns, np.float32), np.ascontiguousarray(code, np.float32)
    weigh_offsets_kernel(one_thread_is_faster(count), block, patch, share, *seen, *expected, offsets.start, most, sums)
    return OffsetEvidence(sums, np.bincount(patch, share, count).astype(np.float32), len(offsets))


def pool_evidence(
    evidence: npt.NDArray[np.float32], ends: npt.NDArray[np.integer], weights: npt.NDArray[np.floating]
) -> npt.NDArray[np.float64]:
    """Add to each patch's evidence that of its neighbours, theirs, and of those again.

    Parameters
    ----------
    evidence : (P, offsets) float32
        Of each patch alone.
    ends : (2, C) int
        The patches of each contact.
    weights : (C,) float
        Weight of what comes over each contact.

    Returns
    -------
    (P, offsets) float64
    """
    here, there, weight = ends.ravel(), ends[::-1].ravel(), np.tile(weights, 2)
    pooled = evidence.T.astype(np.float64)
    for _ in range(_ROUNDS):
        pooled = evidence.T + [np.bincount(here, weight * before[there], len(evidence)) for before in pooled]
    return pooled.T


def settle_labels(
    evidence: npt.NDArray[np.float32],
    labels: npt.NDArray[np.integer],
    ends: npt.NDArray[np.integer],
    costs: npt.NDArray[np.floating],
) -> npt.NDArray[np.int64]:
    """Let labels settle between the patches' own evidence and their neighbours' labels.

    Half of the patches at a time: neighbours that change together would swap for ever.

    Parameters
    ----------
    evidence : (P, labels) float32
        Cost of each label for each patch.
    labels : (P,) int
        To begin with.
    ends : (2, C) int
        The patches of each contact.
    costs : (C,) float
        Cost of two labels that differ across each contact.

    Returns
    -------
    (P,) int64
    """
    here, there, cost = ends.ravel() * evidence.shape[1], ends[::-1].ravel(), np.tile(costs, 2)
    for _ in range(_SWEEPS):
        before = labels
        for half in range(2):
            alike = np.bincount(here + labels[there], cost, evidence.size).reshape(evidence.shape)
            labels = np.where(np.arange(len(labels)) % 2 == half, (evidence - alike).argmin(axis=1), labels)
        if np.array_equal(labels, before):
            break
    return np.asarray(labels, np.int64)


def connected_parts(ends: npt.NDArray[np.integer], count: int) -> npt.NDArray[np.int64]:
    """Return for each of `count` patches the smallest one that (2, C) contacts connect it with."""
    parts = np.arange(count)
    while True:
        a, b = parts[ends[0]], parts[ends[1]]
        before = parts.copy()
        np.minimum.at(parts, a, b)
        np.minimum.at(parts, b, a)
        parts = parts[parts]
        if np.array_equal(parts, before):
            return parts
