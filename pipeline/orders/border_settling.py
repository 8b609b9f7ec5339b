"""Settle which part the patches along a border between two parts belong to.

Where two surfaces touch at a step of a whole cycle the phase continues from one to the other, and the cut between them
may be some patches off. The contrast determines on which side patches lie: not by its rise from cycle to cycle, of
which a patch shows one step or none, but by its level compared with the rest of its part. So do the borders: a clump of
patches is moved to the part next to it where contrast and borders together favour that. A patch at such a border is
torn, and omitted, if neither part is clearly the better one, or its contrast contradicts its own part's.

On 120 piles of objects (`tests/benchmarks/piles.py`) a quarter less is wrong and not flagged, of large ones before a
wall three quarters, and as much is right.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from pipeline.models import FloatArray
from pipeline.orders.code_evidence import CodeReader, Factor
from pipeline.orders.posterior import MAX_ABSOLUTE_ERROR, Integers
from pipeline.robust import robust_sigma
from tikernels.order_evidence.offset_labelling import connected_parts
from tikernels.unwrapping.patches import PatchGraph
from tikernels.unwrapping.surface_borders import Borders

# What all of a clump is off its part's factor, as a standard deviation (light from a surface close by changes that),
# and the smallest one of a block. A block may add as many variances, and counts as so many: those side by side deviate
# alike.
_CLUMP_SIGMA, _MIN_SIGMA, _MAX_DEVIATION, _COUNTS = 0.03, 0.012, 9.0, 0.5
# How often what a clump is off is fitted, each time with other weights.
_ROUNDS = 5
# Fewer blocks determine no level. A patch that shows less than this share of one shows none.
_MIN_BLOCKS, _MIN_SHOWN = 6, 0.6
# What a pixel costs, in units of the logarithm of the likelihood: over which the surface continues to another part, or
# to another order; and over which it steps inside a part. A clump is moved if that is better by this.
_GOING_ON_COST, _STEPPING_COST, _MIN_GAIN = 0.15, 0.225, 4.0
# Two parts continue into each other where they do over more pixels than the first; over a cell's side they surely do.
# Two orders are as good as each other where their logarithms differ by less than the third; a patch contradicts its
# part where it shows so many blocks, and its levels deviate by this many variances on average.
_SOME_PX, _SIDE_PX, _UNDECIDED, _WELL_SHOWN, _CONTRADICTS = 3.0, 8.0, 4.0, 1.6, 7.0
# Orders that differ by more are a border's that has been misread.
_MOST_CYCLES = 200
# A part takes patches if its own place is likelier than not.
_MOST_ERROR = 0.5


@dataclass(frozen=True)
class SettledBorders:
    """The parts that patches belong to."""

    roots: npt.NDArray[np.int32]  # (P,) the patch that represents each patch's part
    shifts: Integers  # (P,) whole cycles to add to the patches' orders so that they are their part's
    torn: npt.NDArray[np.bool_]  # (P,) patches that may belong to either of two parts

    @classmethod
    def none(cls, roots: npt.NDArray[np.int32]) -> "SettledBorders":
        """Return the borders unchanged."""
        return cls(roots, np.zeros(len(roots), np.int64), np.zeros(len(roots), np.bool_))


#: Absolute orders and parts of all patches, (P,) each.
_Placing: TypeAlias = tuple[npt.NDArray[np.integer], npt.NDArray[np.integer]]


class _Levels(NamedTuple):
    """The contrast of patches' blocks, less what a part predicts."""

    share: FloatArray  # (n,) how much each block counts in its patch
    departs: FloatArray  # (n,) standard deviations
    inside: npt.NDArray[np.bool_]  # (n,) whether the code has such a cycle
    sigma: FloatArray  # (n,) a standard deviation, natural logarithm; NaN: the part shows too little

    def of(self, which: Integers) -> "_Levels":
        """Return some of them (m,)."""
        return _Levels(self.share[which], self.departs[which], self.inside[which], self.sigma[which])

    def cost(self, common: float = 0.0) -> FloatArray:
        """Return (n,) half the squared deviation, in variances, where this much of it is common to all."""
        squares = np.minimum((self.departs - common) ** 2, _MAX_DEVIATION)
        return 0.5 * _COUNTS * self.share * np.where(self.inside, squares, _MAX_DEVIATION)

    def cost_together(self) -> float:
        """Return what speaks against blocks that may all be off the part's plane alike.

        A large clump is judged by how its levels rise from cycle to cycle, a small one by how high they are.
        """
        if len(self.share) == 0:
            return 0.0
        common, alike = float(np.median(self.departs)), self.sigma[0] / _CLUMP_SIGMA
        for _ in range(_ROUNDS):
            weights = _COUNTS * self.share * self.inside / np.maximum(1, np.abs(self.departs - common) / 1.5)
            common = float(weights @ self.departs / (weights.sum() + alike**2))
        return float(self.cost(common).sum() + 0.5 * (common * alike) ** 2)


