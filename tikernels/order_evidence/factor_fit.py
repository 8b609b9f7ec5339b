"""Fit what the contrasts of a part's blocks have in common besides the code, at many offsets at once.

The logarithm of a block's contrast is the code's at some offset, plus a factor: a plane over the part less a share of
ambient light. Both are fitted robustly at each offset, and the likelihood is that of what the fit leaves.
`docs/coded_pattern.md` has the derivation. A CPU takes several blocks at once where a loop over them only adds up, and
calls no function for exponentials and logarithms.
"""

from enum import IntEnum
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tikernels import runtime
from tikernels._taichi import (
    F32Array1,
    F32Array2,
    F32Array3,
    I32Array1,
    I32Array2,
    Static,
    f32,
    i32,
    mat4,
    ti,
    u1,
    vec2,
    vec4,
    vec32,
)
from tikernels.arrays import F32
from tikernels.launching import kernel
from tikernels.unwrapping.patches import one_thread_is_faster
from tikernels.unwrapping.tables import add_alone

#: Deviation of a block's contrast besides the camera's noise (natural logarithm) where a symbol is one cell, each twice
#: the one before; by half as much where a cycle has one symbol. And the one that is fitted with.
SPREADS = (0.012, 0.024, 0.048, 0.096)
FITTED = 0.016
# How probably a block shows something else than the code, and how far that then lies off.
_OTHER, _OTHER_SIGMA = 0.15, 0.2
# Rounds in which a fit finds out which blocks show something else; they start at the median, which is found by halving.
_ROUNDS, _HALVINGS = 3, 10
#: Levels that represent all of a code's.
LEVELS = 8
#: In place of a response's number: as if all blocks showed the same level, or each one by itself.
EVEN = -1
# At most so much of what is left of a block counts as its surroundings'.
_MOST_LOCAL = 0.2
# So many blocks of a fit take a CPU thread as long as a patch takes.
_BLOCKS_A_PATCH = 10
# Farther than any contrast, and a difference of two that is none.
_FAR, _LEAST = 1e6, 1e-5


class Row(IntEnum):
    """Measurements of each block."""

    LEVEL = 0  # its contrast, natural logarithm
    VARIANCE = 1  # of that, by noise
    COUNTS = 2  # as how many blocks it counts
    DOWN = 3  # of the factor: the plane's slopes, and ambient light; 1 of each is usual
    RIGHT = 4
    DARKER = 5
    OFF = 6  # which share it shows of the difference between the next cycle's level and the last one's
    ORDER = 7  # of its cycle; far outside the code where its ray meets the pattern nowhere
    COLUMN = 8  # and the three that follow: where it looks along the stripe, a polynomial of its cycle, in repeats


ROWS = 12


class Fitted(NamedTuple):
    """Parameters fitted to a part's blocks."""

    likelihood: npt.NDArray[np.float64]
    """(K,) natural logarithm."""
    other: npt.NDArray[np.float64]
    """(K,) under EVEN the same if each block, or cycle, has a level by itself; else 0."""
    terms: npt.NDArray[np.float64]
    """(4, K) of the factor: how much of 1, and of those in `Row`."""
    departs: F32
    """(K, n) what the fit leaves of the blocks."""


@ti.func
def exponential(x: f32) -> f32:
    """Return the exponential function, to 2e-7."""
    power = ti.max(ti.floor(x * 1.44269504 + 0.5), -126.0)
    t = ti.max(x - power * 0.69314718, -0.35)
    series = 1.0 + t * (1.0 + t / 2 * (1.0 + t / 3 * (1.0 + t / 4 * (1.0 + t / 5 * (1.0 + t / 6)))))
    return series * ti.bit_cast((ti.cast(power, ti.i32) + 127) << 23, ti.f32)


