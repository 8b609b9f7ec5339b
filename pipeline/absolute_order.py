"""Which cycle of a coded pattern a surface shows: the orders of a single frame, absolute.

The logarithm of the contrast steps from cycle to cycle as the code says, but for a factor that changes slowly and falls
out of the steps. Six cycles in a row name their place in the sequence: many such stretches vote, patches that the votes
tell apart are not joined (`tikernels.absolute_order`), and every part that is left gets a posterior over its offsets.
`docs/coded_pattern.md` has the derivation.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.contrast_code import CYCLES, contrast_steps
from tikernels.absolute_order import (
    BACKGROUND,
    CANDIDATES,
    MODULATION,
    PHASE,
    SLOPE_REACH,
    SLOTS,
    TOTAL,
    join_parts_kernel,
)
from tikernels.patches import CELL_HEIGHT, CELL_WIDTH
from tikernels.unwrapping import MIN_REGION_PX, PatchGraph

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

#: An order is absolute where it is wrong with a smaller probability than this.
MAX_ERROR_PROBABILITY = 1e-3
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
# A cycle counts from this weight on (a full one of 12 px has 13 in a patch's columns), and if it is whole: its pixels'
# mean phase (rad) is near its middle's.
_MIN_WEIGHT, _MAX_MEAN_PHASE = 3.0, 0.3
# A single step departs from the code by no more than three standard deviations' worth: edges and blemishes do.
_MAX_DEPARTURE = 9.0
# Where steps depart by more than this on average, none of the offsets that stretches have named is the right one.
_NOWHERE = 5.5
# A stretch votes if it fits, and if the next best place is less likely by exp(-5).
_MIN_LEAD = 10.0
_MIN_VOTES = 3
# A region of whose stretches so many agree on the offset is whole.
_AGREED = 0.98
# Offsets with less than this share of a region's votes are chance, or too small a part to keep others from joining.
_MIN_SHARE = 0.02
# Two parts stay apart if both show five cycles and prefer different offsets by so much, in all and for each step: the
# steps of one cycle share their errors, so many of them are worth little more than one.
_MIN_SPAN, _MIN_MARGIN, _MARGIN_A_STEP = 4, 60.0, 1.5
# Steps of the same two cycles that are worth one without their common error.
_ALIKE = 1.0
# Tails of a Student distribution: some cycles are spoiled by edges.
_FREEDOM = 4.0
# Blur and ambient light change the strength of the steps from part to part.
_STRENGTHS = (0.85, 1.0, 1.18)
# An order may lie outside the depth range's by so many cycles: half of one for rounding, the rest for the calibration.
_SLACK = 0.75
# Where the phase bends by more (rad) within a cycle, the surface does.
_MAX_BEND = 0.3
# Share of a part's cycles that must fit within three standard deviations.
_MIN_FIT = 0.6


@dataclass(frozen=True)
class _Steps:
    """By how much the logarithm of the contrast rises from one cycle to the next, patch by patch."""

    low: Integers  # (N,) patch that holds most of the lower cycle
    high: Integers  # (N,) and of the higher one
    order: Integers  # (N,) the lower cycle's order in its region
    rise: Floats  # (N,)
    place: Integers  # (N,) steps that follow each other down a column of patches are numbered one by one
    rising: bool  # whether the orders grow with the rows


@dataclass(frozen=True)
class AbsoluteOrders:
    """What the code says of a frame's parts."""

    strength: float  # of the code's steps in the frame; 1 where light is proportional to the codes
    roots: npt.NDArray[np.int32]  # (P,) the patch that stands for each patch's part
    parts: Integers  # (n,) the roots of the parts that are large enough
    offsets: Integers  # (n,) whole cycles to add to a part's orders to make them absolute
    absolute: npt.NDArray[np.bool_]  # (n,) whether that is beyond doubt
    posterior: tuple[dict[int, float], ...]  # by part: probability of each offset above 1e-9

    @property
    def readable(self) -> bool:
        """Whether the frame shows the code at all."""
        return self.strength >= _MIN_STRENGTH

    def error_probability(self, orders: Integers) -> Floats:
        """Return how probably these offsets of the parts are wrong."""
        return np.array([1.0 - p.get(int(k), 0.0) for p, k in zip(self.posterior, orders, strict=True)])


