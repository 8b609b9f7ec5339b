"""Settle which part the patches along a border between two parts belong to.

Where two surfaces touch at a step of a whole cycle the phase goes on from one to the other, and the cut between them
may lie some patches off. The contrast tells on which side patches lie: not by how it rises from cycle to cycle, of
which a patch shows one step or none, but by how high it is beside the rest of its part. So do the borders: a clump of
patches is moved to the part beside it where contrast and borders together favour that. A patch at such a border is
torn, and left out, if neither part is clearly the better one, or its contrast contradicts its own part's.

On 120 piles of objects (`tests/benchmarks/piles.py`) a quarter less is wrong and not flagged, of large ones before a
wall three quarters, and as much is right.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

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
# Fewer blocks tell no level. A patch that shows less than this share of one shows none.
_MIN_BLOCKS, _MIN_SHOWN = 6, 0.6
# What a pixel costs, in units of the logarithm of the likelihood: over which the surface goes on to another part, or to
# another order; and over which it steps inside a part. A clump is moved if that is better by this.
_GOING_ON_COST, _STEPPING_COST, _MIN_GAIN = 0.15, 0.225, 4.0
# Two parts go on where they do over more pixels than the first; over a cell's side they surely do. Two orders are as
# good as each other where their logarithms differ by less than the third; a patch contradicts its part where it shows
# so many blocks, and its levels deviate by this many variances on average.
_SOME_PX, _SIDE_PX, _UNDECIDED, _WELL_SHOWN, _CONTRADICTS = 3.0, 8.0, 4.0, 1.6, 7.0
# Orders that differ by more are a border's that has been misread.
_MOST_CYCLES = 200
# A part takes patches if its own place is likelier than not.
_MOST_ERROR = 0.5


@dataclass(frozen=True)
class SettledBorders:
    """Where the patches belong."""

    roots: npt.NDArray[np.int32]  # (P,) the patch that stands for each patch's part
    shifts: Integers  # (P,) whole cycles to add to the patches' orders so that they are their part's
    torn: npt.NDArray[np.bool_]  # (P,) patches that may belong to either of two parts

    @classmethod
    def none(cls, roots: npt.NDArray[np.int32]) -> "SettledBorders":
        """Return borders of which nothing tells more."""
        return cls(roots, np.zeros(len(roots), np.int64), np.zeros(len(roots), np.bool_))


class _Levels(NamedTuple):
    """The contrast of some blocks, less what their part predicts."""

    held: Integers  # (n,) which of the blocks' shares
    share: FloatArray  # (n,) how much each counts
    departs: FloatArray  # (n,) standard deviations
    inside: npt.NDArray[np.bool_]  # (n,) whether the code has such a cycle
    sigma: float  # a standard deviation, natural logarithm

    def cost(self, common: float) -> FloatArray:
        """Return (n,) squared deviations, in variances, where this much of them is common to all."""
        squares = np.minimum((self.departs - common) ** 2, _MAX_DEVIATION)
        return np.asarray(np.where(self.inside, squares, _MAX_DEVIATION))


class _LevelCosts:
    """What the contrast says against the patches' belonging to a part."""

    def __init__(self, reader: CodeReader, roots: npt.NDArray[np.int32], lacks: Integers) -> None:
        self._reader, self._blocks, self._roots, self._lacks = reader, reader.blocks, roots, lacks
        self._fits: dict[int, tuple[Factor, float]] = {}
        self._silent: set[int] = set()
        #: (P,) how many blocks each patch shows.
        self.shown = np.bincount(self._blocks.patch, self._blocks.share, len(roots))

    def known(self, part: int) -> bool:
        """Whether a part shows how high its contrast is; measured when it is asked for the first time."""
        if part not in self._fits and part not in self._silent:
            own = np.flatnonzero(self._blocks.root == part)
            if len(own) >= _MIN_BLOCKS:
                self._fits[part] = self._fitted(own, self._lacks[part])
            else:
                self._silent.add(part)
        return part in self._fits

    def _fitted(self, own: Integers, lacks: int) -> tuple[Factor, float]:
        """Fit a part's factor to its blocks, and return by how much they scatter about it."""
        factor = self._reader.fit(own, int(lacks))
        departs, _ = self._departs(factor, own, np.full(len(own), lacks))
        return factor, max(robust_sigma(departs), _MIN_SIGMA)

    def _departs(self, factor: Factor, which: Integers, lacks: Integers) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
        """Return (n,) what is left of blocks' contrasts, and whether the code has such cycles."""
        blocks = self._blocks
        expected, inside = self._reader.expected(which, blocks.order[which] + lacks)
        usual = factor.at(blocks.place[which], blocks.brightness[which])
        return blocks.contrast[which] - expected - usual, inside

    def against(self, part: int, patches: npt.NDArray[np.bool_], lacks: Integers) -> FloatArray:
        """Return (P,) half the squared deviation, in variances, of these patches' levels from a part's."""
        levels = self._levels(part, patches, lacks)
        weights = 0.5 * levels.share * levels.cost(0.0)
        return np.asarray(np.bincount(self._blocks.patch[levels.held], weights, len(patches)), np.float64)

    def against_together(self, part: int, clump: npt.NDArray[np.bool_], lacks: Integers) -> float:
        """Return the same of a clump of patches, (P,) bool, which may all be off the part's plane alike.

        A large clump is judged by how its levels rise from cycle to cycle, a small one by how high they are.
        """
        levels = self._levels(part, clump, lacks)
        common = float(np.median(levels.departs)) if len(levels.departs) else 0.0
        for _ in range(_ROUNDS):
            weights = levels.share * levels.inside / np.maximum(1, np.abs(levels.departs - common) / 1.5)
            common = float(weights @ levels.departs / (weights.sum() + (levels.sigma / _CLUMP_SIGMA) ** 2))
        off = common * levels.sigma / _CLUMP_SIGMA
        return float(0.5 * (levels.share @ levels.cost(common) + off**2))

    def _levels(self, part: int, patches: npt.NDArray[np.bool_], lacks: Integers) -> _Levels:
        factor, sigma = self._fits[part]
        held = np.flatnonzero(patches[self._blocks.patch])
        departs, inside = self._departs(factor, self._blocks.block[held], lacks[self._blocks.patch[held]])
        return _Levels(held, _COUNTS * self._blocks.share[held], departs / sigma, inside, sigma)