@ti.func
def logarithm(x: f32) -> f32:
    """Return the natural logarithm, to 1e-7."""
    bits = ti.bit_cast(x, ti.i32)
    power = (bits - 0x3F3504F3) >> 23  # what is left of the number is about 1
    rest = ti.bit_cast(bits - (power << 23), ti.f32)
    t = (rest - 1.0) / (rest + 1.0)
    return power * 0.69314718 + 2.0 * t * (1.0 + t * t * (1 / 3 + t * t * (1 / 5 + t * t / 7)))


@ti.func
def odds_of_code(depart: f32, near: f32, far: f32) -> f32:
    """Return how much likelier a block shows the code than something else, by how far off it is, and the variances."""
    return (1 - _OTHER) / _OTHER * ti.sqrt(far / near) * exponential(-0.5 * depart * depart * (1 / near - 1 / far))


@ti.func
def log_density(depart: f32, variance: f32, spread: f32) -> f32:
    """Return the logarithm of how usual it is, under a spread, that a block deviates by so much from the code."""
    far = variance + _OTHER_SIGMA**2
    other = logarithm(_OTHER / ti.sqrt(far)) - 0.5 * depart * depart / far
    return other + logarithm(1.0 + odds_of_code(depart, variance + spread * spread, far))


@ti.func
def expected_level(values: Static, levels: Static, n: i32, response: i32, offset: i32, shift: f32) -> f32:
    """Return the code's level where a block is at an offset."""
    last = levels.shape[1] - 1
    cycle = ti.max(ti.min(ti.cast(values[Row.ORDER, n], ti.i32) + offset, last), 0)
    along = values[Row.COLUMN + 2, n] + cycle * values[Row.COLUMN + 3, n]
    along = values[Row.COLUMN, n] + shift + cycle * (values[Row.COLUMN + 1, n] + cycle * along)
    place = ti.min(ti.cast((along - ti.floor(along)) * levels.shape[2], ti.i32), levels.shape[2] - 1)
    change = levels[response, ti.min(cycle + 1, last), place] - levels[response, ti.max(cycle - 1, 0), place]
    return levels[response, cycle, place] + values[Row.OFF, n] * change


@ti.func
def factor_terms(values: Static, n: i32, gain_sigma: f32) -> vec4:
    """Return what the factor is made of at a block; 1 of each is usual."""
    return vec4(gain_sigma, values[Row.DOWN, n], values[Row.RIGHT, n], values[Row.DARKER, n])


@ti.func
def has_order(values: Static, n: i32, offset: i32, cycles: i32, response: i32) -> u1:
    """Return whether the code has the order of a block at an offset."""
    order = values[Row.ORDER, n] + offset
    return (response < 0) | ((order > -0.5) & (order < cycles - 0.5))


@ti.func
def median(departs: Static, f: i32) -> f32:
    """Return the median of a row's numbers."""
    low, high, count = _FAR, -_FAR, departs.shape[1]
    for n in range(count):
        low, high = ti.min(low, departs[f, n]), ti.max(high, departs[f, n] + _LEAST)
    for _ in range(_HALVINGS):
        middle, below = 0.5 * (low + high), 0
        for n in range(count):
            below += ti.select(departs[f, n] < middle, 1, 0)
        low, high = ti.select(2 * below < count, middle, low), ti.select(2 * below < count, high, middle)
    lower, upper = -_FAR, _FAR
    for n in range(count):
        lower = ti.select(departs[f, n] < high, ti.max(departs[f, n], lower), lower)
        upper = ti.select(departs[f, n] < high, upper, ti.min(departs[f, n], upper))
    return ti.select(count % 2 == 0, 0.5 * (lower + upper), lower)


@ti.func
def solved(normal: mat4, right: vec4):
    """Solve normal equations, of which half are given, and return the logarithm of their determinant as well."""
    a, b = normal, right
    for k in ti.static(range(4)):
        for row in ti.static(range(k + 1, 4)):
            share = a[k, row] / a[k, k]
            b[row] -= share * b[k]
            for column in ti.static(range(row, 4)):
                a[row, column] -= share * a[k, column]
    for k in ti.static(range(3, -1, -1)):
        for column in ti.static(range(k + 1, 4)):
            b[k] -= a[k, column] * b[column]
        b[k] /= a[k, k]
    return b, ti.log(a[0, 0] * a[1, 1] * a[2, 2] * a[3, 3])