class _Parts:
    """The level of each part's contrast."""

    def __init__(self, reader: CodeReader, lacks: Integers) -> None:
        blocks = reader.blocks
        self._reader = reader
        #: Of parts that show enough: the factor, and by how much their blocks scatter about it, natural logarithm.
        self.factors: dict[int, tuple[Factor, float]] = {}
        departs, sigma = np.zeros(len(blocks.order)), np.full(len(blocks.order), np.nan)
        parts = np.flatnonzero(np.bincount(blocks.root) >= _MIN_BLOCKS)
        for part, own in zip(parts.tolist(), reader.blocks_of(parts), strict=True):
            factor, departs[own] = reader.fit(own, int(lacks[part]))
            sigma[own] = max(robust_sigma(departs[own]), _MIN_SIGMA)
            self.factors[part] = factor, sigma[own[0]]
        inside, held = reader.has(np.arange(len(departs)), blocks.order + lacks[blocks.root]), blocks.block
        #: Of all blocks that patches hold, in their own parts.
        self.own = _Levels(blocks.share, (departs / sigma)[held], inside[held], sigma[held])

    def judge(self, patches: npt.NDArray[np.bool_], part: int, lacks: Integers) -> tuple[Integers, _Levels, FloatArray]:
        """Compare the levels of patches (P,) with those of another part, with these offsets (P,).

        Returns the numbers of the blocks that they hold (n,), their levels there, and by how much more speaks against
        that part than against their own (P,).
        """
        blocks, (factor, sigma) = self._reader.blocks, self.factors[part]
        held = np.flatnonzero(patches[blocks.patch])
        which, patch = blocks.block[held], blocks.patch[held]
        orders = blocks.order[which] + lacks[patch]
        departs = blocks.contrast[which] - self._reader.expected(which, orders)
        departs -= factor.at(blocks.place[which], blocks.brightness[which])
        inside = self._reader.has(which, orders)
        there = _Levels(blocks.share[held], departs / sigma, inside, np.full(len(held), sigma))
        against = np.bincount(patch, there.cost() - self.own.of(held).cost(), len(patches))
        return held, there, np.asarray(against, np.float64)


def settle_borders(
    reader: CodeReader,
    graph: PatchGraph,
    roots: npt.NDArray[np.int32],
    lacks: Integers,
    errors: FloatArray,
) -> SettledBorders:
    """Move clumps of patches to the part next to theirs where contrast and borders favour that, and find torn ones.

    Parameters
    ----------
    reader : CodeReader
        Of the blocks that the parts show.
    graph : PatchGraph
        Patches and borders.
    roots : (P,) int32
        The patch that represents each patch's part.
    lacks : (P,) int
        Whole cycles that the orders of the patches' parts lack to be absolute.
    errors : (P,) float
        Probability that they are wrong. A part that is probably misplaced takes no patches; orders that are not certain
        are flagged anyway, and their patches not torn.
    """
    borders, count = graph.borders, len(roots)
    if borders is None or not (borders.going_on[_apart(borders, roots)] >= _SOME_PX).any():
        return SettledBorders.none(roots)
    parts, blocks = _Parts(reader, lacks), reader.blocks
    own, shown = parts.own, np.bincount(blocks.patch, blocks.share, count)  # blocks of each patch
    orders, roots, torn = graph.offset + lacks, roots.copy(), np.zeros(count, np.bool_)
    for part, other, change, seeds in _going_on(borders, orders, roots, _SOME_PX):
        if errors[other] > _MOST_ERROR or not {part, other} <= parts.factors.keys():
            continue
        inside, lacking = roots == part, orders - graph.offset + change
        seeds = seeds[inside[seeds]]
        against = parts.judge(np.bincount(seeds, minlength=count) > 0, other, lacking)[2]
        seeds = seeds[(against[seeds] < 0) | (shown[seeds] < _MIN_SHOWN)]
        if len(seeds) == 0:  # the rest of the part is not checked
            continue
        held, there, against = parts.judge(inside, other, lacking)
        for clump in _clumps(graph, inside & ((against < 0) | (shown < _MIN_SHOWN)), seeds):
            then = np.where(clump, orders + change, orders), np.where(clump, other, roots)
            moved = np.flatnonzero(clump[blocks.patch[held]])
            gain = own.of(held[moved]).cost_together() - there.of(moved).cost_together()
            gain += _border_gain(borders, clump, (orders, roots), then)
            if gain > _MIN_GAIN and 2 * graph.pixels[clump].sum() < graph.pixels[inside].sum():
                (orders, roots), inside = then, inside & ~clump
                for before, after in zip(own, there.of(moved), strict=True):
                    before[held[moved]] = after
    for part, other, change, seeds in _going_on(borders, orders, roots, _SIDE_PX):
        if {part, other} <= parts.factors.keys():
            asked = np.bincount(seeds, minlength=count) > 0
            torn |= asked & (parts.judge(asked, other, orders - graph.offset + change)[2] < _UNDECIDED)
    touching = _apart(borders, roots) & (borders.going_on > _SOME_PX)
    beside = np.bincount(borders.ends[:, touching].ravel(), minlength=count) > 0
    contradicted = np.bincount(blocks.patch, own.cost(), count) > 0.5 * _CONTRADICTS * _COUNTS * shown
    torn |= beside & (shown > _WELL_SHOWN) & contradicted
    known = errors[roots] < MAX_ABSOLUTE_ERROR
    return SettledBorders(roots.astype(np.int32), orders - graph.offset - lacks[roots], torn & known)


