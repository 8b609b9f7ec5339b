"""Label the patches of a region with the offsets that their code names, weighing all offsets and all patches at once.

Each patch has evidence: by how much its steps deviate from the code at every offset. A patch alone tells little, so
evidence is pooled along contacts. The labels then settle between what a patch shows and what its neighbours are
labelled with, a step at every contact that separates two labels costing more the better the contact is supported: a
Potts model, by iterated conditional modes (J. Besag, On the statistical analysis of dirty pictures, J. R. Statist. Soc.
B 48, 259, 1986).
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tikernels._taichi import F32Array1, F32Array2, I32Array1, f32, i32, ti


@ti.kernel
def weigh_offsets_kernel(
    low: I32Array1,  # (S,) patch of each step's lower cycle
    high: I32Array1,  # (S,) and of its higher one
    order: I32Array1,  # (S,) the lower cycle's order
    rise: F32Array1,  # (S,) of the contrast's logarithm
    code: F32Array1,  # (N,) the code's, as strong as it is in the frame
    first_offset: i32,
    sigma: f32,
    most: f32,  # what a step may deviate by, in variances
    out_evidence: F32Array2,  # (offsets, P)
):
    """Sum up by how much the steps deviate from the code; half of it goes to either patch."""
    for k in range(out_evidence.shape[0]):
        for patch in range(out_evidence.shape[1]):
            out_evidence[k, patch] = 0.0
        for s in range(order.shape[0]):
            place, deviation = order[s] + first_offset + k, most
            if place >= 0 and place < code.shape[0]:
                departs = (rise[s] - code[place]) / sigma
                deviation = ti.min(departs * departs, most)
            out_evidence[k, low[s]] = out_evidence[k, low[s]] + 0.5 * deviation
            out_evidence[k, high[s]] = out_evidence[k, high[s]] + 0.5 * deviation


@ti.kernel
def pool_evidence_kernel(
    rounds: i32,
    starts: I32Array1,  # (P + 1,) of each patch's neighbours
    neighbours: I32Array1,  # (2 C,) patches
    weights: F32Array1,  # (2 C,) of their evidence
    evidence: F32Array2,  # (offsets, P)
    out_even: F32Array2,  # (offsets, P) after an even number of rounds; the evidence, to begin with
    out_odd: F32Array2,  # (offsets, P) after an odd one
):
    """Add to each patch's evidence what its neighbours have pooled in the round before; offset by offset."""
    for k in range(evidence.shape[0]):
        for turn in range(rounds):
            for patch in range(evidence.shape[1]):
                total = evidence[k, patch]
                for n in range(starts[patch], starts[patch + 1]):
                    pooled = out_even[k, neighbours[n]]
                    if turn % 2 == 1:
                        pooled = out_odd[k, neighbours[n]]
                    total += weights[n] * pooled
                if turn % 2 == 0:
                    out_odd[k, patch] = total
                else:
                    out_even[k, patch] = total


@ti.kernel
def settle_labels_kernel(
    half: i32,  # of the patches, 0 or 1
    starts: I32Array1,  # (P + 1,) of each patch's neighbours
    neighbours: I32Array1,  # (2 C,) patches
    costs: F32Array1,  # (2 C,) of a different label there
    evidence: F32Array2,  # (labels, P)
    labels: I32Array1,  # (P,)
    out_labels: I32Array1,  # (P,)
):
    """Give one half of the patches the labels that cost least beside their neighbours' present ones."""
    for patch in range(labels.shape[0]):
        best, least = labels[patch], 1e30
        if patch % 2 == half:
            for label in range(evidence.shape[0]):
                cost = evidence[label, patch]
                for n in range(starts[patch], starts[patch + 1]):
                    if labels[neighbours[n]] != label:
                        cost += costs[n]
                if cost < least:
                    best, least = label, cost
        out_labels[patch] = best


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
    patches: tuple[npt.NDArray[np.integer], npt.NDArray[np.integer]],
    order: npt.NDArray[np.integer],
    rise: npt.NDArray[np.floating],
    code: npt.NDArray[np.floating],
    offsets: range,
    count: int,
    sigma: float,
    most: float,
) -> npt.NDArray[np.float32]:
    """Sum up for every patch and offset by how much its steps deviate from the code.

    Parameters
    ----------
    patches : two (S,) int
        The patches of each step's lower and higher cycle: half of the deviation goes to either.
    order : (S,) int
        The lower cycle's order.
    rise : (S,) float
        By how much the logarithm of the contrast rises.
    code : (N,) float
        The same of the code.
    offsets : range
        Whole cycles that the orders may lack to be absolute.
    count : int
        Of patches, P.
    sigma, most : float
        A step's standard deviation, and what one may deviate by, in variances; so much does one outside the code.

    Returns
    -------
    (offsets, P) float32
        Squared deviations, in variances.
    """
    evidence = np.empty((len(offsets), count), np.float32)
    low, high = (np.ascontiguousarray(ends, np.int32) for ends in patches)
    seen = (np.ascontiguousarray(order, np.int32), rise.astype(np.float32), code.astype(np.float32))
    weigh_offsets_kernel(low, high, *seen, offsets.start, sigma, most, evidence)
    return evidence


def pool_evidence(
    evidence: npt.NDArray[np.float32], links: Links, weights: npt.NDArray[np.floating], rounds: int
) -> npt.NDArray[np.float32]:
    """Add to each patch's evidence that of its neighbours, theirs, and so on.

    Parameters
    ----------
    evidence : (offsets, P) float32
        Of each patch alone.
    links : Links
        Its contacts.
    weights : (C,) float
        How much counts what comes over each contact.
    rounds : int
        How far it comes, in patches.

    Returns
    -------
    (offsets, P) float32
    """
    pooled = evidence.copy(), np.empty_like(evidence)
    weight = weights[links.contact].astype(np.float32)
    pool_evidence_kernel(rounds, links.starts, links.neighbours, weight, evidence, *pooled)
    return pooled[rounds % 2]


def settle_labels(
    evidence: npt.NDArray[np.float32],
    labels: npt.NDArray[np.integer],
    links: Links,
    costs: npt.NDArray[np.floating],
    sweeps: int,
) -> npt.NDArray[np.int32]:
    """Let labels settle between the patches' own evidence and their neighbours' labels.

    Parameters
    ----------
    evidence : (labels, P) float32
        What each label costs each patch.
    labels : (P,) int
        To begin with.
    links : Links
        Contacts.
    costs : (C,) float
        What two labels cost that differ across each contact.
    sweeps : int
        How often all patches are looked at.

    Returns
    -------
    (P,) int32
    """
    cost = costs[links.contact].astype(np.float32)
    settled = np.ascontiguousarray(labels, np.int32)
    # Half of the patches at a time: neighbours that change together would swap for ever.
    for half in (0, 1) * sweeps:
        before, settled = settled, np.empty_like(settled)
        settle_labels_kernel(half, links.starts, links.neighbours, cost, evidence, before, settled)
    return settled


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
