"""Smooth the phase over a square window, without crossing a step and without rounding what bends.

A plane and its bend are fitted to the window (Savitzky and Golay 1964, doi:10.1021/ac60214a047): seven pixels both ways
leave 0.27 of the noise, and 0.80 of a relief that repeats every seven pixels, along the stripes as across them. The
least-squares quadric of a square window is put together of means and quadrics of its rows and columns,

    quadric = mean along (quadric across) + quadric along (mean across) - mean along (mean across),

so the rows are smoothed first, then the columns. Neighbours count in pairs, one on either side, so that a slope leaves
no bias, and only where the surface goes on from one to the other: near a step fewer count. Across the stripes a phase's
variance changes with the phase, and pairs count by it.

A pixel at a step sees both surfaces and has a phase between them that belongs to neither: such pixels are dropped.
"""

from enum import IntEnum
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from tikernels import checks, runtime
from tikernels._taichi import F32Array2, Static, U8Array2, f32, ti
from tikernels.arrays import F32, U8, Mask
from tikernels.errors import ShapeError
from tikernels.lanes import (
    LANES,
    Lanes,
    as_lanes,
    lane_count,
    lanes_at,
    load_around,
    load_lanes,
    load_lanes_of,
    planes,
    put_back,
    store_lanes,
    store_lanes_of,
    whole_rows,
    width_of,
)
from tikernels.launching import kernel
from tikernels.phase.phase_change import RATE_ACROSS, RATE_ALONG, measure_rates, rates_shape
from tikernels.phase.phase_vector import PI, TINY, absolute_lanes, wrap, wrap_lanes
from tikernels.phase.wrapped_phase import LEAST_NO_PHASE, NO_PHASE, STEP_PHASE, mark_no_phase_kernel

# A pair of neighbours counts while each is within a radian of what the usual change leads to, and the surface bends
# less between them than noise makes it, four standard deviations; or than the least, which round surfaces do within a
# few px. Beyond the most, about 4 mm on a rig with 0.14 rad per mm, it is a step.
_BEND_SIGMAS = 4.0
_LEAST_BEND, _MAX_BEND = 0.1, 0.6
_MAX_CHANGE = 1.0
# A neighbour that departs by more than this from the usual change lies on another surface: 0.8 rad is a depth step of
# 6 mm on that rig; noise of 0.2 rad per pixel passes.
MAX_DEPARTURE = 0.8
# Departures beyond this mean that there is no neighbour: no two phases are that far apart.
NO_NEIGHBOUR = 0.5 * NO_PHASE
# A pixel at a step that departs by less than this from one side belongs to that side.
_SAME_SURFACE = 0.3
# What is known of the bend beforehand, as if seen by this sum of fourth powers of distances, px^4: where only the next
# neighbours count, half of the pixel's own phase stays; where all do, it changes nothing.
_BEND_PRIOR = 2.0
#: Weights of rows in a third difference.
THIRD_DIFFERENCE = (1, -3, 3, -1)
#: The largest window: each neighbour more takes longer to compile.
MAX_SMOOTHING_PX = 15


class _Row(IntEnum):
    """Planes that smoothing along the rows keeps in addition to their means."""

    BEND = 0  # what the quadric adds to the mean, rad
    MEAN_VARIANCE = 1  # rad^2, of the mean
    FIT_VARIANCE = 2  # and of the quadric


@ti.func
def between_surfaces(one: Static, other: Static):
    """Return lanes that are above zero where a pixel this far from its neighbours belongs to neither's surface."""
    low, high = ti.min(one, other), ti.max(one, other)
    farthest = ti.select(high < NO_NEIGHBOUR, high, low)
    step = ti.select(farthest < NO_NEIGHBOUR, farthest - MAX_DEPARTURE, -1.0)
    return ti.select(low > _SAME_SURFACE, step, -1.0)


@ti.func
def departure(difference: Static, rate: f32):
    """Return lanes of how far differences of two phases are from the usual change, modulo a cycle, rad."""
    size = absolute_lanes(difference - rate)
    return ti.min(size, absolute_lanes(size - 2.0 * PI))


@ti.func
def pair_counts(one: Static, other: Static, variance: Static):
    """Return lanes of how much a pair of neighbours counts, 0 to 1, that differ by this from a pixel; rad.

    The phase may bend between the two by as much as noise does, given the variance of the sum of their differences.
    """
    per_bend = 1.0 / ti.min(ti.max(_BEND_SIGMAS * ti.sqrt(variance), _LEAST_BEND), _MAX_BEND)
    # Fading, so that rounding decides nothing.
    counts = ti.min(ti.max(2.5 - 2.0 * absolute_lanes(one + other) * per_bend, 0.0), 1.0)
    return ti.select(ti.max(absolute_lanes(one), absolute_lanes(other)) < _MAX_CHANGE, counts, 0.0)


