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
from pipeline.pattern.contrast_code import contrast_steps
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
from tikernels.order_evidence.offset_labelling import (
    Links,
    connected_parts,
    pool_evidence,
    settle_labels,
    weigh_offsets,
)
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
# Regions of fewer pixels or steps are too small to be parted.
_MIN_PARTED_PX, _MIN_STEPS = 600, 6
# An offset is a candidate where patches, with what comes over contacts of this support or more undiminished and this
# many patches far, prefer it to their region's own by this margin, in variances; it takes this many such patches, and
# the commonest few are looked at.
_FULL_SUPPORT, _POOLED, _MIN_MARGIN, _MIN_PATCHES, _CANDIDATES = 300, 3, 300.0, 3, 12
# What a difference of labels costs across a contact of full support, in variances, the least share of it, and how often
# labels settle.
_LABEL_COST, _LEAST_SUPPORT, _SWEEPS = 20.0, 0.05, 8
# How probably a piece that the labels have cut off, which hangs together with its region, has that one's orders before
# its own steps are asked; and from which probability on it is no piece of its own.
_SAME_SURFACE, _REJOINS = 0.9, 0.93
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
    roots, main = graph.root, np.full(len(graph.root), -1)
    if strength >= _MIN_STRENGTH:
        roots, main = _cut(steps, graph, *_spread_and_strength(steps, _stretches(steps), strength))
    parts, posteriors, readable = _placed(steps, graph, roots, main)
    if (main >= 0).any():
        roots = _rejoined(roots, main, graph, parts, posteriors)
        parts, posteriors, readable = _placed(steps, graph, roots, main)
    if order_range is not None:
        ranges = order_range.by_part(roots, parts, graph.pixels)
        posteriors = [
            within.narrow(posterior) if posterior is not NOTHING_KNOWN else within.alone()
            for within, posterior in zip(ranges, posteriors, strict=True)
        ]
    return AbsoluteOrders(roots, parts, tuple(posteriors)), readable


def _placed(
    steps: _Steps, graph: PatchGraph, roots: npt.NDArray[np.int32], main: Integers
) -> tuple[Integers, list[Posterior], bool]:
    """Return the parts that are large enough, their posteriors, and whether they show the code.

    A piece that was cut off hangs together with its region: that, too, is known of its offset.
    """
    parts = np.flatnonzero(np.bincount(roots, graph.pixels, len(roots)) >= MIN_REGION_PX)
    seen = _seen_steps(steps, roots, parts)
    # A piece is free to choose where it begins and where it ends, and chance has as many ways to look like the code.
    origin = main[graph.root[parts]]
    places = np.ptp(steps.order) if len(steps.order) else 1
    ends = np.where(origin == parts, 1, 2)  # of what remains of the region the labels have found one
    luck = np.where(origin >= 0, ends * np.log(max(places, 1)), 0.0)
    posteriors, readable = _posteriors([_log_likelihood(part) for part in seen], luck)
    of_main = {int(part): posterior for part, posterior in zip(parts, posteriors, strict=True)}
    for k, part in enumerate(parts):
        region = of_main.get(int(origin[k]))
        if region is not None and origin[k] != part:
            sure = 1 - region.error(region.best)
            posteriors[k] = posteriors[k].beside(region.best, _SAME_SURFACE * sure)
    return parts, posteriors, readable


def _rejoined(
    roots: npt.NDArray[np.int32], main: Integers, graph: PatchGraph, parts: Integers, posteriors: list[Posterior]
) -> npt.NDArray[np.int32]:
    """Return the roots with those pieces put back that have their region's offset."""
    origin = main[graph.root]
    offset = {int(part): posterior for part, posterior in zip(parts, posteriors, strict=True)}
    back = np.zeros(len(roots), np.bool_)
    for part, posterior in offset.items():
        region = offset.get(int(origin[part]))
        if region is not None and posterior.error(region.best) <= 1 - _REJOINS:
            back |= roots == part
    return np.where(back, origin, roots).astype(np.int32)


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


def _spread_and_strength(steps: _Steps, stretches: Integers, strength: float) -> tuple[float, float]:
    """Return the standard deviation of a step, and the strength of the code's, by the stretches that fit clearly."""
    if len(stretches) == 0:
        return _MIN_SIGMA, strength
    # What all five steps have in common may be the contrast's own slow change.
    common = 1 - 1 / np.sqrt(1 + _STRETCH * (_DRIFT / _MIN_SIGMA) ** 2)
    without = np.eye(_STRETCH) - common / _STRETCH
    windows = np.lib.stride_tricks.sliding_window_view(contrast_steps(), _STRETCH) @ without
    seen = steps.rise[stretches] @ without
    matches = match_stretches(seen.astype(np.float32), (strength * windows).astype(np.float32))
    best, clear = matches[:, WINDOW].astype(np.int64), matches[:, LEAST] < 0.25 * matches[:, SECOND]
    if not clear.any():
        return _MIN_SIGMA, strength
    expected = windows[best[clear]]
    factor = (seen[clear] * expected).sum(axis=1) / np.maximum((expected**2).sum(axis=1), 1e-12)
    strength = float(np.median(factor))
    remaining = ((seen[clear] - strength * expected) ** 2).mean(axis=1)
    return max(_MIN_SIGMA, 1.7 * float(np.sqrt(np.median(remaining)))), strength


