"""Cut regions where the code contradicts them: several surfaces were joined across steps of whole cycles.

Six cycles in a row, a stretch, name their place in the code's sequence. Many stretches tell how strong the code is in
this frame, and by how much its steps scatter. Then the patches of every region are labelled with the offsets that their
steps name, all at once (`tikernels.order_evidence.offset_labelling`).
"""

import numpy as np
import numpy.typing as npt

from pipeline.models import FloatArray
from pipeline.orders.contrast_cycles import Steps
from pipeline.orders.posterior import Integers, OrderRange
from pipeline.pattern import CYCLES, contrast_steps
from tikernels.order_evidence.contrast_reading import LEAST, SECOND, WINDOW, match_stretches
from tikernels.order_evidence.offset_labelling import (
    Links,
    connected_parts,
    pool_evidence,
    settle_labels,
    weigh_offsets,
)
from tikernels.unwrapping.patches import PatchGraph

# Below this share of the code's steps the frame does not show the code; a response of gamma 2.4 leaves half of them.
_MIN_STRENGTH = 0.25
# Steps in a stretch: those of six cycles.
_STRETCH = 5
# Standard deviation of the slow change of the contrast's logarithm a cycle: blur takes more where fringes are finer.
_DRIFT = 0.04
# Of the stretches that overlap, every second one votes.
_EVERY = 2
# Smallest standard deviation of a step's logarithm: what balance, slopes and blur leave of it on clean frames.
_MIN_SIGMA = 0.015
# What a single step may add to the squared deviation from the code, in variances, that is three standard deviations:
# edges and blemishes deviate by more, and must not decide alone.
_MAX_DEVIATION = 9.0
# Where the squared deviation of the steps is larger than this on average, in variances, none of the offsets that
# stretches have named is the right one.
_NOWHERE = 5.5
# Regions of fewer pixels or steps are too small to be parted.
_MIN_PARTED_PX, _MIN_STEPS = 600, 6
# An offset is a candidate where patches, with what comes over contacts of this support or more undiminished, prefer it
# to their region's own by this margin, in variances; it takes this many such patches, and the commonest few are looked
# at.
_FULL_SUPPORT, _MIN_MARGIN, _MIN_PATCHES, _CANDIDATES = 300, 250.0, 3, 12
# What a difference of labels costs across a contact of full support, in variances, and the least share of it.
_LABEL_COST, _LEAST_SUPPORT = 12.0, 0.05


def spread_and_strength(steps: Steps) -> tuple[float, float]:
    """Return the standard deviation of a step, and the strength of the code's; 0: the frame does not show it."""
    # By medians: the steps at edges are many times too large.
    strength = float(np.median(np.abs(steps.rise)) / np.median(np.abs(contrast_steps()))) if len(steps.rise) else 0.0
    if strength < _MIN_STRENGTH:
        return _MIN_SIGMA, 0.0
    # More exactly, by the stretches that fit clearly.
    stretches = _stretches(steps)
    if len(stretches) == 0:
        return _MIN_SIGMA, strength
    # What all five steps have in common may be the contrast's own slow change.
    common = 1 - 1 / np.sqrt(1 + _STRETCH * (_DRIFT / _MIN_SIGMA) ** 2)
    without = np.eye(_STRETCH) - common / _STRETCH
    windows = np.lib.stride_tricks.sliding_window_view(contrast_steps(strength), _STRETCH) @ without
    seen = steps.rise[stretches] @ without
    matches = match_stretches(seen.astype(np.float32), windows.astype(np.float32))
    best, clear = matches[:, WINDOW].astype(np.int64), matches[:, LEAST] < 0.25 * matches[:, SECOND]
    if not clear.any():
        return _MIN_SIGMA, strength
    expected = windows[best[clear]]
    factor = (seen[clear] * expected).sum(axis=1) / np.maximum((expected**2).sum(axis=1), 1e-12)
    factor = np.median(factor)
    remaining = ((seen[clear] - factor * expected) ** 2).mean(axis=1)
    strength *= float(factor)
    return max(_MIN_SIGMA, 1.7 * float(np.sqrt(np.median(remaining)))), strength


