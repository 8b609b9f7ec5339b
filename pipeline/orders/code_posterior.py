"""How probable each offset of a part is, by the steps of the code that it shows.

The steps are Student-distributed about the code's. How strong the code is in the frame and by how much its steps
scatter is not known; both are integrated over, and what the other parts say of them is each part's prior.
`docs/coded_pattern.md` has the derivation.
"""

from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from pipeline.models import FloatArray
from pipeline.orders.contrast_cycles import Steps
from pipeline.orders.frame_context import PartLevel
from pipeline.orders.posterior import NOTHING_KNOWN, Integers, Posterior
from pipeline.pattern.contrast_code import CYCLES, contrast_levels
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
# Standard deviation of a cycle's level, what its columns have in common included.
_LEVEL_SIGMA = 0.01


@dataclass(frozen=True)
class PartSteps:
    """What all columns of a part show of its steps, order by order."""

    lower_orders: Integers  # (n,) the lower cycle's order
    middle: FloatArray  # (n,) median rise
    noise: FloatArray  # (n,) its variance, by the columns' scatter
    level: FloatArray  # (n,) median of the logarithm of both cycles' contrast


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
    order, rise, level = steps.order[within], steps.rise[within], steps.level[within]
    sort = np.lexsort((rise, order, part))
    level = level[np.lexsort((level, order, part))]
    part, order, rise = part[sort], order[sort], rise[sort]
    fresh = np.ones(len(part), np.bool_)
    fresh[1:] = (np.diff(part) != 0) | (np.diff(order) != 0)
    starts = np.flatnonzero(fresh)
    counts = np.diff(np.append(starts, len(part)))
    lower, upper = starts + (counts - 1) // 2, starts + counts // 2
    middle, level = 0.5 * (rise[lower] + rise[upper]), 0.5 * (level[lower] + level[upper])
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
        found.append(PartSteps(order[starts[first:last]], middle[first:last], noise, level[first:last]))
    return found


def _scatter(deviations: FloatArray) -> float:
    return robust_sigma(deviations) if len(deviations) else 0.0


def log_likelihood(part: PartSteps) -> tuple[int, FloatArray]:
    """Return the smallest offset, and the (strengths, spreads, offsets) logarithm of how probable a part's steps are.

    A step is Student-distributed about the code's. What all steps have in common, and a trend, is the contrast's own
    slow change; it is of the order of the spread, and integrated over.
    """
    lower_orders = part.lower_orders
    if len(lower_orders) == 0:
        return 0, np.zeros((len(STRENGTHS), len(_SPREADS), 0))
    offsets, count = _offsets(part), len(lower_orders)
    variance = _SPREADS[:, None] ** 2 + part.noise
    line = np.stack([np.ones(count), np.linspace(-1, 1, count)])
    weighted = line / variance[:, None]
    normal = weighted @ line.T + np.eye(2) / _SPREADS[:, None, None] ** 2
    deviations = part.middle - np.diff(_levels())[:, lower_orders + offsets[:, None]]
    deviations = deviations.reshape(-1, count).astype(np.float32)
    fits = []
    # In single precision: a large part has a hundred thousand deviations.
    for along, scale in zip(np.linalg.solve(normal, weighted), 1 / np.sqrt(_FREEDOM * variance), strict=True):
        left = deviations * scale.astype(np.float32)
        left -= (deviations @ along.T.astype(np.float32)) @ (line * scale).astype(np.float32)
        fits.append(np.log1p(np.square(left, out=left), out=left) @ np.ones(count, np.float32))
    fit = np.stack(fits, axis=1).reshape(len(STRENGTHS), len(offsets), -1).transpose(0, 2, 1)
    constant = np.log(variance).sum(axis=-1) + np.linalg.slogdet(normal)[1] + 4 * np.log(_SPREADS)
    return int(-lower_orders[0]), -0.5 * (_FREEDOM + 1) * fit.astype(np.float64) - 0.5 * constant[:, None]


def part_level(part: PartSteps) -> PartLevel | None:
    """Return how high a part's contrast is, and how high the code's is at each of the offsets that it may have."""
    if len(part.lower_orders) == 0:
        return None
    weights = 1 / (part.noise + _LEVEL_SIGMA**2)
    total = float(weights.sum())
    places = part.lower_orders + _offsets(part)[:, None]
    code = 0.5 * (_levels()[:, places] + _levels()[:, places + 1]) @ weights / total
    return PartLevel(float(part.level @ weights) / total, code, 1 / total)


def _offsets(part: PartSteps) -> Integers:
    """Return the offsets that a part may have: all of it lies in the code."""
    return np.arange(-part.lower_orders[0], CYCLES - 1 - part.lower_orders[-1])


@cache
def _levels() -> FloatArray:
    """Return the (strengths, cycles) levels of the code's contrast."""
    return np.array([contrast_levels(strength) for strength in STRENGTHS])


def code_posteriors(likelihoods: list[tuple[int, FloatArray]], luck: FloatArray) -> tuple[list[Posterior], bool]:
    """Return the posterior of every part, and whether the frame shows the code.

    Parameters
    ----------
    likelihoods : n (int, (strengths, spreads, offsets) float)
        Of `log_likelihood`.
    luck : (n,) float
        Logarithm by how much likelier than it seems each part shows no code at all.
    """
    alone = np.log(_STRENGTH_PRIOR / len(_SPREADS))[:, None] + np.zeros(len(_SPREADS))
    evidence = np.array([_evidence(part) for _, part in likelihoods]).reshape(-1, *alone.shape)
    shown = alone + evidence.sum(axis=0)
    read = np.array([part.shape[-1] > 0 for _, part in likelihoods], np.bool_)
    evidence[np.ix_(read, STRENGTHS == 0)] += luck[read, None, None]
    together = alone + evidence.sum(axis=0)
    posteriors = []
    for (first, likelihood), own, more in zip(likelihoods, evidence, luck, strict=True):
        if likelihood.shape[-1] == 0:
            posteriors.append(NOTHING_KNOWN)
            continue
        others = together - own
        others -= np.logaddexp.reduce(others, axis=None)
        prior = np.logaddexp(np.log(1 - _UNALIKE) + others, np.log(_UNALIKE) + alone)
        prior[STRENGTHS == 0] += more
        logarithm = np.logaddexp.reduce(prior[..., None] + likelihood, axis=(0, 1))
        probability = np.exp(logarithm - logarithm.max())
        posteriors.append(Posterior(first, probability / probability.sum()))
    without = np.logaddexp.reduce(shown[STRENGTHS == 0], axis=None)
    return posteriors, bool(without < np.logaddexp.reduce(shown[STRENGTHS > 0], axis=None))


def _evidence(likelihood: FloatArray) -> FloatArray:
    """Return how probable each strength and spread is by a part of any offset; without steps it says nothing."""
    if likelihood.shape[-1] == 0:
        return np.zeros(likelihood.shape[:-1])
    return np.asarray(np.logaddexp.reduce(likelihood, axis=-1) - np.log(likelihood.shape[-1]))
