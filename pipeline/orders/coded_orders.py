"""Absolute orders of a single frame: the cycles of a coded pattern that its surfaces show.

The logarithm of the contrast is the code's but for a factor that changes slowly (`code_blocks`). Regions that the code
contradicts are cut (`region_cutting`). Every part gets a posterior over its offsets by what its blocks show
(`code_evidence`) and by where the rest of the frame is (`nearness`). Patches that lie on the wrong side of a border
move to the other one (`border_settling`). `docs/coded_pattern.md` has the derivation.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from pipeline.contrast_code import ContrastCode
from pipeline.orders.border_settling import SettledBorders, settle_borders
from pipeline.orders.code_blocks import read_blocks
from pipeline.orders.code_evidence import CodeReader, PartEvidence
from pipeline.orders.nearness import log_nearness, nearness
from pipeline.orders.posterior import (
    MAX_ABSOLUTE_ERROR,
    NOTHING_KNOWN,
    AbsoluteOrders,
    Integers,
    OrderRange,
    Posterior,
)
from pipeline.orders.region_cutting import cut_regions
from pipeline.orders.stripe_columns import StripeColumns
from tikernels.order_evidence.offset_labelling import connected_parts
from tikernels.unwrapping.patches import MIN_REGION_PX, PatchGraph

# How probably a piece that the labels have cut off, which is connected with its region, has that one's orders before
# its own blocks are read; and from which probability on it is no piece of its own.
_SAME_SURFACE = 0.9
# Which share of a part's pixels may have moved before the part is read anew.
_MOST_MOVED = 0.1


@dataclass(frozen=True)
class CodedOrders:
    """Orders that a frame's code determines."""

    roots: npt.NDArray[np.int32]  # (P,) the patch that represents each patch's part
    absolute: AbsoluteOrders  # the parts that are large enough, and their posteriors
    shifts: Integers  # (P,) whole cycles to add to the patches' orders so that they are their part's
    torn: npt.NDArray[np.bool_]  # (P,) patches that may belong to either of two parts
    readable: bool | None  # whether the frame shows the code where it is expected; None: too little of it to decide
    #: Shift along the stripe from its calibrated place, projector px; None: unknown.
    shift_px: float | None


def find_absolute_orders(
    sums: npt.NDArray[np.float32],
    graph: PatchGraph,
    code: ContrastCode,
    columns: StripeColumns | None,
    *,
    width: int,
    noise: float,
    order_range: OrderRange | None = None,
) -> CodedOrders:
    """Split regions where the code contradicts them, and place every part.

    Parameters
    ----------
    sums : (P, slots, BLOCKS, SUMS) float32
        The sums of `measure_contrast`.
    graph : PatchGraph
        The patches, joined to regions.
    code : ContrastCode
        The pattern's.
    columns : StripeColumns, optional
        Projector columns of places; a code that changes along the stripe needs them.
    width : int
        The image's, px.
    noise : float
        Standard deviation of a channel, levels.
    order_range : OrderRange, optional
        Bounds of the orders by other evidence.
    """
    blocks = read_blocks(sums, graph, width, noise)
    reader = CodeReader(blocks, code, columns)
    readable = reader.learn()
    elsewhere = None if reader.is_plain and not reader.is_far else reader.shift_anywhere()
    if readable and not reader.is_far and elsewhere is not None and code.cell_px is not None:
        elsewhere = elsewhere if abs(elsewhere - reader.shift_px) > code.cell_px else None  # it was found here
    if elsewhere is not None or readable is False or reader.is_far:
        return _unread(graph, order_range if elsewhere is None else None, elsewhere)

    def read_again(roots: npt.NDArray[np.int32]) -> CodeReader:
        anew = read_blocks(sums, graph._replace(root=roots), width, noise, blocks.ripple)
        return reader.again(CodeReader(anew, code, columns))

    roots, main = cut_regions(reader, graph, width, order_range)
    if (main >= 0).any():
        reader = read_again(roots)
    parts, read, posteriors = _placed(reader, graph, width, roots, main)
    rejoined = _rejoined(roots, main, graph, dict(zip(parts.tolist(), read, strict=True)), posteriors)
    if (rejoined != roots).any():
        reader, roots = read_again(rejoined), rejoined
        parts, read, posteriors = _placed(reader, graph, width, roots, main)
    lacks, errors = np.zeros(len(roots), np.int64), np.ones(len(roots))
    for part, posterior in zip(parts, posteriors, strict=True):
        lacks[part], errors[part] = posterior.best, posterior.error(posterior.best)
    settled = settle_borders(reader, graph, roots, lacks[roots], errors[roots])
    graph = graph._replace(offset=(graph.offset + settled.shifts).astype(np.int32))
    before, roots = roots, _cut_off(roots, settled.roots, graph)
    if _much_moved(before, roots, graph):
        standing = _standing(roots, graph)
        roots, main = standing[roots], np.where(main >= 0, standing[main], -1)
        parts, _, posteriors = _placed(read_again(roots), graph, width, roots, main)
    if order_range is not None:
        least, most = order_range.least - settled.shifts, order_range.most - settled.shifts
        ranges = replace(order_range, least=least, most=most).by_part(roots, parts, graph.pixels)
        posteriors = [
            within.narrow(posterior) if posterior is not NOTHING_KNOWN else within.alone()
            for within, posterior in zip(ranges, posteriors, strict=True)
        ]
    absolute = AbsoluteOrders(parts, tuple(posteriors))
    return CodedOrders(roots, absolute, settled.shifts, settled.torn, readable, reader.shift_px)


