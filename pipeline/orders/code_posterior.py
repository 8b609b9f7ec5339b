"""How probable each offset of a part is, by the steps of the code that it shows.

The steps are Student-distributed about the code's. How strong the code is in the frame and by how much its steps
scatter is not known; both are integrated over, and what the other parts say of them is each part's prior.
`docs/coded_pattern.md` has the derivation.
"""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from pipeline.models import FloatArray
from pipeline.orders.contrast_cycles import Steps
from pipeline.orders.posterior import NOTHING_KNOWN, Integers, Posterior
from pipeline.pattern import CYCLES, contrast_levels
from pipeline.robust import robust_sigma

# What a frame's code may look like: the strength of its steps (0: it shows none; a response of gamma 2.4 and ambient
# light leave a third), and by how much steps deviate from it, blemishes, slopes and blur included (natural logarithm).
# A step is a tenth or two, so strengths that are a sixth apart lie within what steps deviate by.
STRENGTHS = np.append(0.0, np.geomspace(0.3, 1.0, 9))
_STRENGTH_PRIOR = np.append(0.1, np.full(9, 0.1))
_SPREADS = np.array([0.006, 0.015, 0.04, 0.1])
# Parts are mostly alike, but this share of them is as if nothing else were known of the frame.
_UNALIKE = 0.1
# Tails of a Student distribution: edges spoil some cycles.
_FREEDOM = 4.0
# A median of n values scatters 1.25 / sqrt(n) as much as they do; the scatter that a part's own columns show counts as
# much as the frame's when there are eight of them.
_MEDIAN_SCATTER, _SCATTER_PRIOR = 1.2533, 8.0
# Numbers that are worked on together: they stay in a core's cache.
_MOST_AT_ONCE = 2**18


@dataclass(frozen=True)
class PartSteps:
    """What all columns of a part show of its steps, order by order."""

    lower_orders: Integers  # (n,) the lower cycle's order
    middle: FloatArray  # (n,) median rise
    columns: Integers  # (n,) that show it
    scatter: float  # a single column's standard deviation

    @property
    def noise(self) -> FloatArray:
        """(n,) the medians' variance."""
        return (_MEDIAN_SCATTER * self.scatter) ** 2 / self.columns


def seen_steps(steps: Steps, roots: npt.NDArray[np.int32], parts: Integers) -> list[PartSteps]:
    """Put together what all columns of each part show of its steps.

    Parameters
    ----------
    steps : Steps
        Of all columns.
    roots : (P,) int32
        The patch that stands for each patch's part.
    parts : (n,) int
        The roots of the parts that are wanted, rising.
    """
    within = np.flatnonzero(roots[steps.low] == roots[steps.high])
    part = np.searchsorted(parts, roots[steps.low[within]])
    large = parts[np.minimum(part, len(parts) - 1)] == roots[steps.low[within]] if len(parts) else np.zeros(0, np.bool_)
    within, part = within[large], part[large]
    order, rise = steps.order[within], steps.rise[within]
    sort = np.lexsort((rise, order, part))
    part, order, rise = part[sort], order[sort], rise[sort]
    fresh = np.ones(len(part), np.bool_)
    fresh[1:] = (np.diff(part) != 0) | (np.diff(order) != 0)
    starts = np.flatnonzero(fresh)
    counts = np.diff(np.append(starts, len(part)))
    lower, upper = starts + (counts - 1) // 2, starts + counts // 2
    middle = 0.5 * (rise[lower] + rise[upper])
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
        seen = order[starts[first:last]], middle[first:last], counts[first:last]
        found.append(PartSteps(*seen, float(np.sqrt(variance))))
    return found


def _scatter(deviations: FloatArray) -> float:
    return robust_sigma(deviations) if len(deviations) else 0.0


