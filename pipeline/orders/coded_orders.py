"""Which cycle of a coded pattern a surface shows: the orders of a single frame, absolute.

From cycle to cycle the logarithm of the contrast steps as the code says; a factor that changes slowly cancels in the
steps. Six cycles in a row, a stretch, name their place in the sequence (`tikernels.order_evidence.contrast_reading`).
Many stretches vote, patches that the votes tell apart are not joined, and every part gets a posterior over its offsets.
`docs/coded_pattern.md` has the derivation.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from pipeline.models import FloatArray
from pipeline.orders.posterior import NOTHING_KNOWN, AbsoluteOrders, Integers, OrderRange, Posterior
from pipeline.pattern.contrast_code import CYCLES, contrast_steps
from pipeline.robust import robust_sigma
from tikernels.order_evidence.contrast_reading import (
    BACKGROUND,
    LEAST,
    MODULATION,
    ORDER_SLOTS,
    PHASE,
    SECOND,
    TOTAL,
    WINDOW,
    match_stretches,
)
from tikernels.order_evidence.part_joining import CANDIDATES, join_parts
from tikernels.unwrapping.patches import MIN_REGION_PX, PatchGraph
from tikernels.unwrapping.tables import CELL_HEIGHT, CELL_WIDTH

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
# What a single step may add to the squared deviation from the code, in variances, that is three standard deviations:
# edges and blemishes deviate by more, and must not decide alone.
_MAX_DEVIATION = 9.0
# Where the squared deviation of the steps is larger than this on average, in variances, none of the offsets that
# stretches have named is the right one.
_NOWHERE = 5.5
# A stretch votes if it fits, and if the next best place is less likely by exp(-5).
_MIN_LEAD = 10.0
_MIN_VOTES = 3
# Offsets with less than this share of a region's votes are chance, or too small a part to keep others from joining.
_MIN_SHARE = 0.02
# Two parts stay apart if both show five cycles and each prefers its own offset by this margin, in variances, and by
# this margin a step: the steps of one cycle share their errors, so a hundred of them say little more than one.
_MIN_SPAN, _MIN_MARGIN, _MARGIN_A_STEP = 4, 60.0, 1.5
# What a frame's code may look like: the strength of its steps (0: it shows none; a response of gamma 2.4 and ambient
# light leave a third), and by how much steps deviate from it, blemishes, slopes and blur included (natural logarithm).
_STRENGTHS = np.array([0.0, 0.35, 0.5, 0.71, 1.0])
_STRENGTH_PRIOR = np.array([0.1, 0.225, 0.225, 0.225, 0.225])
_SPREADS = np.array([0.006, 0.015, 0.04, 0.1])
# Parts are mostly alike, but this share of them is as if nothing else were known of the frame.
_UNALIKE = 0.1
# Tails of a Student distribution: edges spoil some cycles.
_FREEDOM = 4.0
# A median of n values scatters 1.25 / sqrt(n) as much as they do; the scatter that a part's own columns show counts as
# much as the frame's when there are eight of them.
_MEDIAN_SCATTER, _SCATTER_PRIOR = 1.2533, 8.0


@dataclass(frozen=True)
class _Steps:
    """By how much the logarithm of the contrast rises from one cycle to the next, patch by patch."""

    low: Integers  # (N,) patch that holds most of the lower cycle
    high: Integers  # (N,) and of the higher one
    order: Integers  # (N,) the lower cycle's order in its region
    rise: FloatArray  # (N,)
    place: Integers  # (N,) steps that follow each other down a column of patches are numbered one by one
    rising: bool  # whether the orders grow with the rows


@dataclass(frozen=True)
class _PartSteps:
    """What all columns of a part show of its steps, order by order."""

    lower_orders: Integers  # (n,) the lower cycle's order
    middle: FloatArray  # (n,) median rise
    noise: FloatArray  # (n,) its variance, by the columns' scatter


def find_absolute_orders(
    sums: npt.NDArray[np.float32],
    graph: PatchGraph,
    width: int,
    rising: bool,
    order_range: OrderRange | None = None,
) -> tuple[AbsoluteOrders, bool]:
    """Split regions where the code contradicts them, and place every part.

    Parameters
    ----------
    sums : (P, ORDER_SLOTS, 4) float32
        What `measure_contrast` summed.
    graph : PatchGraph
        The patches, joined to regions.
    width : int
        The image's, px.
    rising : bool
        Whether the orders grow with the rows.
    order_range : OrderRange, optional
        What else is known of the orders.

    Returns
    -------
    AbsoluteOrders
        Parts and their posteriors.
    bool
        Whether the frame shows the code at all.
    """
    steps = _contrast_steps(sums, graph, width, rising)
    # By medians: the steps at edges are many times too large.
    strength = float(np.median(np.abs(steps.rise)) / np.median(np.abs(contrast_steps()))) if len(steps.rise) else 0.0
    roots = graph.root
    if strength >= _MIN_STRENGTH:
        stretches = _stretches(steps)
        offsets, sigma, strength = _local_offsets(steps, stretches, strength)
        roots = _split(steps, graph, stretches, offsets, strength, sigma)
    parts = np.flatnonzero(np.bincount(roots, graph.pixels, len(roots)) >= MIN_REGION_PX)
    seen = _seen_steps(steps, roots, parts)
    # A cut is free to choose its place, and chance has as many places to look like the code.
    cut = np.zeros(len(roots), np.bool_)
    cut[graph.root[roots != graph.root]] = True
    places = np.ptp(steps.order) if len(steps.order) else 1
    luck = np.where(cut[graph.root[parts]], np.log(max(places, 1)), 0.0)
    posteriors, readable = _posteriors([_log_likelihood(part) for part in seen], luck)
    if order_range is not None:
        ranges = order_range.by_part(roots, parts, graph.pixels)
        posteriors = [
            within.narrow(posterior) if posterior is not NOTHING_KNOWN else within.alone()
            for within, posterior in zip(ranges, posteriors, strict=True)
        ]
    return AbsoluteOrders(roots, parts, tuple(posteriors)), readable


def _contrast_steps(sums: npt.NDArray[np.float32], graph: PatchGraph, width: int, rising: bool) -> _Steps:
    """Put the cycles of every column of patches in a row and take the steps between whole ones."""
    patch, slot = np.nonzero(sums[..., TOTAL] > 0)
    values = sums[patch, slot].astype(np.float64)
    order = graph.offset[patch].astype(np.int64) + slot - ORDER_SLOTS // 2
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
    matches = match_stretches(seen.astype(np.float32), (strength * windows).astype(np.float32))
    best, least, second = matches[:, WINDOW].astype(np.int64), matches[:, LEAST], matches[:, SECOND]
    clear = least < 0.25 * second
    sigma = _MIN_SIGMA
    if clear.any():
        expected = windows[best[clear]]
        factor = (seen[clear] * expected).sum(axis=1) / np.maximum((expected**2).sum(axis=1), 1e-12)
        strength = float(np.median(factor))
        remaining = ((seen[clear] - strength * expected) ** 2).mean(axis=1)
        sigma = max(sigma, 1.7 * float(np.sqrt(np.median(remaining))))
    sure = (least < _STRETCH * _MAX_DEVIATION * sigma**2) & (second - least > _MIN_LEAD * sigma**2)
    return np.where(sure, best - steps.order[stretches[:, 0]], -2 * CYCLES), sigma, strength


def _split(
    steps: _Steps, graph: PatchGraph, stretches: Integers, offsets: Integers, strength: float, sigma: float
) -> npt.NDArray[np.int32]:
    """Return the root of every patch's part: regions whose stretches name one offset stay whole."""
    sure = offsets > -CYCLES
    owner = graph.root[steps.low[stretches[sure, 0]]] if len(stretches) else np.zeros(0, np.int32)
    ballots = _ballots(owner, offsets[sure])
    ballot, votes = np.unique(ballots, return_counts=True)
    ballot, votes = ballot[votes >= _MIN_VOTES], votes[votes >= _MIN_VOTES]
    named = _counted(ballot)
    split = np.bincount(named[0], minlength=len(graph.root)) > 1
    if not split.any():
        return graph.root
    evidence = np.zeros((len(graph.root), CANDIDATES + 1))
    code = contrast_steps()
    for root in np.flatnonzero(split):
        mine = named[0] == root
        candidates = named[1, mine][np.argsort(-votes[mine], kind="stable")][: CANDIDATES - 1]
        own = np.flatnonzero(graph.root[steps.low] == root)
        place = steps.order[own, None] + candidates
        inside = (place >= 0) & (place < len(code))
        deviation = (steps.rise[own, None] - strength * code[np.clip(place, 0, len(code) - 1)]) ** 2 / sigma**2
        deviation = np.where(inside, np.minimum(deviation, _MAX_DEVIATION), _MAX_DEVIATION)
        padding = np.full((len(own), CANDIDATES - 1 - len(candidates)), _MAX_DEVIATION)
        nowhere = np.full((len(own), 1), _NOWHERE)
        terms = np.concatenate([deviation, padding, nowhere, np.ones((len(own), 1))], axis=1)
        # A step belongs to the patches of both its cycles.
        for end in (steps.low[own], steps.high[own]):
            for k in range(CANDIDATES + 1):
                evidence[:, k] += 0.5 * np.bincount(end, terms[:, k], len(evidence))
    orders = np.tile(np.array([2**20, -(2**20)], np.int32), (len(graph.root), 1))
    for end in (steps.low, steps.high):
        np.minimum.at(orders[:, 0], end, steps.order)
        np.maximum.at(orders[:, 1], end, steps.order + 1)
    inside = split[graph.root[graph.ends[0]]]
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
        pairs = np.ascontiguousarray(ends[:, sort])
        parents = join_parts(pairs, _MIN_SPAN, _MIN_MARGIN, _MARGIN_A_STEP, orders, evidence.astype(np.float32))
    return np.where(split[graph.root], parents, graph.root).astype(np.int32)


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