@ti.func
def change_over(rate: f32, tap: Static) -> f32:
    """Return the usual change over some pixels, rad in [-pi, pi]."""
    change = tap * rate
    return change - 2.0 * PI * ti.round(change / (2.0 * PI))


@ti.func
def quadric_weights(count: f32, squares: f32, fourths: f32):
    """Return a and b: the quadric's value in the middle is the sum of (a - b distance^2) times the phases.

    Of the sums over a row's pixels that count: their number, squares of their distances (px), and fourth powers.
    """
    curved = fourths + _BEND_PRIOR
    scale = 1.0 / (count * curved - squares * squares)
    return curved * scale, squares * scale


@ti.func
def quadric_share(a: f32, b: f32, count: f32, squares: f32, fourths: f32) -> f32:
    """Return what the quadric leaves of a variance."""
    return a * a * count - 2.0 * a * b * squares + b * b * fourths


@cache
def _smooth_rows_kernel(pairs: int, wide: bool) -> Any:
    """Return the kernel that fits `pairs` neighbours on either side along the rows."""
    reach = max(pairs, 1)

    lanes = Lanes.of(wide)

    @kernel(whole_vectors=wide)
    def smooth_rows_kernel(
        phase: planes(wide),  # (H, W) rad, up to 0.6 beyond +-pi; NO_PHASE outside the mask
        precision: planes(wide),  # (H, W) 1 / rad^2: one over the phase's variance
        rates: F32Array2,  # last row: RATE_ALONG, RATE_ACROSS ..., rad per px
        out: planes(wide),  # (H, W) rad, the rows' means; NO_PHASE outside the mask, STEP_PHASE between two surfaces
        out_rows: planes(wide, ndim=3),  # (3, H, W) see `_Row`
    ):
        height, width = phase.shape[0], width_of(phase, wide)
        last = rates.shape[0] - 1
        for t in range(height * lane_count(width, wide)):
            y, place = lanes_at(t, width, wide)
            above, below = ti.max(y - 1, 0), ti.min(y + 1, height - 1)
            rate_along, rate_across = rates[last, RATE_ALONG], rates[last, RATE_ACROSS]
            values = load_around(phase, lanes.three_floats, y, place, width, reach, NO_PHASE, wide)
            upper = load_lanes(phase, lanes.floats, above, place, width, wide)
            lower = load_lanes(phase, lanes.floats, below, place, width, wide)
            certainty = load_lanes(precision, lanes.floats, y, place, width, wide)
            centre, left, right = lanes.floats(0.0), lanes.floats(0.0), lanes.floats(0.0)
            for k in range(lanes.count):
                centre[k] = values[lanes.count + k]
                left[k], right[k] = values[lanes.count + k - 1], values[lanes.count + k + 1]
            # Without a neighbour the differences stay far beyond any phase.
            to_left = absolute_lanes(wrap_lanes(left - centre) + rate_along)
            to_right = absolute_lanes(wrap_lanes(right - centre) - rate_along)
            to_upper, to_lower = departure(centre - upper, rate_across), departure(lower - centre, rate_across)
            to_upper = ti.max(to_upper, ti.select(above == y, 2.0 * NO_NEIGHBOUR, 0.0))
            to_lower = ti.max(to_lower, ti.select(below == y, 2.0 * NO_NEIGHBOUR, 0.0))
            step = ti.max(between_surfaces(to_left, to_right), between_surfaces(to_upper, to_lower))
            variance = 1.0 / (certainty + TINY)
            total, total_2, fourths = lanes.floats(0.0), lanes.floats(0.0), lanes.floats(0.0)
            count, squares = lanes.floats(1.0), lanes.floats(0.0)
            for tap in ti.static(range(1, pairs + 1)):
                change = change_over(rate_along, tap)
                for k in range(lanes.count):
                    left[k], right[k] = values[lanes.count + k - tap], values[lanes.count + k + tap]
                one, other = wrap_lanes(left - centre + change), wrap_lanes(right - centre - change)
                counts = pair_counts(one, other, 6.0 * variance)
                both = ti.select(counts > 0.0, counts * (one + other), 0.0)
                total, total_2 = total + both, total_2 + tap * tap * both
                count, squares = count + 2.0 * counts, squares + 2.0 * tap * tap * counts
                fourths += 2.0 * tap**4 * counts
            a, b = quadric_weights(count, squares, fourths)
            # A pixel between two surfaces has nothing but itself, should one of them claim it.
            mean = ti.select(step > 0.0, STEP_PHASE, centre + total / count)
            mean = ti.select(centre < LEAST_NO_PHASE, mean, NO_PHASE)
            bend = ti.select(step > 0.0, 0.0, a * total - b * total_2 - total / count)
            mean_variance = variance * ti.select(step > 0.0, 1.0, 1.0 / count)
            fit_variance = variance * ti.select(step > 0.0, 1.0, quadric_share(a, b, count, squares, fourths))
            store_lanes(out, y, place, width, mean, wide)
            store_lanes_of(out_rows, _Row.BEND, y, place, width, bend, wide)
            store_lanes_of(out_rows, _Row.MEAN_VARIANCE, y, place, width, mean_variance, wide)
            store_lanes_of(out_rows, _Row.FIT_VARIANCE, y, place, width, fit_variance, wide)

    return smooth_rows_kernel