def _apart(borders: Borders, roots: npt.NDArray[np.int32]) -> npt.NDArray[np.bool_]:
    """Return which borders lie between two parts."""
    return np.asarray(roots[borders.ends[0]] != roots[borders.ends[1]])


def _going_on(
    borders: Borders, orders: npt.NDArray[np.integer], roots: npt.NDArray[np.int32], least_px: float
) -> Iterator[tuple[int, int, int, Integers]]:
    """Find where parts continue into others at orders that are not theirs.

    Yields a part, the other one, by how many cycles the part's orders would change if it went on there, and its patches
    along such a border.
    """
    counts = borders.going_on >= least_px
    (low, high), shift = borders.ends[:, counts], borders.shift[counts]
    one, other = np.concatenate([low, high]), np.concatenate([high, low])
    change = orders[other] - np.concatenate([shift, -shift]) - orders[one]
    wrong = (roots[one] != roots[other]) & (change != 0) & (np.abs(change) < _MOST_CYCLES)
    one, other, change = one[wrong], other[wrong], change[wrong]
    # Sorted by a single number for each kind of border, which is quick.
    pair = roots[one].astype(np.int64) * len(roots) + roots[other]
    kind = pair * (2 * _MOST_CYCLES) + change
    sort = np.argsort(kind, kind="stable")
    for same in np.split(sort, np.flatnonzero(np.diff(kind[sort])) + 1) if len(sort) else []:
        yield int(roots[one[same[0]]]), int(roots[other[same[0]]]), int(change[same[0]]), one[same]


def _clumps(graph: PatchGraph, members: npt.NDArray[np.bool_], seeds: Integers) -> Iterator[npt.NDArray[np.bool_]]:
    """Find the connected clumps of members that contain a seed (seeds are members), (P,) bool each."""
    within = members[graph.ends[0]] & members[graph.ends[1]]
    pieces = connected_parts(graph.ends[:, within], len(members))
    for piece in np.unique(pieces[seeds]):
        yield members & (pieces == piece)


def _border_gain(borders: Borders, clump: npt.NDArray[np.bool_], before: _Placing, then: _Placing) -> float:
    """Return by how much less the borders of a clump's patches cost then than before."""
    touching = np.flatnonzero(clump[borders.ends[0]] | clump[borders.ends[1]])
    (low, high), shift = borders.ends[:, touching], borders.shift[touching]
    wholly, apart = _STEPPING_COST * borders.stepping[touching], _GOING_ON_COST * borders.going_on[touching]
    costs = [
        np.where((roots[low] == roots[high]) & (orders[high] - orders[low] == shift), wholly, apart).sum()
        for orders, roots in (before, then)
    ]
    return float(costs[0] - costs[1])