def _seen_steps(steps: _Steps, roots: npt.NDArray[np.int32], parts: Integers) -> list[_PartSteps]:
    """Put together what all columns of each part show of its steps."""
    within = np.flatnonzero(roots[steps.low] == roots[steps.high])
    part = np.searchsorted(parts, roots[steps.low[within]])
    large = parts[np.minimum(part, len(parts) - 1)] == roots[steps.low[within]] if len(parts) else np.zeros(0, np.bool_)
    part, order, rise = part[large], steps.order[within[large]], steps.rise[within[large]]
    sort = np.lexsort((rise, order, part))
    part, order, rise = part[sort], order[sort], rise[sort]
    fresh = np.ones(len(part), np.bool_)
    fresh[1:] = (np.diff(part) != 0) | (np.diff(order) != 0)
    starts = np.flatnonzero(fresh)
    counts = np.diff(np.append(starts, len(part)))
    middle = 0.5 * (rise[starts + (counts - 1) // 2] + rise[starts + counts // 2])
    group = np.repeat(np.arange(len(starts)), counts)
    # The scatter of columns about their median, which depends on each where there are few.
    deviation = np.abs(rise - middle[group]) * np.sqrt(counts / np.maximum(counts - 1, 1))[group]
    several = counts[group] > 1
    usual = _scatter(deviation[several])
    bounds = np.searchsorted(part[starts], np.arange(len(parts) + 1))
    found = []
    for first, last in pairwise(bounds):
        own = slice(starts[first], starts[last] if last < len(starts) else len(part)) if last > first else slice(0, 0)
        shown = deviation[own][several[own]]
        known = len(shown) / (len(shown) + _SCATTER_PRIOR)
        variance = known * _scatter(shown) ** 2 + (1 - known) * usual**2
        noise = _MEDIAN_SCATTER**2 * variance / counts[first:last]
        found.append(_PartSteps(order[starts[first:last]], middle[first:last], noise))
    return found


def _scatter(deviations: FloatArray) -> float:
    return robust_sigma(deviations) if len(deviations) else 0.0


def _log_likelihood(part: _PartSteps) -> tuple[int, FloatArray]:
    """Return the smallest offset, and the (strengths, spreads, offsets) logarithm of how probable a part's steps are.

    A step is Student-distributed about the code's. What all steps have in common, and a trend, is the contrast's own
    slow change; it is of the order of the spread, and integrated over.
    """
    lower_orders = part.lower_orders
    if len(lower_orders) == 0:
        return 0, np.zeros((len(_STRENGTHS), len(_SPREADS), 0))
    offsets = np.arange(-lower_orders[0], len(contrast_steps()) - lower_orders[-1])
    variance = _SPREADS[:, None] ** 2 + part.noise
    line = np.stack([np.ones(len(lower_orders)), np.linspace(-1, 1, len(lower_orders))])
    weighted = line / variance[:, None]
    normal = weighted @ line.T + np.eye(2) / _SPREADS[:, None, None] ** 2
    remains = np.eye(len(lower_orders)) - line.T @ np.linalg.solve(normal, weighted)  # (spreads, steps, steps)
    remains /= np.sqrt(_FREEDOM * variance)[..., None]
    expected = contrast_steps()[lower_orders + offsets[:, None]]
    seen, due = remains @ part.middle, expected @ remains.transpose(0, 2, 1)
    deviations = (seen[:, None] - _STRENGTHS[:, None, None, None] * due).astype(np.float32)
    fit = np.log(1 + deviations**2).sum(axis=-1, dtype=np.float64)
    constant = np.log(variance).sum(axis=-1) + np.linalg.slogdet(normal)[1] + 4 * np.log(_SPREADS)
    return int(-lower_orders[0]), -0.5 * (_FREEDOM + 1) * fit - 0.5 * constant[:, None]


def _posteriors(likelihoods: list[tuple[int, FloatArray]], luck: FloatArray) -> tuple[list[Posterior], bool]:
    """Return the posterior of every part, and whether the frame shows the code.

    Strength and spread of the steps are integrated over. What the other parts say of them is each part's prior; luck is
    the logarithm by how much likelier than it seems each part shows no code at all.
    """
    alone = np.log(_STRENGTH_PRIOR / len(_SPREADS))[:, None] + np.zeros(len(_SPREADS))
    for (_, likelihood), more in zip(likelihoods, luck, strict=True):
        likelihood[_STRENGTHS == 0] += more
    told = [part for _, part in likelihoods if part.shape[-1]]
    together = alone + sum(_evidence(part) for part in told)
    posteriors = []
    for first, likelihood in likelihoods:
        if likelihood.shape[-1] == 0:
            posteriors.append(NOTHING_KNOWN)
            continue
        others = together - _evidence(likelihood)
        others -= np.logaddexp.reduce(others, axis=None)
        prior = np.logaddexp(np.log(1 - _UNALIKE) + others, np.log(_UNALIKE) + alone)
        logarithm = np.logaddexp.reduce(prior[..., None] + likelihood, axis=(0, 1))
        probability = np.exp(logarithm - logarithm.max())
        posteriors.append(Posterior(first, probability / probability.sum()))
    without = np.logaddexp.reduce(together[_STRENGTHS == 0], axis=None)
    return posteriors, bool(without < np.logaddexp.reduce(together[_STRENGTHS > 0], axis=None))


def _evidence(likelihood: FloatArray) -> FloatArray:
    """Return how probable each strength and spread is by a part whose offset may be any."""
    return np.asarray(np.logaddexp.reduce(likelihood, axis=-1) - np.log(likelihood.shape[-1]))