@ti.func
def change_across(near: f32, far: f32, change: f32, wraps: Static) -> f32:
    """Return how far a pixel in another row departs from the usual change, rad."""
    departs = far - near - change
    return wrap_lanes(departs) if ti.static(wraps) else departs


@cache
def _smooth_columns_kernel(pairs: int, wraps: bool, wide: bool) -> Any:
    """Return the kernel that fits `pairs` neighbours on either side across the rows, of rows that are smoothed."""
    lanes = Lanes.of(wide)

    @kernel(whole_vectors=wide)
    def smooth_columns_kernel(
        phase: planes(wide),  # (H, W) rad, the rows' means; without whole cycles if it `wraps`
        mask: planes(wide, ti.u8),  # (H, W)
        rows: planes(wide, ndim=3),  # (3, H, W) see `_Row`
        rates: F32Array2,  # last row: RATE_ALONG, RATE_ACROSS ..., rad per px
        out: planes(wide),  # (H, W) rad; NaN outside the mask
        out_variance: planes(wide),  # (H, W) rad^2
    ):
        height, width = out.shape[0], width_of(out, wide)
        last = rates.shape[0] - 1
        for t in range(height * lane_count(width, wide)):
            y, place = lanes_at(t, width, wide)
            rate = rates[last, RATE_ACROSS]
            centre = load_lanes(phase, lanes.floats, y, place, width, wide)
            holds = load_lanes(mask, lanes.bytes, y, place, width, wide)
            bend = load_lanes_of(rows, lanes.floats, _Row.BEND, y, place, width, wide)
            variance = load_lanes_of(rows, lanes.floats, _Row.MEAN_VARIANCE, y, place, width, wide)
            count, squares, fourths = lanes.floats(1.0), lanes.floats(0.0), lanes.floats(0.0)
            total, total_2, total_bend = lanes.floats(0.0), lanes.floats(0.0), lanes.floats(0.0)
            for tap in ti.static(range(1, pairs + 1)):
                if y >= tap and y + tap < height:
                    change = change_over(rate, tap) if ti.static(wraps) else tap * rate
                    above, below = y - tap, y + tap
                    upper = load_lanes(phase, lanes.floats, above, place, width, wide)
                    lower = load_lanes(phase, lanes.floats, below, place, width, wide)
                    holds_above = load_lanes(mask, lanes.bytes, above, place, width, wide)
                    holds_below = load_lanes(mask, lanes.bytes, below, place, width, wide)
                    bends = load_lanes_of(rows, lanes.floats, _Row.BEND, above, place, width, wide)
                    bends += load_lanes_of(rows, lanes.floats, _Row.BEND, below, place, width, wide)
                    others = load_lanes_of(rows, lanes.floats, _Row.MEAN_VARIANCE, above, place, width, wide)
                    others += load_lanes_of(rows, lanes.floats, _Row.MEAN_VARIANCE, below, place, width, wide)
                    one = change_across(centre, upper, -change, wraps)
                    other = change_across(centre, lower, change, wraps)
                    counts = pair_counts(one, other, others + 4.0 * variance)
                    for k in range(lanes.count):
                        hold = (holds[k] != 0) & (holds_above[k] != 0) & (holds_below[k] != 0)
                        counts[k] = ti.select(hold, counts[k], 0.0)
                    weight = counts * 2.0 * variance / others
                    both = ti.select(counts > 0.0, weight * (one + other), 0.0)
                    total, total_2 = total + both, total_2 + tap * tap * both
                    total_bend += weight * bends
                    count, squares = count + 2.0 * weight, squares + 2.0 * tap * tap * weight
                    fourths += 2.0 * tap**4 * weight
            fit_variance = load_lanes_of(rows, lanes.floats, _Row.FIT_VARIANCE, y, place, width, wide)
            a, b = quadric_weights(count, squares, fourths)
            fitted = centre + a * total - b * total_2 + (bend + total_bend) / count
            # A row's mean and what its quadric adds to it are uncorrelated.
            of_bend = (fit_variance - variance) / count
            left = variance * quadric_share(a, b, count, squares, fourths) + of_bend
            for k in range(lanes.count):
                centre[k] = ti.select(holds[k] != 0, fitted[k], ti.math.nan)
                variance[k] = ti.select(holds[k] != 0, left[k], variance[k])
            store_lanes(out, y, place, width, centre, wide)
            store_lanes(out_variance, y, place, width, variance, wide)

    return smooth_columns_kernel