@ti.func
def log_mean(logarithms: vec4) -> f32:
    """Return the logarithm of the mean of what four logarithms are given of."""
    top = logarithms.max()
    return top + ti.log(ti.exp(logarithms - top).sum() / 4)


@ti.func
def any_level(values: Static, left: Static, any_of: Static, f: i32, by_cycle: i32) -> f32:
    """Return the logarithm of the likelihood if each block, or each cycle, has one of the levels by itself."""
    shown, total, last = vec32(0.0), vec4(0.0), left.shape[1] - 1
    for n in range(last + 1):
        for k in range(4 * LEVELS):
            spread = SPREADS[0] * (1 << k // LEVELS) / (1 + by_cycle)
            density = log_density(left[f, n] - any_of[1 + k % LEVELS], values[Row.VARIANCE, n], spread)
            shown[k] += values[Row.COUNTS, n] * density
        if by_cycle == 0 or n == last or values[Row.ORDER, n] != values[Row.ORDER, ti.min(n + 1, last)]:
            for spread in ti.static(range(4)):
                mean = 0.0
                for k in range(LEVELS):
                    mean += exponential(shown[spread * LEVELS + k]) / LEVELS
                total[spread] += logarithm(mean)
            shown = vec32(0.0)
    return log_mean(total)


@kernel
def fit_factors_kernel(
    serial: Static,  # whether one thread does it
    values: F32Array2,  # (ROWS, n) see `Row`
    level: F32Array2,  # (1 or K, n) the blocks' contrasts: for all fits, or for each
    levels: F32Array3,  # (responses, cycles, places) the code's
    offsets: I32Array1,  # (K,) of each fit
    responses: I32Array1,  # (K,) numbers of responses, or EVEN
    shifts: F32Array1,  # (K,) by how many repeats the code lies further along the stripe
    any_of: F32Array1,  # (1 + LEVELS,) the code's mean level, and levels less it, which stand for all
    gain: f32,  # the usual factor
    gain_sigma: f32,  # by how much a part's differs from it
    gain_known: i32,  # 0: the part's own median is used as the usual factor
    by_cycle: i32,  # 1: all blocks of a cycle have the same level
    departs: F32Array2,  # (K, n) to work with
    out: F32Array2,  # (K, 6) logarithm of the likelihood, the same of other levels, and the factor's terms
):
    """Fit each factor, and weigh what it leaves."""
    ti.loop_config(serialize=serial)
    for f in range(offsets.shape[0]):
        offset, response, count = offsets[f], responses[f], values.shape[1]
        for n in range(count):
            expected = any_of[0]
            if response >= 0:
                expected = expected_level(values, levels, n, response, offset, shifts[f])
            departs[f, n] = level[ti.min(f, level.shape[0] - 1), n] - expected
        # From the median on: what shows something else must not pull at the start.
        usual = median(departs, f)
        fit, cost = vec4(0.0), 0.0
        if gain_known == 1:
            fit[0], usual = (usual - gain) / gain_sigma, gain
        for _ in range(_ROUNDS):
            normal, right = ti.Matrix.identity(ti.f32, 4), vec4(0.0)
            for n in range(count):
                terms, depart = factor_terms(values, n, gain_sigma), departs[f, n] - usual
                near = values[Row.VARIANCE, n] + FITTED**2
                odds = odds_of_code(depart - terms.dot(fit), near, near + _OTHER_SIGMA**2)
                weight = values[Row.COUNTS, n] / near * odds / (1.0 + odds)
                weight = ti.select(has_order(values, n, offset, levels.shape[1], response), weight, 0.0)
                weighted = weight * terms
                for j in ti.static(range(4)):
                    for k in ti.static(range(j, 4)):
                        normal[j, k] += weighted[j] * terms[k]
                right += depart * weighted
            fit, cost = solved(normal, right)
        for n in range(count):
            departs[f, n] = departs[f, n] - usual - factor_terms(values, n, gain_sigma).dot(fit)
        shown = vec4(0.0)
        for n in range(count):
            variance = values[Row.VARIANCE, n]
            outside = logarithm(_OTHER / ti.sqrt(variance + _OTHER_SIGMA**2))
            inside = has_order(values, n, offset, levels.shape[1], response)
            for k in ti.static(range(4)):
                density = ti.select(inside, log_density(departs[f, n], variance, SPREADS[k] / (1 + by_cycle)), outside)
                shown[k] += values[Row.COUNTS, n] * density
        out[f, 0] = log_mean(shown) - 0.5 * (cost + fit.dot(fit))
        out[f, 1] = 0.0
        if response < 0:
            out[f, 1] = any_level(values, departs, any_of, f, by_cycle)
        out[f, 2] = usual + gain_sigma * fit[0]
        for k in ti.static(range(1, 4)):
            out[f, 2 + k] = fit[k]


@ti.func
def plane_at(values: Static, terms: Static, f: i32, n: i32) -> f32:
    """Return a factor at a block, less that of its part's middle."""
    slopes = terms[f, 1] * values[Row.DOWN, n] + terms[f, 2] * values[Row.RIGHT, n]
    return slopes + terms[f, 3] * values[Row.DARKER, n]


@kernel
def flatten_kernel(
    serial: Static,  # whether one thread does it
    values: F32Array2,  # (ROWS, n) see `Row`
    cells: I32Array2,  # (3, n) row, column and class of brightness
    levels: F32Array3,  # (responses, cycles, places) the code's
    offsets: I32Array1,  # (K,)
    terms: F32Array2,  # (K, 4) of the factors
    response: i32,
    rows: i32,  # of cells
    reach_down: i32,
    reach_right: i32,
    step: i32,  # of so many blocks one is wanted
    sums: F32Array3,  # (2 classes, K, (rows + 1) (columns + 1)) to work with
    out: F32Array2,  # (K, wanted)
):
    """Take off the blocks' contrasts what the factor, and the blocks around, are off the code."""
    ti.loop_config(serialize=serial)
    for f in range(offsets.shape[0]):
        line = sums.shape[2] // (rows + 1)
        for k, cell in ti.ndrange(sums.shape[0], sums.shape[2]):
            sums[k, f, cell] = 0.0
        for n in range(values.shape[1]):
            expected = terms[f, 0] + plane_at(values, terms, f, n)
            expected += expected_level(values, levels, n, response, offsets[f], 0.0)
            cell = (cells[0, n] + 1) * line + cells[1, n] + 1
            depart = ti.max(ti.min(values[Row.LEVEL, n] - expected, _MOST_LOCAL), -_MOST_LOCAL)
            add_alone(sums[2 * cells[2, n], f, cell], depart)
            add_alone(sums[2 * cells[2, n] + 1, f, cell], 1.0)
        # Of all cells above and to the left: four places give a window's sum.
        for k, row in ti.ndrange(sums.shape[0], (1, rows + 1)):
            total = 0.0
            for cell in range(row * line + 1, (row + 1) * line):
                total += sums[k, f, cell]
                sums[k, f, cell] = total + sums[k, f, cell - line]
        for m in range(out.shape[1]):
            n = m * step
            top, bottom = ti.max(cells[0, n] - reach_down, 0), ti.min(cells[0, n] + reach_down + 1, rows)
            left, right = ti.max(cells[1, n] - reach_right, 0), ti.min(cells[1, n] + reach_right + 1, line - 1)
            around = vec2(0.0)
            for c in range(ti.max(cells[2, n] - 1, 0), ti.min(cells[2, n] + 2, sums.shape[0] // 2)):
                for k in ti.static(range(2)):
                    around[k] += sums[2 * c + k, f, bottom * line + right] - sums[2 * c + k, f, bottom * line + left]
                    around[k] -= sums[2 * c + k, f, top * line + right] - sums[2 * c + k, f, top * line + left]
            out[f, m] = values[Row.LEVEL, n] - plane_at(values, terms, f, n) - around[0] / around[1]


def fit_factors(
    values: npt.NDArray[np.float32],
    levels: npt.NDArray[np.float32],
    any_of: npt.NDArray[np.float32],
    offsets: npt.NDArray[np.integer],
    responses: npt.NDArray[np.integer] | int,
    shifts: npt.NDArray[np.floating] | float,
    gain: tuple[float | None, float],
    *,
    by_cycle: bool,
    level: npt.NDArray[np.float32] | None = None,
) -> Fitted:
    """Fit a part's factor at several offsets.

    Parameters
    ----------
    values : (ROWS, n) float32
        The blocks; see `Row`. Under EVEN those of a cycle lie side by side if they have one level.
    levels : (responses, cycles, places) float32
        The code's, natural logarithm.
    any_of : (1 + LEVELS,) float32
        The mean level, which all blocks show under EVEN; and levels less it that stand for all, one of which each block
        shows there, or each cycle, otherwise.
    offsets : (K,) int
        Whole cycles that the orders lack.
    responses : (K,) int
        Numbers of responses, or EVEN.
    shifts : (K,) float
        By how many repeats the code lies further along the stripe.
    gain : two float
        The usual factor, if it is known, and by how much a part's differs from it, as a standard deviation.
    by_cycle : bool
        True if all blocks of a cycle have the same level.
    level : (K, n) float32, optional
        The blocks' contrasts in each fit, if not as they were seen.
    """
    count, blocks = len(offsets), values.shape[1]
    departs, out = runtime.empty((count, blocks), np.float32), np.empty((count, 6), np.float32)
    seen = values, values[: Row.LEVEL + 1] if level is None else level, levels
    at_each = offsets.astype(np.int32), np.broadcast_to(responses, count).astype(np.int32)
    further = np.broadcast_to(shifts, count).astype(np.float32)
    rule = any_of, gain[0] or 0.0, gain[1], gain[0] is not None, by_cycle
    serial = one_thread_is_faster(count * blocks // _BLOCKS_A_PATCH)
    fit_factors_kernel(serial, *seen, *at_each, further, *rule, departs, out)
    likelihood, other, *terms = out.T.astype(np.float64)
    return Fitted(likelihood, other, np.array(terms), departs)


def flatten(
    values: npt.NDArray[np.float32],
    cells: npt.NDArray[np.int32],
    offsets: npt.NDArray[np.integer],
    terms: npt.NDArray[np.floating],
    levels: npt.NDArray[np.float32],
    response: int,
    reach: tuple[int, int],
    step: int,
) -> npt.NDArray[np.float32]:
    """Return the levels of a part's blocks as if its factor were the same all over.

    What those around each block that are about as bright are off the code on the mean is taken off, too: another paint
    has a factor of its own.

    Parameters
    ----------
    values : (ROWS, n) float32
        The blocks; see `Row`.
    cells : (3, n) int32
        Row, column and class of brightness of each, from 0; classes side by side are about as bright.
    offsets : (K,) int
        Whole cycles that the orders lack: each is tried as the part's.
    terms : (4, K) float
        The factors there.
    levels : (responses, cycles, places) float32
        The code's, natural logarithm.
    response : int
        Number of the frame's.
    reach : two int
        So many rows and columns away other blocks count.
    step : int
        Of so many blocks the level of one is wanted.

    Returns
    -------
    (K, wanted) float32
    """
    rows, columns, classes = (int(places.max()) + 1 for places in cells)
    sums = runtime.empty((2 * classes, len(offsets), (rows + 1) * (columns + 1)), np.float32)
    out = np.empty((len(offsets), -(-values.shape[1] // step)), np.float32)
    at_each = offsets.astype(np.int32), np.ascontiguousarray(terms.T, np.float32)
    serial = one_thread_is_faster(len(offsets) * values.shape[1] // _BLOCKS_A_PATCH)
    flatten_kernel(serial, values, cells, levels, *at_each, response, rows, *reach, step, sums, out)
    return out
