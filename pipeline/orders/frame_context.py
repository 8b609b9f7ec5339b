"""What the parts of a frame that the code has surely placed tell of the others.

A part shows the code's steps, but how high its contrast is on the whole depends on ambient light and blur. These are
much alike all over a frame, so where the contrast of the surely placed parts is known, the level of another one's
contrast tells which cycles it may have. And surfaces are near each other rather than anywhere in the projector's
picture.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.models import FloatArray
from pipeline.orders.posterior import Integers
from tikernels.unwrapping.patches import PatchGraph

# The factor of the contrast differs by this from part to part, natural logarithm, a standard deviation that counts as
# much as this many parts; some are another surface altogether, and may have any within the third.
_USUAL_SPREAD, _SPREAD_PRIOR, _ANY_SPREAD = 0.03, 2.0, 0.3
_ANY_SHARE = 0.1
# Tails of a Student distribution, and its constant; the smallest standard deviation of a part's level; and the largest
# deviation that counts for the spread.
_FREEDOM, _STUDENT, _MIN_SIGMA, _MAX_DEVIATION = 4.0, 0.375, 0.01, 0.2
# Of a part more pixels than this tell no more.
_MANY_PX = 5000
# Among more placed parts a part is not left out of what is usual when its own level is judged: it hardly counts.
_FEW_PLACED = 64
# Half of all surfaces lie within this many cycles of those that are known, beside a plane through the frame.
_NEAR_CYCLES = 4.0


@dataclass(frozen=True)
class PartLevel:
    """How high a part's contrast is: the mean logarithm over its cycles."""

    seen: float
    code: FloatArray  # (strengths, offsets) what the code has there, if it has this strength and offset
    variance: float

    def factor(self, place: int) -> FloatArray:
        """(strengths,) logarithm of what is seen over what the code has at an offset."""
        return np.asarray(self.seen - self.code[:, place])


def level_evidence(levels: list[PartLevel | None], sure: dict[int, int], pixels: Integers) -> list[FloatArray | float]:
    """Return how probable each offset makes the level of each part, beside those of the parts that are placed.

    Parameters
    ----------
    levels : n PartLevel or None
        Of each part; None where it shows no steps.
    sure : dict
        Of the placed parts, which of the offsets they have.
    pixels : (n,) int
        How many each part has.

    Returns
    -------
    n (strengths, offsets) float or 0.0
        Logarithm; 0 where nothing is known.
    """
    placed = np.array([part for part in sure if levels[part] is not None], np.int64)
    factors = np.array([level.factor(sure[k]) for k in placed if (level := levels[k]) is not None])
    weights = np.sqrt(np.minimum(pixels[placed], _MANY_PX))
    evidence: list[FloatArray | float] = []
    by_all = _usual_factor(factors, weights) if len(placed) else None
    itself = frozenset(placed.tolist()) if len(placed) <= _FEW_PLACED else frozenset()
    for part, level in enumerate(levels):
        if level is None or by_all is None or itself == {part}:
            evidence.append(0.0)
            continue
        usual, spread = by_all
        if part in itself:
            usual, spread = _usual_factor(factors[placed != part], weights[placed != part])
        away = level.seen - level.code - usual[:, None]
        variance = (spread**2 + _MIN_SIGMA**2 + level.variance)[:, None]
        alike = np.log((1 - _ANY_SHARE) * _STUDENT) - 0.5 * np.log(variance)
        alike = alike - 0.5 * (_FREEDOM + 1) * np.log1p(away**2 / (_FREEDOM * variance))
        any_other = np.log(_ANY_SHARE / (np.sqrt(2 * np.pi) * _ANY_SPREAD)) - 0.5 * (away / _ANY_SPREAD) ** 2
        evidence.append(np.logaddexp(alike, any_other))
    return evidence


def _usual_factor(factors: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return for every strength the weighted median of (n, strengths) factors, and their spread about it."""
    sort = np.argsort(factors, axis=0)
    below = np.cumsum(weights[sort], axis=0)
    middle = np.argmax(below >= 0.5 * below[-1], axis=0)
    usual = np.take_along_axis(factors, np.take_along_axis(sort, middle[None], axis=0), axis=0)[0]
    deviations = np.minimum(np.abs(factors - usual), _MAX_DEVIATION)
    squares = (deviations**2).sum(axis=0) + _SPREAD_PRIOR * _USUAL_SPREAD**2
    return usual, np.sqrt(squares / (len(factors) - 1 + _SPREAD_PRIOR))


def nearness(
    graph: PatchGraph, roots: npt.NDArray[np.int32], width: int, offsets: dict[int, int]
) -> npt.NDArray[np.float64]:
    """Return how many cycles each part lacks, from which on it lies where the frame's placed parts are.

    Parameters
    ----------
    graph : PatchGraph
        The patches.
    roots : (P,) int32
        The patch that stands for each patch's part.
    width : int
        The image's, px.
    offsets : dict
        Of the placed parts, by their roots: what their orders lack.

    Returns
    -------
    (P,) float64
        By root; elsewhere it has no meaning.
    """
    place = np.stack([graph.first // width, graph.first % width]).astype(np.float64)
    cycles, pixels = graph.offset.astype(np.float64), graph.pixels
    count = len(roots)
    held = np.bincount(roots, pixels, count)
    share = pixels / np.maximum(held, 1)[roots]  # of each patch in its part
    middle = np.stack([np.bincount(roots, share * values, count) for values in place])
    mean = np.bincount(roots, share * cycles, count)
    # The slopes that all parts have in common, whatever their orders.
    within = place - middle[:, roots]
    weighted = within * pixels
    slopes = np.linalg.lstsq(weighted @ within.T, weighted @ (cycles - mean[roots]), rcond=None)[0]
    level = mean - slopes @ middle
    known = np.array(list(offsets))
    here = level[known] + np.array([offsets[root] for root in known])
    sort = np.argsort(here)
    below = np.cumsum(held[known][sort])
    usual = here[sort][np.searchsorted(below, 0.5 * below[-1])]
    return np.asarray(usual - level)


def log_nearness(lacking: float, offsets: Integers) -> FloatArray:
    """Return the logarithm of how usual these offsets are, for a part that lacks so many cycles to be near the rest."""
    return np.asarray(-np.log1p(((offsets - lacking) / _NEAR_CYCLES) ** 2))
