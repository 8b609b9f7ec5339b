"""Cut regions where the code contradicts them: several surfaces were joined across steps of whole cycles.

The code's strength, and by how much the steps deviate from it, are estimated in every strip of a region
(`code_posterior`). Then the region's patches are labelled with the offsets that their steps name, all at once
(`tikernels.order_evidence.offset_labelling`).
"""

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from pipeline.models import FloatArray
from pipeline.orders.code_posterior import CodeReading, PartSteps, code_posteriors, log_likelihoods, seen_steps
from pipeline.orders.contrast_cycles import Steps
from pipeline.orders.posterior import Integers, OrderRange
from pipeline.pattern import CYCLES, contrast_steps
from pipeline.robust import robust_sigma
from tikernels.order_evidence.offset_labelling import (
    Links,
    connected_parts,
    pool_evidence,
    settle_labels,
    weigh_offsets,
)
from tikernels.unwrapping.patches import PatchGraph

# The code's strength and spread are those of a strip so many patches wide, so that few strips show several surfaces.
_STRIP = 8
# Smallest standard deviation of a step's logarithm: what balance, slopes, ambient light and a lens that is not the
# usual one leave of it on clean frames. With 0.03 a piece of a clean bust that a camera without blur sees is cut off.
_MIN_SIGMA = 0.035
# The scatter of single columns is estimated from pairs of columns this many patches apart, which is further than the
# grain of a texture reaches, and for this many pairs of similar brightness at a time.
_APART, _PAIRS = 6, 200
# What a single step may add to the squared deviation from the code, in variances, that is three standard deviations:
# edges and blemishes deviate by more, and must not decide alone.
_MAX_DEVIATION = 9.0
# Regions of fewer pixels or steps are too small to be parted.
_MIN_PARTED_PX, _MIN_STEPS = 600, 6
# An offset is a candidate where patches, with what comes over contacts of this support or more undiminished, prefer it
# to their region's own by this margin, in variances; it takes this many such patches, and the commonest few are looked
# at.
_FULL_SUPPORT, _MIN_MARGIN, _MIN_PATCHES, _CANDIDATES = 300, 250.0, 3, 12
# What a difference of labels costs across a contact of full support, in variances, and the least share of it.
_LABEL_COST, _LEAST_SUPPORT = 12.0, 0.05


def cut_regions(
    steps: Steps, graph: PatchGraph, order_range: OrderRange | None = None
) -> tuple[npt.NDArray[np.int32], Integers]:
    """Cut pieces off regions that the code contradicts.

    Parameters
    ----------
    steps : Steps
        Of all columns of patches.
    graph : PatchGraph
        The patches, joined to regions.
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
    least, most = -CYCLES, CYCLES
    if order_range is not None and not order_range.of_depth:
        least, most = int(np.floor(order_range.least.min())), int(np.ceil(order_range.most.max()))
    owner = graph.root[steps.low].astype(np.int64)
    pixels, count = np.bincount(graph.root, graph.pixels), np.bincount(owner, minlength=len(graph.root))
    regions = np.flatnonzero(pixels >= _MIN_PARTED_PX)
    regions = regions[count[regions] >= _MIN_STEPS]
    strip, seen, code = _read_strips(steps, owner)
    if code.strength == 0:
        return roots, main
    expected = np.array([contrast_steps(strength) for strength in code.strengths])
    usual = np.array([part.scatter for part in seen])
    number = np.empty(len(graph.root), np.int64)
    held = (_held_by(owners, regions) for owners in (graph.root, owner, graph.root[graph.ends[0]]))
    for region, patches, own, within in zip(regions, *held, strict=True):
        number[patches] = np.arange(len(patches))
        ends, support = number[graph.ends[:, within]], np.clip(graph.votes[within] / _FULL_SUPPORT, 0, 1)
        here = strip[own]
        sigma = np.maximum(_MIN_SIGMA, np.hypot(code.spreads[here], _scatter(steps, own, usual[here])))
        ends_of_steps = number[steps.low[own]], number[steps.high[own]]
        shown = ends_of_steps, steps.order[own], steps.rise[own], sigma, here, expected
        lowest, highest = int(steps.order[own].min()), int(steps.order[own].max())
        offsets = range(max(-highest, least), min(CYCLES - 2 - lowest, most) + 1)
        if len(offsets) == 0:
            continue
        labels = _labels(*shown, ends, support, len(patches), offsets)
        if labels is None:
            continue
        whole = labels[ends[0]] == labels[ends[1]]
        pieces = connected_parts(ends[:, whole], len(patches))
        roots[patches] = patches[pieces]
        own_offset = np.bincount(pieces[labels == 0], graph.pixels[patches][labels == 0], len(patches))
        main[region] = patches[own_offset.argmax()]
    return roots, main


def _read_strips(steps: Steps, owner: Integers) -> tuple[Integers, list[PartSteps], CodeReading]:
    """Return the strip (N,) of every step, and what the strips show of the code, each read as a part of its own."""
    columns = int(steps.column.max(initial=0)) + 1
    strips, strip = np.unique(owner * columns + steps.column // _STRIP, return_inverse=True)
    parts = np.arange(len(strips))
    seen = seen_steps(replace(steps, low=strip, high=strip), parts.astype(np.int32), parts)
    return strip, seen, code_posteriors(log_likelihoods(seen), np.zeros(len(strips)))


def _scatter(steps: Steps, own: Integers, usual: FloatArray) -> FloatArray:
    """Return the standard deviation (n,) of a region's steps by their brightness; the usual one if pairs are few."""
    order, column, rise, brightness = steps.order[own], steps.column[own], steps.rise[own], steps.brightness[own]
    place = order * (column.max() + _APART + 1) + column
    sort = np.argsort(place, kind="stable")
    other = np.searchsorted(place[sort], place + _APART)
    one = np.flatnonzero(other < len(sort))
    one = one[place[sort[other[one]]] == place[one] + _APART]
    if len(one) < _PAIRS:
        return usual
    two = sort[other[one]]
    apart, dim = np.abs(rise[one] - rise[two]), np.sqrt(brightness[one] * brightness[two])
    bins = np.array_split(np.argsort(dim, kind="stable"), len(one) // _PAIRS)
    middles, scatters = np.array([(np.median(dim[some]), robust_sigma(apart[some])) for some in bins]).T
    return np.asarray(np.interp(np.log(brightness), np.log(middles), scatters / np.sqrt(2)))


def _held_by(owners: npt.NDArray[np.integer], regions: Integers) -> list[Integers]:
    """Return of each region, in the order of their numbers, the places at which it is the owner."""
    order = np.argsort(owners, kind="stable")
    firsts, lasts = (np.searchsorted(owners[order], regions, side) for side in ("left", "right"))
    return [order[first:last] for first, last in zip(firsts, lasts, strict=True)]


def _labels(
    ends_of_steps: tuple[Integers, Integers],
    order: Integers,
    rise: FloatArray,
    sigma: FloatArray,
    strip: Integers,
    code: FloatArray,
    ends: Integers,
    support: FloatArray,
    patches: int,
    offsets: range,
) -> npt.NDArray[np.int32] | None:
    """Label a region's patches with the offsets that their steps name, 0 for the region's own; None: all have that."""
    evidence = weigh_offsets(ends_of_steps, order, rise, sigma, strip, code, offsets, patches, _MAX_DEVIATION)
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
    alone, first = evidence[:, candidates], pooled[:, candidates].argmin(axis=1)
    labels = settle_labels(alone, first, links, _LABEL_COST * np.maximum(support, _LEAST_SUPPORT))
    return None if (labels == 0).all() else labels