def _window(pairs: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return the weights of mean and quadric where all pairs count, (2 pairs + 1,) each."""
    place = np.arange(-pairs, pairs + 1.0)
    count, squares, fourths = (float(np.sum(place**power)) for power in (0, 2, 4))
    curved = fourths + _BEND_PRIOR
    quadric = (curved - squares * place**2) / (count * curved - squares**2)
    return np.full(len(place), 1 / count), quadric


def left_of_variance(pairs: int) -> float:
    """Return which share of the variance smoothing leaves where all pairs count, along the rows and across them."""
    mean, quadric = _window(pairs)
    left, bend = float(mean @ mean), float(quadric @ quadric - mean @ mean)
    return left * float(quadric @ quadric) + bend * left


def left_of_relief(pairs: int, period_px: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the share of a low relief that smoothing leaves where all pairs count, by its period (N,) px.

    It is the same along the rows and across them.
    """
    place = np.arange(-pairs, pairs + 1.0)
    return np.asarray(np.cos(2 * np.pi * place / period_px[:, None]) @ _window(pairs)[1])


def left_of_differences(pairs: int, step: int) -> float:
    """Return the variance of third differences over rows this many px apart, for a variance of one before smoothing."""
    third = np.zeros((len(THIRD_DIFFERENCE) - 1) * step + 1)
    third[::step] = THIRD_DIFFERENCE
    mean, quadric = _window(pairs)
    across = [float(np.sum(np.convolve(third, weights) ** 2)) for weights in (mean, quadric)]
    left, bend = float(mean @ mean), float(quadric @ quadric - mean @ mean)
    return left * across[1] + bend * across[0]


class Smoother:
    """Smooths phases of one size: first the rows, and when the whole cycles are known the columns.

    In between the phases may be unwrapped, and corrected by what their order shows, as `modulation_correction.py` does:
    along the stripes that is the same for all pixels of a window, across them it is not.

    Parameters
    ----------
    height, width : int
        Of the image.
    pairs : int
        Neighbours on either side that count, along the rows and across them, 0 or more.
    """

    def __init__(self, height: int, width: int, pairs: int) -> None:
        self.shape = (height, width)
        self._pairs = pairs
        self._rows = runtime.empty((len(_Row), height, -(-width // LANES) * LANES), np.float32)

    def along(self, phase: F32, precision: F32, rates: F32, out: F32 | None = None) -> F32:
        """Average the phase along the rows, keep what its bend adds, and mark the pixels between two surfaces.

        Parameters
        ----------
        phase : (H, W) float32
            rad, up to 0.6 beyond [-pi, pi]; NO_PHASE outside the mask.
        precision : (H, W) float32
            1 / rad^2, one over the phase's variance; 0 where nothing is known of it.
        rates : (H / 8 + 1, 5) float32
            Results of `measure_rates` of the same phase.
        out : (H, W) float32, optional
            Output array; not the input.

        Returns
        -------
        (H, W) float32
            rad, a little beyond [-pi, pi]; NO_PHASE outside the mask, STEP_PHASE between two surfaces.

        Raises
        ------
        ShapeError
            A shape or dtype is another one, or `out` cannot be written.
        """
        phase = checks.read_array("phase", phase, self.shape, np.float32)
        precision = checks.read_array("precision", precision, self.shape, np.float32)
        rates = checks.read_array("rates", rates, rates_shape(self.shape[0]), np.float32)
        out = checks.out_buffer("out", out, self.shape, np.float32)
        rows, wide = whole_rows(phase, precision, out, beyond=NO_PHASE)
        seen, means = [as_lanes(array, wide) for array in rows[:2]], as_lanes(rows[2], wide)
        _smooth_rows_kernel(self._pairs, wide)(*seen, rates, means, as_lanes(self._rows, wide))
        put_back(rows[2], out)
        return out

    def across(
        self,
        phase: F32,
        mask: U8,
        rates: F32,
        out: tuple[F32, F32] | None = None,
        *,
        wraps: bool = False,
    ) -> tuple[F32, F32]:
        """Fit the columns of what `along` has averaged last.

        Parameters
        ----------
        phase : (H, W) float32
            rad, that average with whole cycles.
        mask : (H, W) uint8
            True where it holds.
        rates : (H / 8 + 1, 5) float32
            Results of `measure_rates`.
        out : two (H, W) float32, optional
            Output arrays; not the input.
        wraps : bool
            True if the phase lacks the whole cycles: rad in [-pi, pi] and a little beyond.

        Returns
        -------
        phase : (H, W) float32
            rad; NaN outside the mask.
        variance : (H, W) float32
            rad^2, by the precisions that `along` was given; of independent noise.

        Raises
        ------
        ShapeError
            A shape or dtype is another one, or `out` cannot be written.
        """
        phase = checks.read_array("phase", phase, self.shape, np.float32)
        mask = checks.read_array("mask", mask, self.shape, np.uint8)
        rates = checks.read_array("rates", rates, rates_shape(self.shape[0]), np.float32)
        smoothed, variance = (None, None) if out is None else out
        smoothed = checks.out_buffer("out[0]", smoothed, self.shape, np.float32)
        variance = checks.out_buffer("out[1]", variance, self.shape, np.float32)
        rows, wide = whole_rows(phase, mask, smoothed, variance)
        seen = [as_lanes(array, wide) for array in (*rows[:2], self._rows)]
        _smooth_columns_kernel(self._pairs, wraps, wide)(*seen, rates, *(as_lanes(array, wide) for array in rows[2:]))
        put_back(rows[2], smoothed)
        put_back(rows[3], variance)
        return smoothed, variance


@kernel
def restore_kernel(
    wrapped_phase: F32Array2,  # (H, W) rad
    smoothed: F32Array2,  # (H, W) rad, a little beyond +-pi
    held: U8Array2,  # (H, W) where that is
    out: F32Array2,  # (H, W) rad in [-pi, pi]; elsewhere what it was
):
    for pixel in range(out.shape[0] * out.shape[1]):
        y, x = pixel // out.shape[1], pixel % out.shape[1]
        out[y, x] = wrap(smoothed[y, x]) if held[y, x] != 0 else wrapped_phase[y, x]


def smooth_phase(wrapped_phase: F32, mask: Mask, smoothing_px: int = 7, *, out: F32 | None = None) -> F32:
    """Smooth the phase over a square window.

    Parameters
    ----------
    wrapped_phase : (H, W) float32
        rad in [-pi, pi], stripes running along the rows.
    mask : (H, W) bool or uint8
        Valid pixels.
    smoothing_px : int
        Odd side of the window, 1 to 15 px.
    out : (H, W) float32, optional
        Output array; not the input.

    Returns
    -------
    (H, W) float32
        rad in [-pi, pi]; unchanged outside the mask and at steps. Neighbours count in pairs on either side, and only
        while the surface goes on, so steps stay sharp, slopes unbiased and round surfaces round.

    Raises
    ------
    ShapeError
        A shape or dtype is another one, the window is even or too large, or `out` cannot be written.
    """
    wrapped_phase = checks.read_array("wrapped_phase", wrapped_phase, (None, None), np.float32)
    shape = (int(wrapped_phase.shape[0]), int(wrapped_phase.shape[1]))
    mask = checks.read_mask("mask", mask, shape)
    if smoothing_px % 2 == 0 or not 1 <= smoothing_px <= MAX_SMOOTHING_PX:
        raise ShapeError(f"smoothing_px is {smoothing_px}: take an odd number from 1 to {MAX_SMOOTHING_PX}")
    out = checks.out_array("out", out, shape, np.float32)
    marked = np.empty(shape, np.float32)
    mark_no_phase_kernel(wrapped_phase, mask, marked)
    rates = measure_rates(marked, np.ones(shape, np.float32))
    smoother = Smoother(*shape, smoothing_px // 2)
    rows = runtime.to_host(smoother.along(marked, np.zeros(shape, np.float32), rates))
    held = (rows < LEAST_NO_PHASE).astype(np.uint8)
    smoothed, _ = smoother.across(rows, held, rates, wraps=True)
    restore_kernel(wrapped_phase, smoothed, held, out)
    return out
