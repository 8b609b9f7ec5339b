"""Label the patches of a region with the offsets that their code names, weighing all offsets and all patches at once.

Each patch has evidence: by how much its blocks deviate from the code at every offset. A patch alone tells little, so
evidence is pooled along contacts. The labels then settle between what a patch shows and what its neighbours are
labelled with, a step at every contact that separates two labels costing more the better the contact is supported: a
Potts model, by iterated conditional modes (J. Besag, On the statistical analysis of dirty pictures, J. R. Statist. Soc.
B 48, 259, 1986).
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tikernels._taichi import (
    F32Array1,
    F32Array2,
    I32Array1,
    I32Array2,
    Vec16Array1,
    Vec16Array2,
    f32,
    i32,
    ti,
    vec16,
)
from tikernels.launching import kernel
from tikernels.unwrapping.tables import add_alone

#: Offsets that are looked at together (a vec16), and as many labels as there may be.
LANES = 16
# How far evidence is pooled, in patches, and how often all patches' labels settle at most.
_ROUNDS, _SWEEPS = 3, 8
# What a label costs that there is not.
_NEVER = 1e30


@kernel
def weigh_offsets_kernel(
    block: I32Array1,  # (M,) of each share
    patch: I32Array1,  # (M,) and the patch that holds it
    share: F32Array1,  # (M,) how much it counts
    order: I32Array1,  # (N,) of each block
    level: F32Array1,  # (N,) logarithm of its contrast
    sigma: F32Array1,  # (N,) its standard deviation
    columns: F32Array2,  # (N, 4) where it looks along the stripe: a polynomial of its cycle, in repeats of the code
    code: F32Array2,  # (cycles, places) the code's levels
    first_offset: i32,
    most: f32,  # what a block may deviate by, in variances
    out_evidence: Vec16Array2,  # (P, groups of offsets); 0 to begin with
):
    """Sum up by how much the blocks deviate from the code."""
    for group in range(out_evidence.shape[1]):
        for m in range(block.shape[0]):
            n = block[m]
            cost = vec16(most)
            for k in ti.static(range(LANES)):
                cycle = order[n] + first_offset + group * LANES + k
                if cycle >= 0 and cycle < code.shape[0]:
                    along = columns[n, 2] + cycle * columns[n, 3]
                    along = columns[n, 0] + cycle * (columns[n, 1] + cycle * along)
                    place = ti.cast((along - ti.floor(along)) * code.shape[1], ti.i32)
                    place = ti.max(ti.min(place, code.shape[1] - 1), 0)  # not a number where nothing is met
                    departs = (level[n] - code[cycle, place]) / sigma[n]
                    cost[k] = ti.min(departs * departs, most)
            add_alone(out_evidence[patch[m], group], share[m] * cost)


@kernel
def pool_evidence_kernel(
    starts: I32Array1,  # (P + 1,) of each patch's neighbours
    neighbours: I32Array1,  # (2 C,) patches
    weights: F32Array1,  # (2 C,) of their evidence
    evidence: Vec16Array2,  # (P, groups of offsets)
    before: Vec16Array2,  # (P, groups) what was pooled in the round before
    out_pooled: Vec16Array2,  # (P, groups)
):
    """Add to each patch's evidence what its neighbours have pooled in the round before."""
    for patch in range(evidence.shape[0]):
        for group in range(evidence.shape[1]):
            total = evidence[patch, group]
            for n in range(starts[patch], starts[patch + 1]):
                total += weights[n] * before[neighbours[n], group]
            out_pooled[patch, group] = total


@kernel
def settle_labels_kernel(
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
) -> npt.NDArray[np.float32]:
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
        What a block may deviate by, in variances; so much does one outside the code.

    Returns
    -------
    (P, offsets) float32
        Squared deviations, in variances.
    """
    evidence = np.zeros((count, _groups(len(offsets)), LANES), np.float32)
    block, patch = (np.ascontiguousarray(numbers, np.int32) for numbers in held[:2])
    seen = (np.ascontiguousarray(order, np.int32), level.astype(np.float32), sigma.astype(np.float32))
    expected = np.ascontiguousarray(columns, np.float32), np.ascontiguousarray(code, np.float32)
    weigh_offsets_kernel(block, patch, held[2].astype(np.float32), *seen, *expected, offsets.start, most, evidence)
    return evidence.reshape(count, -1)[:, : len(offsets)]


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
    weight = weights[links.contact].astype(np.float32)
    for _ in range(_ROUNDS):
        pool_evidence_kernel(links.starts, links.neighbours, weight, alone, before, pooled)
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
    cost = costs[links.contact].astype(np.float32)
    settled = np.stack([labels, labels]).astype(np.int32)
    all_labels = _in_groups(evidence, _NEVER)[:, 0]
    for _ in range(_SWEEPS):
        before = settled[0].copy()
        settle_labels_kernel(links.starts, links.neighbours, cost, all_labels, settled)
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