def find_absolute_orders(
    sums: npt.NDArray[np.float32],
    graph: PatchGraph,
    width: int,
    rising: bool,
    bounds: Floats | None = None,
) -> AbsoluteOrders:
    """Split regions where the code contradicts them, and place every part.

    Parameters
    ----------
    sums : (P, SLOTS, 4) float32
        What `measure_contrast_kernel` summed.
    graph : PatchGraph
        The patches, joined to regions.
    width : int
        The image's, px.
    rising : bool
        Whether the orders grow with the rows.
    bounds : (P, 2) float64, optional
        Smallest and largest absolute phase that the first pixel of each patch may have, in cycles.

    Returns
    -------
    AbsoluteOrders
        Parts, their offsets and posteriors.
    """
    steps = _contrast_steps(sums, graph, width, rising)
    code = contrast_steps()
    strength = float(np.sqrt(np.mean(steps.rise**2) / np.mean(code**2))) if len(steps.rise) else 0.0
    roots, sigma = graph.root, _MIN_SIGMA
    if strength >= _MIN_STRENGTH:
        stretches = _stretches(steps)
        offsets, sigma, strength = _local_offsets(steps, stretches, strength)
        roots = _split(steps, graph, stretches, offsets, strength, sigma)
    sizes = np.bincount(roots, graph.pixels, len(roots))
    parts = np.flatnonzero(sizes >= MIN_REGION_PX)
    found: list[tuple[int, bool, dict[int, float]]] = []
    order_of_part = np.argsort(roots[steps.low], kind="stable")
    starts = np.searchsorted(roots[steps.low][order_of_part], parts)
    stops = np.searchsorted(roots[steps.low][order_of_part], parts, side="right")
    for part, start, stop in zip(parts, starts, stops, strict=True):
        own = order_of_part[start:stop]
        own = own[roots[steps.high[own]] == part]
        within = None
        if bounds is not None:
            own_bounds = (bounds - graph.offset[:, None])[roots == part]
            within = np.median(own_bounds, axis=0) + _SLACK * np.array([-1.0, 1.0])
        if strength < _MIN_STRENGTH or len(own) == 0:
            found.append((0, False, {}))
        else:
            found.append(_posterior(steps.order[own], steps.rise[own], strength, sigma, within))
    return AbsoluteOrders(
        strength,
        roots,
        parts,
        np.array([offset for offset, _, _ in found], np.int64),
        np.array([absolute for _, absolute, _ in found], np.bool_),
        tuple(posterior for _, _, posterior in found),
    )


def _contrast_steps(sums: npt.NDArray[np.float32], graph: PatchGraph, width: int, rising: bool) -> _Steps:
    """Put the cycles of every column of patches in a row and take the steps between whole ones."""
    patch, slot = np.nonzero(sums[..., TOTAL] > 0)
    values = sums[patch, slot].astype(np.float64)
    order = graph.offset[patch].astype(np.int64) + slot - SLOTS // 2
    root, first = graph.root[patch], graph.first[patch]
    column, row = first % width // CELL_WIDTH, first // width // CELL_HEIGHT
    sign = 1 if rising else -1
    sort = np.lexsort((sign * order, row, column, root))
    patch, order, root = patch[sort], order[sort], root[sort]
    column, row, values = column[sort], row[sort], values[sort]
    # A cycle that a cell's border cuts is put together again.
    fresh = np.ones(len(patch), np.bool_)
    fresh[1:] = (np.diff(root) != 0) | (np.diff(column) != 0) | (np.diff(order) != 0) | (np.diff(row) > 1)
    start = np.flatnonzero(fresh)
    last = np.append(start[1:], len(patch)) - 1
    if len(start) == 0:
        nothing = np.zeros(0, np.int64)
        return _Steps(nothing, nothing, nothing, np.zeros(0), nothing, rising)
    cycles = np.add.reduceat(values, start, axis=0)
    whole = cycles[:, TOTAL] >= _MIN_WEIGHT
    whole &= np.abs(cycles[:, PHASE]) < _MAX_MEAN_PHASE * cycles[:, TOTAL]
    whole &= np.minimum(cycles[:, MODULATION], cycles[:, BACKGROUND]) > 0
    contrast = np.log(np.where(whole, cycles[:, MODULATION], 1.0) / np.where(whole, cycles[:, BACKGROUND], 1.0))
    upper, lower = start[:-1], start[1:]
    follows = whole[:-1] & whole[1:] & (order[lower] - order[upper] == sign)
    follows &= (root[lower] == root[upper]) & (column[lower] == column[upper]) & (row[lower] - row[last[:-1]] <= 1)
    place = np.flatnonzero(follows)
    low, high = start[place + (not rising)], start[place + rising]
    rise = contrast[place + rising] - contrast[place + (not rising)]
    return _Steps(patch[low], patch[high], order[low].astype(np.int64), rise, place, rising)