def cut_regions(
    steps: Steps, graph: PatchGraph, sigma: float, strength: float, order_range: OrderRange | None = None
) -> tuple[npt.NDArray[np.int32], Integers]:
    """Cut pieces off regions that the code contradicts.

    Parameters
    ----------
    steps : Steps
        Of all columns of patches.
    graph : PatchGraph
        The patches, joined to regions.
    sigma, strength : float
        Of `spread_and_strength`; with a strength of 0 nothing is cut.
    order_range : OrderRange, optional
        What is not in the projector's picture need not be looked at. Where surfaces are said to be is left to the
        posteriors, for it may be wrong.

    Returns
    -------
    roots : (P,) int32
        The patch that stands for each patch's part.
    main : (P,) int64
        By region, the root of its largest part with the region's own offset; -1 where nothing was cut off.
    """
    roots, main = graph.root.copy(), np.full(len(graph.root), -1)
    if strength == 0:
        return roots, main
    least, most = -CYCLES, CYCLES
    if order_range is not None and not order_range.of_depth:
        least, most = int(np.floor(order_range.least.min())), int(np.ceil(order_range.most.max()))
    owner = graph.root[steps.low]
    pixels, count = np.bincount(graph.root, graph.pixels), np.bincount(owner, minlength=len(graph.root))
    regions = np.flatnonzero(pixels >= _MIN_PARTED_PX)
    regions = regions[count[regions] >= _MIN_STEPS]
    number = np.empty(len(graph.root), np.int64)
    held = (_held_by(owners, regions) for owners in (graph.root, owner, graph.root[graph.ends[0]]))
    for region, patches, own, within in zip(regions, *held, strict=True):
        number[patches] = np.arange(len(patches))
        ends, support = number[graph.ends[:, within]], np.clip(graph.votes[within] / _FULL_SUPPORT, 0, 1)
        seen = (number[steps.low[own]], number[steps.high[own]]), steps.order[own], steps.rise[own]
        lowest, highest = int(steps.order[own].min()), int(steps.order[own].max())
        offsets = range(max(-highest, least), min(CYCLES - 2 - lowest, most) + 1)
        if len(offsets) == 0:
            continue
        labels = _labels(*seen, ends, support, len(patches), sigma, strength, offsets)
        if labels is None:
            continue
        whole = labels[ends[0]] == labels[ends[1]]
        pieces = connected_parts(ends[:, whole], len(patches))
        roots[patches] = patches[pieces]
        own_offset = np.bincount(pieces[labels == 0], graph.pixels[patches][labels == 0], len(patches))
        main[region] = patches[own_offset.argmax()]
    return roots, main


def _held_by(owners: npt.NDArray[np.integer], regions: Integers) -> list[Integers]:
    """Return of each region, in the order of their numbers, the places at which it is the owner."""
    order = np.argsort(owners, kind="stable")
    firsts, lasts = (np.searchsorted(owners[order], regions, side) for side in ("left", "right"))
    return [order[first:last] for first, last in zip(firsts, lasts, strict=True)]


def _labels(
    ends_of_steps: tuple[Integers, Integers],
    order: Integers,
    rise: FloatArray,
    ends: Integers,
    support: FloatArray,
    patches: int,
    sigma: float,
    strength: float,
    offsets: range,
) -> npt.NDArray[np.int32] | None:
    """Label a region's patches with the offsets that their steps name, 0 for the region's own; None: all have that."""
    code = contrast_steps(strength)
    evidence = weigh_offsets(ends_of_steps, order, rise, code, offsets, patches, sigma, _MAX_DEVIATION)
    own = int(evidence.sum(axis=0).argmin())
    links = Links.of(ends, patches)
    pooled = pool_evidence(evidence, links, support)
    best = pooled.argmin(axis=1)
    margin = pooled[:, own] - pooled[np.arange(patches), best]
    votes = np.bincount(best[(best != own) & (margin > _MIN_MARGIN)], minlength=len(offsets))
    named = np.argsort(-votes, kind="stable")[:_CANDIDATES]
    named = named[votes[named] >= _MIN_PATCHES]
    if len(named) == 0:
        return None
    candidates = np.append(own, named)
    # None of them is right where the steps deviate by more than this from all.
    shown = np.bincount(np.concatenate(ends_of_steps), minlength=patches)
    nowhere = (0.5 * _NOWHERE * shown[:, None]).astype(np.float32)
    alone = np.column_stack([evidence[:, candidates], nowhere])
    first = np.column_stack([pooled[:, candidates], pool_evidence(nowhere, links, support)]).argmin(axis=1)
    labels = settle_labels(alone, first, links, _LABEL_COST * np.maximum(support, _LEAST_SUPPORT))
    return None if (labels == 0).all() else labels


def _stretches(steps: Steps) -> Integers:
    """Return the (n, 5) steps of every six cycles in a row, from the lowest order."""
    starts = np.arange(0, max(len(steps.place) - _STRETCH + 1, 0), _EVERY)
    starts = starts[steps.place[starts + _STRETCH - 1] - steps.place[starts] == _STRETCH - 1]
    stretches: Integers = starts[:, None] + np.arange(_STRETCH)
    return stretches if steps.rising else stretches[:, ::-1]