def settle_borders(
    reader: CodeReader,
    graph: PatchGraph,
    roots: npt.NDArray[np.int32],
    lacks: Integers,
    errors: FloatArray,
) -> SettledBorders:
    """Move clumps of patches to the part beside theirs where contrast and borders favour that, and find torn ones.

    Parameters
    ----------
    reader : CodeReader
        Of the blocks that the parts show.
    graph : PatchGraph
        Patches and borders.
    roots : (P,) int32
        The patch that stands for each patch's part.
    lacks : (P,) int
        Whole cycles that the orders of the patches' parts lack to be absolute.
    errors : (P,) float
        How probably that is wrong. A part that is probably misplaced takes no patches; orders that are not
        certain are flagged anyway, and their patches not torn.
    """
    if graph.borders is None:
        return SettledBorders.none(roots)
    torn = np.zeros(len(roots), np.bool_)
    borders, costs = graph.borders, _LevelCosts(reader, roots, lacks)
    roots, now = roots.copy(), lacks.astype(np.int64)
    for part, other, change, seeds in _going_on(borders, graph.offset + now, roots, _SOME_PX):
        if errors[other] > _MOST_ERROR or not (costs.known(part) and costs.known(other)):
            continue
        inside = roots == part
        prefers = costs.against(other, inside, now + change) - costs.against(part, inside, now)
        members = inside & ((prefers < 0) | (costs.shown < _MIN_SHOWN))
        for clump in _clumps(graph, members, seeds):
            then = np.where(clump, other, roots), np.where(clump, now + change, now)
            gain = _border_cost(borders, clump, graph.offset + now, roots)
            gain -= _border_cost(borders, clump, graph.offset + then[1], then[0])
            gain += costs.against_together(part, clump, now) - costs.against_together(other, clump, now + change)
            if gain > _MIN_GAIN and 2 * graph.pixels[clump].sum() < graph.pixels[inside].sum():
                roots, now = then
                inside = inside & ~clump
    known = errors[roots] < MAX_ABSOLUTE_ERROR
    for part, other, change, seeds in _going_on(borders, graph.offset + now, roots, _SIDE_PX):
        if costs.known(part) and costs.known(other):
            asked = np.zeros(len(roots), np.bool_)
            asked[seeds] = True
            prefers = costs.against(other, asked, now + change) - costs.against(part, asked, now)
            torn |= asked & (prefers < _UNDECIDED)
    touching = (roots[borders.ends[0]] != roots[borders.ends[1]]) & (borders.going_on > _SOME_PX)
    beside = np.zeros(len(roots), np.bool_)
    beside[borders.ends[:, touching]] = True
    beside &= costs.shown > _WELL_SHOWN
    for part in np.unique(roots[beside]):
        if costs.known(part):
            asked = beside & (roots == part)
            torn |= asked & (costs.against(part, asked, now) > 0.5 * _CONTRADICTS * _COUNTS * costs.shown)
    return SettledBorders(roots.astype(np.int32), now - lacks[roots], torn & known)


def _going_on(
    borders: Borders, orders: npt.NDArray[np.integer], roots: npt.NDArray[np.int32], least_px: float
) -> Iterator[tuple[int, int, int, Integers]]:
    """Find where parts go on to others at orders that are not theirs.

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
        yield int(roots[one[same[0]]]), int(roots[other[same[0]]]), int(change[same[0]]), np.unique(one[same])


def _clumps(graph: PatchGraph, members: npt.NDArray[np.bool_], seeds: Integers) -> Iterator[npt.NDArray[np.bool_]]:
    """Find the clumps of members that hang together and hold a seed, (P,) bool each."""
    seeds = seeds[members[seeds]]
    if len(seeds) == 0:
        return
    within = members[graph.ends[0]] & members[graph.ends[1]]
    pieces = connected_parts(graph.ends[:, within], len(members))
    for piece in np.unique(pieces[seeds]):
        yield members & (pieces == piece)


def _border_cost(
    borders: Borders, clump: npt.NDArray[np.bool_], orders: npt.NDArray[np.integer], roots: npt.NDArray[np.integer]
) -> float:
    """Return what the borders of a clump's patches cost, with these absolute orders and parts."""
    touching = clump[borders.ends[0]] | clump[borders.ends[1]]
    low, high = borders.ends[:, touching]
    whole = (roots[low] == roots[high]) & (orders[high] - orders[low] == borders.shift[touching])
    px = np.where(whole, _STEPPING_COST * borders.stepping[touching], _GOING_ON_COST * borders.going_on[touching])
    return float(px.sum())