def _cut(steps: _Steps, graph: PatchGraph, sigma: float, strength: float) -> tuple[npt.NDArray[np.int32], Integers]:
    """Cut pieces off regions that the code contradicts.

    Returns
    -------
    roots : (P,) int32
        The patch that stands for each patch's part.
    main : (P,) int64
        By region, the root of its largest part with the region's own offset; -1 where nothing was cut off.
    """
    roots, main = graph.root.copy(), np.full(len(graph.root), -1)
    owner = graph.root[steps.low]
    pixels, count = np.bincount(graph.root, graph.pixels), np.bincount(owner, minlength=len(graph.root))
    regions = np.flatnonzero(pixels >= _MIN_PARTED_PX)
    number = np.empty(len(graph.root), np.int64)
    for region in regions[count[regions] >= _MIN_STEPS]:
        patches, own = np.flatnonzero(graph.root == region), np.flatnonzero(owner == region)
        number[patches] = np.arange(len(patches))
        within = graph.root[graph.ends[0]] == region
        ends, support = number[graph.ends[:, within]], np.clip(graph.votes[within] / _FULL_SUPPORT, 0, 1)
        seen = (number[steps.low[own]], number[steps.high[own]]), steps.order[own], steps.rise[own]
        labels = _labels(*seen, ends, support, len(patches), sigma, strength)
        if labels is None:
            continue
        whole = labels[ends[0]] == labels[ends[1]]
        pieces = connected_parts(ends[:, whole], len(patches))
        roots[patches] = patches[pieces]
        own_offset = np.bincount(pieces[labels == 0], graph.pixels[patches][labels == 0], len(patches))
        main[region] = patches[own_offset.argmax()]
    return roots, main


def _labels(
    ends_of_steps: tuple[Integers, Integers],
    order: Integers,
    rise: FloatArray,
    ends: Integers,
    support: FloatArray,
    patches: int,
    sigma: float,
    strength: float,
) -> npt.NDArray[np.int32] | None:
    """Label a region's patches with the offsets that their steps name, 0 for the region's own; None: all have that."""
    code = strength * contrast_steps()
    offsets = range(-int(order.max()), len(code) - int(order.min()))
    evidence = weigh_offsets(ends_of_steps, order, rise, code, offsets, patches, sigma, _MAX_DEVIATION)
    own = int(evidence.sum(axis=1).argmin())
    links = Links.of(ends, patches)
    pooled = pool_evidence(evidence, links, support, _POOLED)
    best = pooled.argmin(axis=0)
    margin = pooled[own] - pooled[best, np.arange(patches)]
    named, votes = np.unique(best[(best != own) & (margin > _MIN_MARGIN)], return_counts=True)
    named, votes = named[votes >= _MIN_PATCHES], votes[votes >= _MIN_PATCHES]
    if len(named) == 0:
        return None
    candidates = np.append(own, named[np.argsort(-votes, kind="stable")][:_CANDIDATES])
    # None of them is right where the steps deviate by more than this from all.
    shown = np.bincount(np.concatenate(ends_of_steps), minlength=patches)
    nowhere = (0.5 * _NOWHERE * shown[None]).astype(np.float32)
    first = np.concatenate([pooled[candidates], pool_evidence(nowhere, links, support, _POOLED)]).argmin(axis=0)
    costs = _LABEL_COST * np.maximum(support, _LEAST_SUPPORT)
    labels = settle_labels(np.concatenate([evidence[candidates], nowhere]), first, links, costs, _SWEEPS)
    return None if (labels == 0).all() else labels


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
    evidence = np.array([_evidence(part) for _, part in likelihoods]).reshape(-1, *alone.shape)
    shown = alone + evidence.sum(axis=0)
    read = np.array([part.shape[-1] > 0 for _, part in likelihoods], np.bool_)
    evidence[np.ix_(read, _STRENGTHS == 0)] += luck[read, None, None]
    together = alone + evidence.sum(axis=0)
    posteriors = []
    for (first, likelihood), own, more in zip(likelihoods, evidence, luck, strict=True):
        if likelihood.shape[-1] == 0:
            posteriors.append(NOTHING_KNOWN)
            continue
        likelihood[_STRENGTHS == 0] += more
        others = together - own
        others -= np.logaddexp.reduce(others, axis=None)
        prior = np.logaddexp(np.log(1 - _UNALIKE) + others, np.log(_UNALIKE) + alone)
        logarithm = np.logaddexp.reduce(prior[..., None] + likelihood, axis=(0, 1))
        probability = np.exp(logarithm - logarithm.max())
        posteriors.append(Posterior(first, probability / probability.sum()))
    without = np.logaddexp.reduce(shown[_STRENGTHS == 0], axis=None)
    return posteriors, bool(without < np.logaddexp.reduce(shown[_STRENGTHS > 0], axis=None))


def _evidence(likelihood: FloatArray) -> FloatArray:
    """Return how probable each strength and spread is by a part of any offset; without steps it says nothing."""
    if likelihood.shape[-1] == 0:
        return np.zeros(likelihood.shape[:-1])
    return np.asarray(np.logaddexp.reduce(likelihood, axis=-1) - np.log(likelihood.shape[-1]))
