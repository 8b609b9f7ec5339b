"""Cut regions where the code contradicts them: several surfaces were joined across steps of whole cycles.

What blocks show beside the code is taken from the region as if it were one part (`code_evidence`). Then its patches are
labelled with the offsets that their blocks name, all at once (`tikernels.order_evidence.offset_labelling`).
"""

import numpy as np
import numpy.typing as npt

from pipeline.contrast_code import CYCLES
from pipeline.models import FloatArray
from pipeline.orders.code_evidence import CodeReader
from pipeline.orders.posterior import Integers, OrderRange
from pipeline.robust import robust_sigma
from tikernels.order_evidence.offset_labelling import (
    Links,
    connected_parts,
    pool_evidence,
    settle_labels,
    weigh_offsets,
)
from tikernels.unwrapping.patches import PatchGraph

# Blocks and rows of patches over which what is left of the factor is averaged: what is as large as these may be another
# surface.
_AROUND = (17, 5)
# Smallest standard deviation of a block's contrast: what its surface's factor may be off by. Blocks side by side
# deviate alike: each counts as this many.
_MIN_SIGMA, _COUNTS = 0.03, 0.5
# What a single block may add to the squared deviation from the code, in variances, that is three standard deviations:
# edges and blemishes deviate by more, and must not decide alone.
_MAX_DEVIATION = 9.0
# Regions of fewer pixels or blocks are too small to be parted.
_MIN_PARTED_PX, _MIN_BLOCKS = 600, 12
# An offset is a candidate where patches, with what comes over contacts of this support or more undiminished, prefer it
# to their region's own by this margin, in variances; it takes this many such patches, and the commonest few are looked
# at.
_FULL_SUPPORT, _MIN_MARGIN, _MIN_PATCHES, _CANDIDATES = 300, 70.0, 3, 12
# What a difference of labels costs across a contact of full support, in variances, and the least share of it.
_LABEL_COST, _LEAST_SUPPORT = 12.0, 0.05


def cut_regions(
    reader: CodeReader, graph: PatchGraph, order_range: OrderRange | None = None
) -> tuple[npt.NDArray[np.int32], Integers]:
    """Cut pieces off regions that the code contradicts.

    Parameters
    ----------
    reader : CodeReader
        Of the frame's blocks.
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
    roots, main, blocks = graph.root.copy(), np.full(len(graph.root), -1), reader.blocks
    least, most = -CYCLES, CYCLES
    if order_range is not None and not order_range.of_depth:
        least, most = int(np.floor(order_range.least.min())), int(np.ceil(order_range.most.max()))
    pixels, count = np.bincount(graph.root, graph.pixels), np.bincount(blocks.root, minlength=len(graph.root))
    regions = np.flatnonzero(pixels >= _MIN_PARTED_PX)
    regions = regions[count[regions] >= _MIN_BLOCKS]
    number = np.empty(max(len(graph.root), len(blocks.order)), np.int64)
    held = (
        _held_by(owners, regions)
        for owners in (graph.root, blocks.root, blocks.root[blocks.block], graph.root[graph.ends[0]])
    )
    for region, patches, own, shares, within in zip(regions, *held, strict=True):
        if len(reader.offsets(own)) == 0:
            continue
        # A piece may lie where the region as a whole cannot.
        orders = blocks.order[own]
        offsets = range(max(int(-orders.max()), least), min(int(reader.cycles - 1 - orders.min()), most) + 1)
        number[patches] = np.arange(len(patches))
        holder, ends = number[blocks.patch[shares]], number[graph.ends[:, within]]
        number[own] = np.arange(len(own))
        support = np.clip(graph.votes[within] / _FULL_SUPPORT, 0, 1)
        shares = number[blocks.block[shares]], holder, blocks.share[shares]
        labels = _labels(_Region(reader, own, shares, len(patches)), offsets, Links.of(ends, len(patches)), support)
        if labels is None:
            continue
        whole = labels[ends[0]] == labels[ends[1]]
        pieces = connected_parts(ends[:, whole], len(patches))
        roots[patches] = patches[pieces]
        own_offset = np.bincount(pieces[labels == 0], graph.pixels[patches][labels == 0], len(patches))
        main[region] = patches[own_offset.argmax()]
    return roots, main


class _Region:
    """What the blocks of a region show beside its factor."""

    def __init__(
        self, reader: CodeReader, own: Integers, held: tuple[Integers, Integers, FloatArray], patches: int
    ) -> None:
        blocks = reader.blocks
        self.best, self._patches = reader.read(own).best, patches
        level = reader.flattened(own, self.best, _AROUND)
        departs = level - reader.expected(own, blocks.order[own] + self.best)[0]
        usual = np.median(departs)
        sigma = np.sqrt(blocks.variance[own] + max(_MIN_SIGMA, robust_sigma(departs - usual)) ** 2)
        columns = reader.columns[own] / np.float32(reader.code.repeats_px)
        shares = held[0], held[1], _COUNTS * held[2]
        self._seen = shares, blocks.order[own], level - usual, sigma, columns, reader.levels_now

    def against(self, offsets: range) -> npt.NDArray[np.float32]:
        """Return (patches, offsets) by how much the blocks contradict each offset, in variances."""
        return weigh_offsets(*self._seen, offsets, self._patches, _MAX_DEVIATION)


def _held_by(owners: npt.NDArray[np.integer], regions: Integers) -> list[Integers]:
    """Return of each region, in the order of their numbers, the places at which it is the owner."""
    order = np.argsort(owners, kind="stable")
    firsts, lasts = (np.searchsorted(owners[order], regions, side) for side in ("left", "right"))
    return [order[first:last] for first, last in zip(firsts, lasts, strict=True)]


def _labels(region: _Region, offsets: range, links: Links, support: FloatArray) -> npt.NDArray[np.int32] | None:
    """Label a region's patches with the offsets that their blocks name, 0 for the region's own; None: all have that."""
    against_own = region.against(range(region.best, region.best + 1))
    if pool_evidence(against_own, links, support).max() <= _MIN_MARGIN:
        return None  # no other offset can be better by more
    evidence = region.against(offsets)
    patches, own = len(evidence), region.best - offsets.start
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