def log_likelihoods(parts: list[PartSteps]) -> list[tuple[int, FloatArray]]:
    """Return the smallest offset of each part, and the logarithm of how probable its steps are at each of its offsets.

    That is a (strengths, spreads, offsets) array.

    A step is Student-distributed about the code's. What all steps have in common, and a trend, is the contrast's own
    slow change; it is of the order of the spread, and integrated over.
    """
    found = [(0, np.zeros((len(STRENGTHS), len(_SPREADS), 0)))] * len(parts)
    by_count = defaultdict(list)
    for number, part in enumerate(parts):
        by_count[len(part.lower_orders)].append(number)
    for count, numbers in by_count.items():
        if count == 0:
            continue
        # Parts of as many steps at once, so many that their deviations take some megabytes.
        at_once = max(1, _MOST_AT_ONCE // (len(STRENGTHS) * CYCLES * count))
        for first in range(0, len(numbers), at_once):
            some = numbers[first : first + at_once]
            for number, likelihood in zip(some, _alike_likelihoods([parts[k] for k in some]), strict=True):
                found[number] = (int(-parts[number].lower_orders[0]), likelihood)
    return found


def _alike_likelihoods(parts: list[PartSteps]) -> list[FloatArray]:
    """Return `log_likelihoods` of parts that have as many steps."""
    orders = np.stack([part.lower_orders for part in parts])
    count, last = orders.shape[1], CYCLES - 2
    n_offsets = last + 1 - (orders[:, -1] - orders[:, 0])
    places = orders - orders[:, :1]
    places = np.minimum(places[:, None] + np.arange(n_offsets.max())[:, None], last)  # (n, offsets, count)
    variance = _SPREADS[:, None] ** 2 + np.stack([part.noise for part in parts])[:, None]  # (n, spreads, count)
    line = np.stack([np.ones(count), np.linspace(-1, 1, count)])
    weighted = line / variance[:, :, None]
    normal = weighted @ line.T + np.eye(2) / _SPREADS[:, None, None] ** 2
    constant = np.log(variance).sum(axis=-1) + np.linalg.slogdet(normal)[1] + 4 * np.log(_SPREADS)
    # In single precision: a large part has a hundred thousand deviations.
    middle = np.stack([part.middle for part in parts]).astype(np.float32)
    deviations = middle[:, None, None] - np.diff(_levels()).astype(np.float32)[:, places].swapaxes(0, 1)
    deviations = deviations.reshape(len(parts), -1, count)
    fits = []
    along, scale = np.linalg.solve(normal, weighted), (1 / np.sqrt(_FREEDOM * variance)).astype(np.float32)
    for k in range(len(_SPREADS)):
        left = deviations * scale[:, k, None]
        shape = (line * scale[:, k, None]).astype(np.float32)
        left -= (deviations @ along[:, k].swapaxes(1, 2).astype(np.float32)) @ shape
        fits.append(np.log1p(np.square(left, out=left), out=left) @ np.ones(count, np.float32))
    fit = np.stack(fits, axis=1).reshape(len(parts), len(_SPREADS), len(STRENGTHS), -1).swapaxes(1, 2)
    likelihoods = -0.5 * (_FREEDOM + 1) * fit.astype(np.float64) - 0.5 * constant[:, None, :, None]
    return [likelihood[..., :offsets] for likelihood, offsets in zip(likelihoods, n_offsets, strict=True)]


@cache
def _levels() -> FloatArray:
    """Return the (strengths, cycles) levels of the code's contrast."""
    return np.array([contrast_levels(strength) for strength in STRENGTHS])


@dataclass(frozen=True)
class CodeReading:
    """How strong the code is in a frame and in each of its parts, and which offsets it names there."""

    posteriors: list[Posterior]  # (n,) of the parts' offsets
    strengths: FloatArray  # (n,) likeliest strength of the code in each part, 0..1; 0: the part does not show it
    spreads: FloatArray  # (n,) likeliest standard deviation of each part's steps from the code (natural logarithm)
    strength: float  # likeliest in the frame, 0..1; 0: the frame does not show the code


def code_posteriors(likelihoods: list[tuple[int, FloatArray]], luck: FloatArray) -> CodeReading:
    """Return what every part shows of the code, what the other parts show of it being its prior.

    Parameters
    ----------
    likelihoods : n (int, (strengths, spreads, offsets) float)
        Of `log_likelihoods`.
    luck : (n,) float
        Logarithm by how much likelier than it seems each part shows no code at all.
    """
    alone = np.log(_STRENGTH_PRIOR / len(_SPREADS))[:, None] + np.zeros(len(_SPREADS))
    n_offsets = np.array([part.shape[-1] for _, part in likelihoods], np.int64)
    read = n_offsets > 0
    evidence = np.zeros((len(likelihoods), *alone.shape))
    for some, padded in _padded(likelihoods):
        # Of each strength and spread, by a part of any offset; without steps a part says nothing.
        evidence[some] = np.where(
            read[some, None, None], _log_sum(padded) - np.log(np.maximum(n_offsets, 1))[some, None, None], 0
        )
    shown = alone + evidence.sum(axis=0)
    evidence[np.ix_(read, STRENGTHS == 0)] += luck[read, None, None]
    together = alone + evidence.sum(axis=0)
    posteriors = [NOTHING_KNOWN] * len(likelihoods)
    strengths, spreads = np.zeros(len(likelihoods)), np.full(len(likelihoods), _SPREADS[-1])
    for some, padded in _padded(likelihoods):
        others = together - evidence[some]
        others -= _log_sum(others.reshape(len(others), -1))[:, None, None]
        prior = np.logaddexp(np.log(1 - _UNALIKE) + others, np.log(_UNALIKE) + alone)
        prior[:, STRENGTHS == 0] += luck[some, None, None]
        joint = (prior[..., None] + padded).reshape(len(padded), -1, padded.shape[-1])
        joint = np.exp(joint - joint.max(axis=(1, 2), keepdims=True, initial=-1e300))
        likeliest = np.unravel_index(joint.sum(axis=2).argmax(axis=1), alone.shape)
        strengths[some], spreads[some] = STRENGTHS[likeliest[0]], _SPREADS[likeliest[1]]
        probability = joint.sum(axis=1)
        for k, own in zip(range(some.start, some.stop), probability, strict=True):
            if read[k]:
                own = own[: n_offsets[k]]
                posteriors[k] = Posterior(likelihoods[k][0], own / own.sum())
    of_frame = _log_sum(shown)
    readable = of_frame[STRENGTHS == 0] < _log_sum(of_frame[STRENGTHS > 0])
    strength = float(STRENGTHS[1 + of_frame[STRENGTHS > 0].argmax()]) if readable else 0.0
    return CodeReading(posteriors, np.where(read, strengths, 0.0), spreads, strength)


def _padded(likelihoods: list[tuple[int, FloatArray]]) -> Iterator[tuple[slice, FloatArray]]:
    """Yield the likelihoods of some parts at a time as one array, -inf where a part has fewer offsets."""
    widest = max((part.shape[-1] for _, part in likelihoods), default=0)
    if widest == 0:
        return
    at_once = max(1, _MOST_AT_ONCE // (len(STRENGTHS) * len(_SPREADS) * widest))
    for first in range(0, len(likelihoods), at_once):
        some = slice(first, min(first + at_once, len(likelihoods)))
        padded = np.full((some.stop - first, len(STRENGTHS), len(_SPREADS), widest), -np.inf)
        for place, (_, part) in zip(padded, likelihoods[some], strict=True):
            place[..., : part.shape[-1]] = part
        yield some, padded


def _log_sum(logarithms: FloatArray) -> FloatArray:
    """Return the logarithm of the sum over the last axis; five times as fast as `np.logaddexp.reduce`."""
    most = np.maximum(logarithms.max(axis=-1, initial=-np.inf), -1e300)
    with np.errstate(divide="ignore"):
        return np.asarray(most + np.log(np.exp(logarithms - most[..., None]).sum(axis=-1)))
