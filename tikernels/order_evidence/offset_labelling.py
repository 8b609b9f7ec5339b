"""Label the patches of a region with the offsets that their code names, weighing all offsets and all patches at once.

Each patch has evidence: by how much its blocks deviate from the code at every offset. A patch alone tells little. The
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
    I32Array2,
    Static,
    Vec16Array1,
    Vec16Array2,
    Vec16Array3,
    f32,
    i32,
    ti,
    vec16,
)
from tikernels.launching import kernel
from tikernels.unwrapping.patches import one_thread_is_faster
from tikernels.unwrapping.tables import add_alone

#: Offsets that are looked at together (a vec16), and as many labels as there may be.
LANES = 16
# How far evidence is pooled, in patches, and how often all patches' labels settle at most.
_ROUNDS, _SWEEPS = 3, 8
# What a label costs that there is not.
_NEVER = 1e30


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


@kernel
def pool_evidence_kernel(
    serial: Static,  # whether one thread does it
    starts: I32Array1,  # (P + 1,) of each patch's neighbours
    neighbours: I32Array1,  # (2 C,) patches
    weights: F32Array1,  # (2 C,) of their evidence
    evidence: Vec16Array2,  # (P, groups of offsets)
    before: Vec16Array2,  # (P, groups) what was pooled in the round before
    out_pooled: Vec16Array2,  # (P, groups)
):
    """Add to each patch's evidence what its neighbours have pooled in the round before."""
    ti.loop_config(serialize=serial)
    for patch in range(evidence.shape[0]):
        for group in range(evidence.shape[1]):
            total = evidence[patch, group]
            for n in range(starts[patch], starts[patch + 1]):
                total += weights[n] * before[neighbours[n], group]
            out_pooled[patch, group] = total


@kernel
def settle_labels_kernel(
    serial: Static,  # whether one thread does it
    starts: I32Array1,  # (P + 1,) of each patch's neighbours
    neighbours: I32Array1,  # (2 C,) patches
    costs: F32Array1,  # (2 C,) of a different label there
    evidence: Vec16Array1,  # (P,) of every label
    out_labels: I32Array2,  # (2, P) alike, to begin with
):
    """Give one half of the patches, then the other, the labels that cost least beside their neighbours' present ones.

    Half of the patches at a time: neighbours that change together would swap for ever.
    """
    for half in ti.static(range(2)):
        ti.loop_config(serialize=serial)
        for patch in range(evidence.shape[0]):
            best = out_labels[half, patch]
            if patch % 2 == half:
                cost = evidence[patch]
                for n in range(starts[patch], starts[patch + 1]):
                    # What all labels cost alike does not matter. One by one: SPIR-V does not index loaded vectors.
                    label = out_labels[half, neighbours[n]]
                    for k in ti.static(range(LANES)):
                        cost[k] -= ti.select(label == k, costs[n], 0.0)
                best, least = 0, cost[0]
                for k in ti.static(range(1, LANES)):
                    best = ti.select(cost[k] < least, k, best)
                    least = ti.min(cost[k], least)
            out_labels[1 - half, patch] = best


class Links(NamedTuple):
    """The contacts of every patch."""

    starts: npt.NDArray[np.int32]
    """(P + 1,) where each patch's begin."""
    neighbours: npt.NDArray[np.int32]
    """(2 C,) the patch at the other end."""
    contact: npt.NDArray[np.int64]
    """(2 C,) which contact it is."""

    @classmethod
    def of(cls, ends: npt.NDArray[np.integer], count: int) -> "Links":
        """Sort the (2, C) ends of contacts between `count` patches by patch."""
        here = np.concatenate([ends[0], ends[1]])
        sort = np.argsort(here, kind="stable")
        starts = np.searchsorted(here[sort], np.arange(count + 1))
        there = np.concatenate([ends[1], ends[0]])[sort]
        return cls(starts.astype(np.int32), there.astype(np.int32), sort % max(ends.shape[1], 1))