def _stretches(steps: _Steps) -> Integers:
    """Return the (n, 5) steps of every six cycles in a row, from the lowest order."""
    starts = np.arange(0, max(len(steps.place) - _STRETCH + 1, 0), _EVERY)
    starts = starts[steps.place[starts + _STRETCH - 1] - steps.place[starts] == _STRETCH - 1]
    stretches: Integers = starts[:, None] + np.arange(_STRETCH)
    return stretches if steps.rising else stretches[:, ::-1]


def _local_offsets(steps: _Steps, stretches: Integers, strength: float) -> tuple[Integers, float, float]:
    """Place every stretch by itself.

    Returns
    -------
    offsets : (n,) int64
        What its orders lack to be absolute; where it cannot tell, a number below any offset.
    sigma : float
        Standard deviation of a step.
    strength : float
        Of the code's steps.
    """
    if len(stretches) == 0:
        return np.zeros(0, np.int64), _MIN_SIGMA, strength
    # What all five steps have in common may be the contrast's own slow change.
    common = 1 - 1 / np.sqrt(1 + _STRETCH * (_DRIFT / _MIN_SIGMA) ** 2)
    without = np.eye(_STRETCH) - common / _STRETCH
    windows = np.lib.stride_tricks.sliding_window_view(contrast_steps(), _STRETCH) @ without
    seen = steps.rise[stretches] @ without
    own = (seen**2).sum(axis=1)
    # Single precision tells a ten-thousandth of a step.
    departure = seen.astype(np.float32) @ (-2 * strength * windows.T).astype(np.float32)
    departure += (strength**2 * (windows**2).sum(axis=1)).astype(np.float32)
    rows = np.arange(len(stretches))
    best = departure.argmin(axis=1)
    least = own + departure[rows, best]
    departure[rows, best] = np.inf
    second = own + departure.min(axis=1)
    clear = least < 0.25 * second
    sigma = _MIN_SIGMA
    if clear.any():
        expected = windows[best[clear]]
        factor = (seen[clear] * expected).sum(axis=1) / np.maximum((expected**2).sum(axis=1), 1e-12)
        strength = float(np.median(factor))
        remaining = ((seen[clear] - strength * expected) ** 2).mean(axis=1)
        sigma = max(sigma, 1.7 * float(np.sqrt(np.median(remaining))))
    sure = (least < _STRETCH * _MAX_DEPARTURE * sigma**2) & (second - least > _MIN_LEAD * sigma**2)
    return np.where(sure, best - steps.order[stretches[:, 0]], -2 * CYCLES), sigma, strength


