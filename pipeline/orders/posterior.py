"""Probabilities of the whole numbers of cycles that a region's orders may lack to be absolute.

The code gives a part its posterior (`code_evidence`). Every other source of evidence takes a posterior and returns it
updated: `PartRange.narrow` the expected depth, `Posterior.beside` the surfaces around, and `Posterior.after` the frame
before. A further source, such as a second camera, does the same.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.models import FloatArray

Integers = npt.NDArray[np.int64]

#: An order is absolute where it is wrong with a smaller probability than this.
MAX_ABSOLUTE_ERROR = 1e-3
# How far a surface may lie outside the range, as a standard deviation in cycles: 0.2 are 9 mm on a rig whose cycle is
# 45 mm deep, more than a calibration errs, but ranges are given in round numbers.
_RANGE_SIGMA = 0.2
# What stays possible of an order far outside the range, relative to one inside; the likeliest order contradicts the
# range if it lies four standard deviations outside.
_FLOOR, _FAR_OUTSIDE = 1e-6, 0.8
# This share of a region's pixels may lie outside at either end: rims, and what leaked in from other surfaces. Where the
# range alone determines the order, only the second share may, and the others by this fraction of a cycle.
_OUTLIERS, _STRAYS, _LEAVES = 0.1, 0.02, 0.25
# Where nothing else is known, a part that does not continue may lack this many cycles more or less.
_ELSEWHERE = 10


@dataclass(frozen=True)
class OrderRange:
    """Bounds of the cycles that each patch may lack, by the projector's picture and the expected depth."""

    least: FloatArray  # (P,)
    most: FloatArray  # (P,)
    of_depth: bool  # whether a depth range is in it, in which surfaces are rarer towards the ends

    def by_part(
        self, roots: npt.NDArray[np.integer], parts: Integers, pixels: npt.NDArray[np.integer]
    ) -> list["PartRange"]:
        """Return what is possible of most pixels of each part."""
        held = (roots, parts, pixels)
        least, all_least = _quantiles(self.least, (1 - _OUTLIERS, 1 - _STRAYS), *held)
        most, all_most = _quantiles(self.most, (_OUTLIERS, _STRAYS), *held)
        best = np.rint((all_least + all_most) / 2)
        outside = np.maximum(np.maximum(all_least - best, best - all_most), 0)
        return [PartRange(*ends, self.of_depth) for ends in zip(least, most, outside, strict=True)]


@dataclass(frozen=True)
class PartRange:
    """Bounds of the cycles that a part may lack."""

    least: float
    most: float
    outside: float  # by how many the whole part, but for strays, leaves the range at its best order
    of_depth: bool

    @property
    def holds(self) -> bool:
        """True if the range holds the whole part: otherwise the stated range is wrong, and determines nothing."""
        return self.outside <= _LEAVES

    def alone(self) -> "Posterior":
        """Return the posterior of a part of which nothing else is known, if a depth range is given."""
        if not self.of_depth or not self.holds:
            return NOTHING_KNOWN
        ends = sorted((self.least, self.most))
        first, last = int(np.floor(ends[0])) - 1, int(np.ceil(ends[1])) + 1
        flat = np.full(last - first + 1, 1 / (last - first + 1))
        return self.narrow(Posterior(first, flat))

    def narrow(self, posterior: "Posterior") -> "Posterior":
        """Return a posterior updated by the range: an unknown one if the range contradicts it."""
        offsets = posterior.first + np.arange(len(posterior.probability))
        outside = np.maximum(np.maximum(self.least - offsets, offsets - self.most), 0)
        prior = np.exp(-0.5 * (outside / _RANGE_SIGMA) ** 2)
        if self.of_depth:
            # The range counts as two standard deviations to either side of where surfaces are.
            sigma = max(self.most - self.least, 0) / 4 + _RANGE_SIGMA
            prior *= np.exp(-0.5 * ((offsets - (self.least + self.most) / 2) / sigma) ** 2)
        product = posterior.probability * (prior + _FLOOR)
        if len(product) == 0 or outside[product.argmax()] > _FAR_OUTSIDE:
            return NOTHING_KNOWN
        return Posterior(posterior.first, product / product.sum())


@dataclass(frozen=True)
class Posterior:
    """Probability of each offset of a part."""

    first: int  # offset
    probability: FloatArray  # of that offset and the following ones; empty: nothing is known

    @property
    def best(self) -> int:
        """The likeliest offset; 0 where none is known."""
        return self.first + int(self.probability.argmax()) if len(self.probability) else 0

    def error(self, offset: int) -> float:
        """Return how probably an offset is wrong."""
        place = offset - self.first
        if not 0 <= place < len(self.probability):
            return 1.0
        # Not "1 - probability": that would leave nothing of what is smaller than its rounding.
        return float(self.probability[:place].sum() + self.probability[place + 1 :].sum())

    def beside(self, offset: int | None, probability: float) -> "Posterior":
        """Return the posterior of a part that has this offset with this probability according to its neighbours."""
        place = None if offset is None else offset - self.first
        if place is None or not 0 <= place < len(self.probability) or len(self.probability) < 2:
            return self
        prior = np.full(len(self.probability), (1 - probability) / (len(self.probability) - 1))
        prior[place] = probability
        product = prior * self.probability
        return Posterior(self.first, product / product.sum())

    def after(self, offset: int, error: float) -> "Posterior":
        """Return the posterior of a part that had this offset in the frame before, but for this probability.

        Both rest on the same surface and the same code, so they are not independent: where they contradict each other
        neither is sure, but where they agree they are no surer together than the surer one.
        """
        if len(self.probability) == 0:
            side = np.full(_ELSEWHERE, 0.5 * error / _ELSEWHERE)
            return Posterior(offset - _ELSEWHERE, np.concatenate([side, [1 - error], side]))
        both = self.beside(offset, 1 - error)
        least = min(error, self.error(self.best))
        others = both.error(both.best)
        if others >= least:
            return both
        probability = both.probability * (least / max(others, 1e-300))
        probability[both.best - both.first] = 1 - least
        return Posterior(both.first, probability)


NOTHING_KNOWN = Posterior(0, np.zeros(0))


@dataclass(frozen=True)
class AbsoluteOrders:
    """The offsets of a frame's parts: whole cycles to add to their orders to make them absolute."""

    parts: Integers  # (n,) the roots of the parts that are large enough, rising
    posteriors: tuple[Posterior, ...]  # (n,)

    @property
    def offsets(self) -> Integers:
        """(n,) int64: the likeliest offset."""
        return np.array([posterior.best for posterior in self.posteriors], np.int64)

    def error_probability(self, offsets: Integers) -> FloatArray:
        """Return how probably these offsets of the parts are wrong."""
        return np.array([p.error(int(k)) for p, k in zip(self.posteriors, offsets, strict=True)], np.float64)


def _quantiles(
    values: FloatArray,
    shares: tuple[float, float],
    roots: npt.NDArray[np.integer],
    parts: Integers,
    pixels: npt.NDArray[np.integer],
) -> list[FloatArray]:
    """Return, for each share, by part the value below which this share of its pixels lies."""
    sort = np.lexsort((values, roots))
    below = np.cumsum(pixels[sort], dtype=np.float64)
    starts, stops = np.searchsorted(roots[sort], parts), np.searchsorted(roots[sort], parts, side="right")
    start_pixels = np.concatenate([[0.0], below])[starts]
    wanted = (start_pixels + share * (below[stops - 1] - start_pixels) for share in shares)
    return [values[sort[np.minimum(np.searchsorted(below, pixel), stops - 1)]] for pixel in wanted]