class OffsetEvidence(NamedTuple):
    """What the blocks of each patch say of each offset."""

    sums: npt.NDArray[np.float32]
    """(P, groups, 2, LANES) squared deviations from the code, in variances, and deviations, in standard deviations."""
    weight: npt.NDArray[np.float32]
    """(P,) as how many blocks they count."""
    offsets: int
    """How many there are."""

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
        Where it looks along the stripe: terms of a polynomial of its cycle, in repeats of the code.
    code : (cycles, places) float
        The code's levels.
    offsets : range
        Whole cycles that the orders may lack to be absolute.
    count : int
        Of patches, P.
    most : float
        What a block may deviate by, in standard deviations; by so much does one outside the code.
    """
    sums = runtime.empty_on_host((count, _groups(len(offsets)), 2, LANES), np.float32)
    sums[...] = 0
    block, patch = (np.ascontiguousarray(numbers, np.int32) for numbers in held[:2])
    share = held[2].astype(np.float32)
    seen = (np.ascontiguousarray(order, np.int32), level.astype(np.float32), sigma.astype(np.float32))
    expected = np.ascontiguousarray(columns, np.float32), np.ascontiguousarray(code, np.float32)
    weigh_offsets_kernel(one_thread_is_faster(count), block, patch, share, *seen, *expected, offsets.start, most, sums)
    return OffsetEvidence(sums, np.bincount(patch, share, count).astype(np.float32), len(offsets))


def pool_evidence(
    evidence: npt.NDArray[np.float32], links: Links, weights: npt.NDArray[np.floating]
) -> npt.NDArray[np.float32]:
    """Add to each patch's evidence that of its neighbours, theirs, and of those again.

    Parameters
    ----------
    evidence : (P, offsets) float32
        Of each patch alone.
    links : Links
        Its contacts.
    weights : (C,) float
        How much counts what comes over each contact.

    Returns
    -------
    (P, offsets) float32
    """
    alone = _in_groups(evidence, 0.0)
    before, pooled = alone, np.empty_like(alone)
    weight, serial = weights[links.contact].astype(np.float32), one_thread_is_faster(len(evidence))
    for _ in range(_ROUNDS):
        pool_evidence_kernel(serial, links.starts, links.neighbours, weight, alone, before, pooled)
        before, pooled = pooled, np.empty_like(alone)
    return before.reshape(len(evidence), -1)[:, : evidence.shape[1]]


def settle_labels(
    evidence: npt.NDArray[np.float32],
    labels: npt.NDArray[np.integer],
    links: Links,
    costs: npt.NDArray[np.floating],
) -> npt.NDArray[np.int32]:
    """Let labels settle between the patches' own evidence and their neighbours' labels.

    Parameters
    ----------
    evidence : (P, labels) float32
        What each label costs each patch; at most LANES labels.
    labels : (P,) int
        To begin with.
    links : Links
        Contacts.
    costs : (C,) float
        What two labels cost that differ across each contact.

    Returns
    -------
    (P,) int32
    """
    cost, serial = costs[links.contact].astype(np.float32), one_thread_is_faster(len(evidence))
    settled = np.stack([labels, labels]).astype(np.int32)
    all_labels = _in_groups(evidence, _NEVER)[:, 0]
    for _ in range(_SWEEPS):
        before = settled[0].copy()
        settle_labels_kernel(serial, links.starts, links.neighbours, cost, all_labels, settled)
        if np.array_equal(settled[0], before):
            break
    return np.asarray(settled[0])


def _groups(offsets: int) -> int:
    return -(-offsets // LANES)


def _in_groups(evidence: npt.NDArray[np.float32], beyond: float) -> npt.NDArray[np.float32]:
    """Return (P, offsets) evidence as (P, groups, LANES), with a value for offsets beyond."""
    whole = np.full((len(evidence), _groups(evidence.shape[1]) * LANES), beyond, np.float32)
    whole[:, : evidence.shape[1]] = evidence
    return whole.reshape(len(evidence), -1, LANES)


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