def _split(
    steps: _Steps, graph: PatchGraph, stretches: Integers, offsets: Integers, strength: float, sigma: float
) -> npt.NDArray[np.int32]:
    """Return the root of every patch's part: regions whose stretches agree stay whole."""
    sure = offsets > -CYCLES
    owner = graph.root[steps.low[stretches[sure, 0]]] if len(stretches) else np.zeros(0, np.int32)
    ballots = _ballots(owner, offsets[sure])
    ballot, votes = np.unique(ballots, return_counts=True)
    ballot, votes = ballot[votes >= _MIN_VOTES], votes[votes >= _MIN_VOTES]
    named = _counted(ballot)
    everything = np.bincount(graph.root[steps.low[stretches[:, 0]]], minlength=len(graph.root))
    agreeing = np.zeros(len(graph.root))
    np.maximum.at(agreeing, named[0], votes)
    torn = np.unique(named[0, agreeing[named[0]] < _AGREED * everything[named[0]]])
    if len(torn) == 0:
        return graph.root
    evidence = np.zeros((len(graph.root), CANDIDATES + 1))
    code = contrast_steps()
    for root in torn:
        mine = named[0] == root
        candidates = named[1, mine][np.argsort(-votes[mine], kind="stable")][: CANDIDATES - 1]
        own = np.flatnonzero(graph.root[steps.low] == root)
        place = steps.order[own, None] + candidates
        inside = (place >= 0) & (place < len(code))
        departure = (steps.rise[own, None] - strength * code[np.clip(place, 0, len(code) - 1)]) ** 2 / sigma**2
        departure = np.where(inside, np.minimum(departure, _MAX_DEPARTURE), _MAX_DEPARTURE)
        padding = np.full((len(own), CANDIDATES - 1 - len(candidates)), _MAX_DEPARTURE)
        nowhere = np.full((len(own), 1), _NOWHERE)
        terms = np.concatenate([departure, padding, nowhere, np.ones((len(own), 1))], axis=1)
        # A step belongs to the patches of both its cycles.
        for end in (steps.low[own], steps.high[own]):
            for k in range(CANDIDATES + 1):
                evidence[:, k] += 0.5 * np.bincount(end, terms[:, k], len(evidence))
    orders = np.tile(np.array([2**20, -(2**20)], np.int32), (len(graph.root), 1))
    for end in (steps.low, steps.high):
        np.minimum.at(orders[:, 0], end, steps.order)
        np.maximum.at(orders[:, 1], end, steps.order + 1)
    inside = np.isin(graph.root, torn)[graph.ends[0]]
    ends, weight = graph.ends[:, inside], graph.votes[inside]
    # Votes within a fifth count alike, and chance decides between them: parts then grow round, not in rows.
    shuffled = (np.arange(len(weight), dtype=np.uint32) * np.uint32(2654435769)).astype(np.int64)
    # Contacts between patches that stretches place differently come last, when their parts know where they are.
    common = votes >= _MIN_SHARE * np.bincount(named[0], votes)[named[0]]
    trusted = np.isin(ballots, ballot[common])
    named_a, named_b = _named_offsets(steps, stretches[sure][trusted], offsets[sure][trusted], len(graph.root))[ends]
    differ = (named_a != named_b) & (np.minimum(named_a, named_b) > -CYCLES)
    sort = np.lexsort((shuffled, -np.floor(4 * np.log2(np.maximum(weight, 1))), differ))
    parents = np.zeros(len(graph.root), np.int32)
    if len(sort):
        join_parts_kernel(
            np.ascontiguousarray(ends[:, sort]),
            _MIN_SPAN,
            _MIN_MARGIN,
            _MARGIN_A_STEP,
            orders,
            evidence.astype(np.float32),
            parents,
        )
    return np.where(np.isin(graph.root, torn), parents, graph.root).astype(np.int32)


def _ballots(voters: npt.NDArray[np.integer], offsets: Integers) -> Integers:
    """Return voter and offset as one number."""
    return np.asarray(voters.astype(np.int64) * (4 * CYCLES) + offsets + 2 * CYCLES)