def _unread(graph: PatchGraph, order_range: OrderRange | None, elsewhere_px: float | None) -> CodedOrders:
    """Return what is known of regions whose code cannot be read: what the range leaves possible."""
    pixels = np.bincount(graph.root, graph.pixels, len(graph.root))
    parts = np.flatnonzero(pixels >= MIN_REGION_PX)
    posteriors = (NOTHING_KNOWN,) * len(parts)
    if order_range is not None:
        posteriors = tuple(within.alone() for within in order_range.by_part(graph.root, parts, graph.pixels))
    settled, absolute = SettledBorders.none(graph.root), AbsoluteOrders(parts, posteriors)
    return CodedOrders(graph.root, absolute, settled.shifts, settled.torn, readable=False, shift_px=elsewhere_px)


def _placed(
    reader: CodeReader, graph: PatchGraph, width: int, roots: npt.NDArray[np.int32], main: Integers
) -> tuple[Integers, list[PartEvidence], list[Posterior]]:
    """Return the parts that are large enough, the evidence of their blocks, and the posteriors of their offsets.

    A piece that was cut off is connected with its region: that, too, is known of its offset.
    """
    pixels = np.bincount(roots, graph.pixels, len(roots)).astype(np.int64)
    parts = np.flatnonzero(pixels >= MIN_REGION_PX)
    read = reader.read_all(parts)
    # A piece is free to choose where it begins and where it ends, and chance has as many ways to look like the code.
    origin = main[graph.root[parts]]
    ends = np.where(origin == parts, 1, 2)  # of what remains of the region the labels have found one
    luck = np.where(origin >= 0, ends * np.log(reader.cycles), 0.0)
    posteriors = [part.posterior(0.0, float(more), reader.trust) for part, more in zip(read, luck, strict=True)]
    sure = [k for k, found in enumerate(posteriors) if found.error(found.best) < MAX_ABSOLUTE_ERROR]
    if sure:
        # What these determine about the others.
        lacking = nearness(graph, roots, width, {int(parts[k]): posteriors[k].best for k in sure})
        for k, (part, of_region, seen) in enumerate(zip(parts, origin, read, strict=True)):
            if of_region in (-1, part):
                near = log_nearness(lacking[part], seen.first + np.arange(len(seen.likelihood)))
                posteriors[k] = seen.posterior(near, float(luck[k]), reader.trust)
    of_main = {int(part): posterior for part, posterior in zip(parts, posteriors, strict=True)}
    for k, part in enumerate(parts):
        region = of_main.get(int(origin[k]))
        if region is not None and origin[k] != part:
            certain = 1 - region.error(region.best)
            posteriors[k] = posteriors[k].beside(region.best, _SAME_SURFACE * certain)
    return parts, read, posteriors


def _much_moved(before: npt.NDArray[np.int32], roots: npt.NDArray[np.int32], graph: PatchGraph) -> bool:
    """Return whether so much of a part is now another one's, or its root is, that its posterior no longer holds."""
    moved = before != roots
    ends, px = np.append(before[moved], roots[moved]), np.tile(graph.pixels[moved], 2)
    much = np.bincount(ends, px, len(roots)) > _MOST_MOVED * np.bincount(before, graph.pixels, len(roots))
    return bool(much.any() or (roots[roots] != roots).any())


def _cut_off(before: npt.NDArray[np.int32], roots: npt.NDArray[np.int32], graph: PatchGraph) -> npt.NDArray[np.int32]:
    """Make parts of their own of pieces that were connected to their part only by patches that have moved, (P,) roots.

    Their orders followed from those of the moved patches.
    """
    stayed = before == roots
    if stayed.all():
        return roots
    number, (one, other) = np.arange(len(roots)), graph.ends
    inside = before[one] == before[other]
    whole = connected_parts(graph.ends[:, inside], len(roots))
    pieces = connected_parts(graph.ends[:, inside & stayed[one] & stayed[other]], len(roots))
    pixels = np.bincount(pieces, graph.pixels, len(roots))
    largest, by_size = number.copy(), np.argsort(pixels[pieces], kind="stable")
    largest[whole[by_size]] = pieces[by_size]
    last = number.copy()
    last[pieces] = number
    # A piece needs another name than its part's, of which it may hold the root.
    names = np.where(pieces == roots, last[pieces], pieces)
    return np.where(stayed & (pieces != largest[whole]), names, roots).astype(np.int32)


def _standing(roots: npt.NDArray[np.int32], graph: PatchGraph) -> npt.NDArray[np.int32]:
    """Return (P,) the patch that represents each part now: its root may have moved to another part."""
    standing = np.arange(len(roots), dtype=np.int32)
    for part in np.unique(roots[roots[roots] != roots]):
        held = np.flatnonzero(roots == part)
        standing[part] = held[np.argmax(graph.root[held] == graph.root[part])]
    return standing


def _rejoined(
    roots: npt.NDArray[np.int32],
    main: Integers,
    graph: PatchGraph,
    read: dict[int, PartEvidence],
    posteriors: list[Posterior],
) -> npt.NDArray[np.int32]:
    """Return the roots with those pieces put back that have their region's offset, by their own blocks or by all."""
    origin = main[graph.root]
    offset = dict(zip(read, posteriors, strict=True))
    back = np.zeros(len(roots), np.bool_)
    for part, posterior in offset.items():
        region = offset.get(int(origin[part]))
        if region is not None and (read[part].best == region.best or posterior.error(region.best) <= 1 - _SAME_SURFACE):
            back |= roots == part
    return np.where(back, origin, roots).astype(np.int32)
