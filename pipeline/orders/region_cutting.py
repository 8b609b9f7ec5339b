"""Cut regions where the code contradicts them: several surfaces were joined across steps of whole cycles.

A region is read as if it were one part (`code_evidence`), and what its surfaces have of their own is taken off. Where
the blocks in a window then show another offset, its patches are labelled with it
(`tikernels.order_evidence.offset_labelling`). Pieces that surely show an offset when they are read by themselves tell
what the region's surfaces have of their own, and the labels are found anew.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pipeline.contrast_code import CYCLES
from pipeline.models import FloatArray
from pipeline.orders.code_evidence import OF_CYCLE, CodeReader
from pipeline.orders.posterior import MAX_ABSOLUTE_ERROR, Integers, OrderRange
from pipeline.robust import robust_sigma
from tikernels.order_evidence.contrast_reading import BLOCKS
from tikernels.order_evidence.offset_labelling import (
    OffsetEvidence,
    connected_parts,
    pool_evidence,
    settle_labels,
    weigh_offsets,
)
from tikernels.order_evidence.offset_windows import Cells, find_other_offsets
from tikernels.unwrapping.patches import PatchGraph
from tikernels.unwrapping.tables import CELL_HEIGHT, CELL_WIDTH

# Blocks and rows of patches over which what is left of the factor is averaged: what is as large as these may be another
# surface.
_AROUND = (17, 5)
# Smallest standard deviation of a block's contrast: what its surface's factor may be off by. Blocks side by side
# deviate alike: each counts as this many.
_MIN_SIGMA, _COUNTS = 0.02, 0.5
# What a single block may deviate by from the code, in standard deviations: edges and blemishes deviate by more, and
# must not decide alone.
_MAX_DEVIATION = 3.0
# Regions of fewer pixels or blocks are too small to be parted.
_MIN_PARTED_PX, _MIN_BLOCKS = 600, 12
# Windows in which another offset is looked for, rows and columns of cells of 16 by 8 px: from two cycles, or three
# cells of the code, to large objects. By how much it must be better, in variances, and how many offsets a region may
# show. All blocks of a window may be off by so many standard deviations, as those of another paint are.
_WINDOWS = np.array([[2, 6], [3, 3], [9, 1], [4, 8], [8, 16], [16, 24]])
_LEAST, _CANDIDATES, _OFF_ALIKE = 10.0, 12, 2.0
# A contact of this support lets evidence pass undiminished.
_FULL_SUPPORT = 300
# What a difference of labels costs across a contact of full support, in variances, and the least share of it.
_LABEL_COST, _LEAST_SUPPORT = 3.0, 0.05
# How often a region is labelled anew at most: more often changes nothing before the hand of `films.py`.
_ROUNDS = 4


def cut_regions(
    reader: CodeReader, graph: PatchGraph, width: int, order_range: OrderRange | None = None
) -> tuple[npt.NDArray[np.int32], Integers]:
    """Cut pieces off regions that the code contradicts.

    Parameters
    ----------
    reader : CodeReader
        Of the frame's blocks.
    graph : PatchGraph
        The patches, joined to regions.
    width : int
        The image's, px.
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
        row, column = np.divmod(graph.first[patches], width)
        cells = Cells.of(row // CELL_HEIGHT, column // CELL_WIDTH)
        labels, pieces = _cut(reader, own, shares, offsets, cells, ends, support)
        is_own = labels == reader.read(own).best
        if is_own.all():
            continue
        roots[patches] = patches[pieces]
        main[region] = patches[np.bincount(pieces[is_own], graph.pixels[patches][is_own], len(patches)).argmax()]
    return roots, main


def _held_by(owners: npt.NDArray[np.integer], regions: Integers) -> list[Integers]:
    """Return of each region, in the order of their numbers, the places at which it is the owner."""
    order = np.argsort(owners, kind="stable")
    firsts, lasts = (np.searchsorted(owners[order], regions, side) for side in ("left", "right"))
    return [order[first:last] for first, last in zip(firsts, lasts, strict=True)]


def _cut(
    reader: CodeReader,
    own: Integers,
    held: tuple[Integers, Integers, FloatArray],
    offsets: range,
    cells: Cells,
    ends: Integers,
    support: FloatArray,
) -> tuple[Integers, Integers]:
    """Return the offset of each of a region's patches (P,), and its piece, by the smallest patch of that (P,).

    Where the region's offset is not a surface's, the code's own steps are taken off as if they were the factor's, and
    what is left shows any offset. Read by itself, a piece of that surface shows the right one. Only such offsets are
    looked for then, with the factor as it is where the patches have the offsets found last. What the first labels cut
    off, and no piece explains, stays apart.
    """
    best, count, holder = reader.read(own).best, len(cells.row), np.empty(len(own), np.int64)
    holder[held[0]] = held[1]

    def find(at: Integers, named: Integers) -> tuple[Integers, Integers]:
        shown = _shown(reader, own, at[holder], held, named, cells)
        labels = named[_labels(shown, ends, support)]
        return labels, connected_parts(ends[:, labels[ends[0]] == labels[ends[1]]], count)

    at = np.full(count, best)
    first, pieces = find(at, np.array(offsets))
    numbers = np.unique(pieces[first != best])
    for number, blocks in zip(numbers, _held_by(pieces[holder], numbers), strict=True):
        if len(blocks) >= _MIN_BLOCKS:
            # As the parts that pieces become are: either end may lie anywhere.
            alone = reader.read(own[blocks]).posterior(0.0, 2 * float(np.log(reader.cycles)), reader.trust)
            if alone.error(alone.best) < MAX_ABSOLUTE_ERROR:
                at[pieces == number] = alone.best
    named = np.union1d(at, best)
    for _ in range(_ROUNDS if len(named) > 1 else 0):
        before, (at, _) = at, find(at, named)
        if np.array_equal(before, at):
            break
    labels = np.where(at == best, first, at)
    return labels, connected_parts(ends[:, labels[ends[0]] == labels[ends[1]]], count)


class _Shown(NamedTuple):
    """The evidence of a region's patches for each of some offsets."""

    evidence: OffsetEvidence
    own: int  # number of the region's offset
    window: Integers  # (P,) number of the window or piece that shows another offset; -1: none
    named: Integers  # (K,) number of the offset that each of these shows, the surest first
    gain: npt.NDArray[np.float32]  # (K,) by how much that is better, in variances


def _shown(
    reader: CodeReader,
    own: Integers,
    at: Integers,
    held: tuple[Integers, Integers, FloatArray],
    offsets: Integers,
    cells: Cells,
) -> _Shown:
    """Weigh the blocks of a region against the code at some offsets, and look for others than the region's.

    The factor is taken off as it is where the blocks have the offsets `at` (n,).
    """
    blocks = reader.blocks
    level = reader.flattened(own, at, _AROUND)
    departs = level - reader.expected(own, blocks.order[own] + at)
    usual = np.median(departs)
    sigma = np.sqrt(blocks.variance[own] + max(_MIN_SIGMA, robust_sigma(departs - usual)) ** 2)
    columns = reader.columns[own] / np.float32(reader.code.repeats_px)
    shares = held[0], held[1], _COUNTS * held[2]
    code, patches, every = reader.levels_now, len(cells.row), range(int(offsets[0]), int(offsets[-1]) + 1)
    evidence = weigh_offsets(
        shares, blocks.order[own], level - usual, sigma, columns, code, every, patches, _MAX_DEVIATION
    )
    if len(offsets) < len(every):
        evidence = evidence.only(offsets - every.start)
    bright = np.log(blocks.brightness[own])[shares[0]]
    # Under the code of cycles all blocks of a cycle show the same.
    most_columns = np.inf if reader.code.cell_px is not None else OF_CYCLE / (_COUNTS * BLOCKS)
    number = int(np.searchsorted(offsets, reader.read(own).best))
    found = find_other_offsets(
        evidence,
        cells,
        np.asarray(np.bincount(shares[1], shares[2] * bright, patches), np.float64),
        number,
        _WINDOWS,
        most_columns=most_columns,
        common=_OFF_ALIKE**2,
        least=_LEAST,
    )
    return _Shown(evidence, number, *found)


def _labels(shown: _Shown, ends: Integers, support: FloatArray) -> Integers:
    """Label a region's patches with the numbers of the offsets that their blocks name.

    The border of a window costs at most half of what the window shows: a surface that is one patch wide has as many
    contacts with what is behind it as it has blocks.
    """
    if len(shown.named) == 0:
        return np.full(len(shown.window), shown.own)
    candidates = np.append(shown.own, list(dict.fromkeys(shown.named.tolist()))[:_CANDIDATES])
    alone = shown.evidence.of(candidates)
    first = pool_evidence(alone, ends, support).argmin(axis=1)
    by_window = np.append(shown.named, -1)[shown.window]
    for label, offset in enumerate(candidates[1:], start=1):
        first[by_window == offset] = label
    costs = _LABEL_COST * np.maximum(support, _LEAST_SUPPORT)
    border = by_window[ends[0]] != by_window[ends[1]]
    beside = shown.window[ends[:, border]]
    total = np.bincount(beside.ravel() + 1, np.tile(costs[border], 2), len(shown.named) + 1)
    share = np.append(1.0, np.minimum(1.0, shown.gain / (2 * np.maximum(total[1:], _LABEL_COST))))
    costs[border] *= share[beside + 1].min(axis=0)
    return np.asarray(candidates[settle_labels(alone, first, ends, costs)], np.int64)