def _counted(ballots: Integers) -> Integers:
    """Return the (2, n) voters and offsets of ballots."""
    return np.stack([ballots // (4 * CYCLES), ballots % (4 * CYCLES) - 2 * CYCLES])


def _named_offsets(steps: _Steps, stretches: Integers, offsets: Integers, patches: int) -> Integers:
    """Return the offset that most of the stretches through a patch have; a number below any where there are none.

    The first and the last cycle of a stretch may lie beyond a step and still pass: only the others name their patches.
    """
    through = steps.low[stretches[:, 1:]]
    ballots, count = np.unique(_ballots(through.ravel(), np.repeat(offsets, through.shape[1])), return_counts=True)
    patch, offset = _counted(ballots)
    sort = np.lexsort((offset, count, patch))
    named = np.full(patches, -2 * CYCLES)
    named[patch[sort]] = offset[sort]  # the last of a patch is the commonest
    return named


def _posterior(
    order: Integers, rise: Floats, strength: float, sigma: float, within: Floats | None
) -> tuple[int, bool, dict[int, float]]:
    """Return a part's likeliest offset, whether it is beyond doubt, and the probability of every offset."""
    code = contrast_steps()
    levels, inverse, counts = np.unique(order, return_inverse=True, return_counts=True)
    sort = np.lexsort((rise, inverse))
    middle = rise[sort][np.cumsum(counts) - (counts + 1) // 2]
    weight = np.minimum(counts / _ALIKE, 1.0)
    offsets = np.arange(-levels[0], len(code) - levels[-1])
    if len(offsets) == 0:
        return 0, False, {}
    expected = code[levels + offsets[:, None]]
    # The slow change of the contrast, as a straight line that is expected to be flat.
    line = np.stack([np.ones(len(levels)), np.linspace(-1, 1, len(levels))])
    stiff = line.T @ np.linalg.solve(line @ line.T + (sigma / _DRIFT) ** 2 * np.eye(2), line)
    departures = [middle - s * strength * expected for s in _STRENGTHS]
    departures = [departure - departure @ stiff for departure in departures]
    likelihoods = [
        -0.5 * (_FREEDOM + 1) * np.log1p(departure**2 / (_FREEDOM * sigma**2)) @ weight for departure in departures
    ]
    logarithm = np.logaddexp.reduce(likelihoods, axis=0)
    if within is not None:
        logarithm[(offsets < within[0]) | (offsets > within[1])] = -np.inf
        if np.isneginf(logarithm).all():
            return 0, False, {}
    probability = np.exp(logarithm - logarithm.max())
    probability /= probability.sum()
    best = int(probability.argmax())
    departure = departures[int(np.argmax([likelihood[best] for likelihood in likelihoods]))][best]
    fit = float(weight @ (np.abs(departure) < 3 * sigma) / weight.sum())
    sure = bool(probability.sum() - probability[best] < MAX_ERROR_PROBABILITY and fit >= _MIN_FIT)
    kept = np.flatnonzero(probability > 1e-9)
    return int(offsets[best]), sure, {int(offsets[i]): float(probability[i]) for i in kept}


def blur_shift(
    unwrapped: npt.NDArray[np.float32],
    region: npt.NDArray[np.int32],
    absolute: npt.NDArray[np.bool_],
    departures: npt.NDArray[np.float32],
    period_px: float,
) -> float:
    """Return how far blur shifts the phase where the modulation rises e-fold a cycle, rad.

    Blur weakens the fringe's upper sideband more than its lower one, which turns a change of the modulation into one of
    the phase: by (2 pi s)^2 / (2 pi) of its logarithm's slope, for a Gaussian of s cycles.

    Parameters
    ----------
    unwrapped : (H, n) float32
        rad, absolute; columns of the image.
    region : (H, n) int32
        Number of each pixel's region; 0 outside.
    absolute : (regions + 1,) bool
        Whether a region's orders are absolute.
    departures : (cycles,) float32
        Modulation of each cycle, less the usual one, as a fraction of it.
    period_px : float
        Rows a cycle.

    Returns
    -------
    float
        rad; 0 where nothing tells.
    """
    half = max(1, round(period_px / 2))
    # Every fourth row tells enough.
    middle, above, below = (region[half:-half:4], region[: -2 * half : 4], region[2 * half :: 4])
    inside = (middle > 0) & (middle == above) & (middle == below) & absolute[middle]
    if not inside.any():
        return 0.0
    rows, columns = np.nonzero(inside)
    phases = [unwrapped[4 * rows + offset, columns].astype(np.float64) for offset in (0, half, 2 * half)]
    indices = np.arange(len(departures))
    slopes = []
    for phase in phases:
        cycles = phase / (2 * np.pi)
        low, here, high = (np.interp(cycles + reach, indices, departures) for reach in (-SLOPE_REACH, 0, SLOPE_REACH))
        slopes.append((high - low) / (2 * SLOPE_REACH * (1 + here)))
    # A smooth surface hardly bends within a cycle; what it bends has nothing to do with the code.
    bend, expected = (a[0] - 2 * a[1] + a[2] for a in (phases, slopes))
    smooth = np.abs(bend) < _MAX_BEND
    return float(bend[smooth] @ expected[smooth] / max(float(expected[smooth] @ expected[smooth]), 1e-9))
