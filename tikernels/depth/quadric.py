"""A weighted quadric around a pixel, over the pixels that are linked with it.

Of the pixels at distances (u, v) around one those count that links lead to: along the column first, then along the row.
Least squares with the weights

    w = (1 - u^2 / r^2) (1 - v^2 / r^2) (sigma_0 / sigma)^2

find z = a + b_u u + b_v v + c_uu u^2 + c_uv u v + c_vv v^2, of 7 x 7 samples that are a stride apart. Where too few are
linked to determine the curvature, a weak prior (that there is none) leaves a plane.

A window that ends on one side of the pixel hardly separates curvature from slope. There the plane a + b_u u + b_v v is
used where curvature explains no more than noise does: where it lowers the weighted sum of squares by less than
sigma_0^2, times what the errors have in common.
"""

from enum import IntEnum

import numpy as np
import numpy.typing as npt

from tikernels import runtime
from tikernels._taichi import F32Array2, F32Array4, Static, U8Array2, U8Array3, f32, i32, mat3, mat6, ti, vec3, vec6
from tikernels.arrays import F32, U8
from tikernels.depth.step_cutting import DOWN, RIGHT
from tikernels.launching import kernel
from tikernels.strips import SPREAD, STRIP, strip_at, strip_count

#: Samples on either side of the pixel, and the largest distance that links are followed to, px: four to a sample.
SIDE = 3
FARTHEST = 4 * SIDE
# What is left of a pixel's variance by samples 1, 2 and 4 px apart, over what would be left if their errors had nothing
# in common: by the errors' correlations after the phase's smoothing (docs/method.md, 7).
_ALIKE = (6.2, 3.0, 1.1)
# Weight of the prior that a surface is flat, of the middle pixel's: seen only where nothing else shows its curvature.
_FLAT = 1e-3
# And that it does not slope.
_LEVEL = 1e-5
# What a bend must explain at the end of a window, in variances of the middle pixel; noise alone explains three, where
# sigma is right. Normals at the rims of a simulated bust and the wall behind it err by 2.7 degrees in the median; by
# 4.3 without this. Three would do better on walls, and worse on heads.
_LEAST_BEND = 1.0
# Precisions below count as this: of pixels that do not count, whose fits are of no account.
_LEAST = 1e-20
#: Windows of samples 1, 2 and 4 px apart.
WINDOWS = 3
# Sums of w u^a v^b up to the fourth power together, by b and then a; and behind them of w z u^a v^b up to the second.
_SUMS, _RIGHT_SIDE = 21, 15
_lanes, _whole_lanes = ti.types.vector(STRIP, ti.f32), ti.types.vector(STRIP, ti.i32)
_window_sums = ti.types.matrix(_SUMS, STRIP, ti.f32)
# A piece of a row with all that its windows reach.
_segment = ti.types.vector(STRIP + 2 * FARTHEST, ti.f32)


class Run(IntEnum):
    """Number of pixels in a row, or a column, that are linked with one."""

    LEFT = 0
    RIGHT = 1
    ABOVE = 2
    BELOW = 3


class Fit(IntEnum):
    """Results of a quadric at its pixel."""

    VALUE = 0  # above the pixel's own
    SLOPE_DOWN = 1  # a px
    SLOPE_RIGHT = 2
    VARIANCE = 3  # of the value


@ti.func
def solved(normal: Static, rest: Static, count: Static):
    """Return the last three unknowns, the last one first, its share of the variance, and what they explain.

    That is by how much they make the weighted sum of squares less.
    """
    # The share is at the end of the elimination.
    explained = 0.0
    for p in ti.static(range(count)):
        reciprocal = 1.0 / ti.max(normal[p, p], 1e-9)
        explained += rest[p] * rest[p] * reciprocal
        for row in ti.static(range(p + 1, count)):
            factor = normal[row, p] * reciprocal
            for column in ti.static(range(p + 1, count)):
                normal[row, column] -= factor * normal[p, column]
            rest[row] -= factor * rest[p]
    n = ti.static(count)
    share = 1.0 / ti.max(normal[n - 1, n - 1], 1e-9)
    last = rest[n - 1] * share
    second = (rest[n - 2] - normal[n - 2, n - 1] * last) / ti.max(normal[n - 2, n - 2], 1e-9)
    third = (rest[n - 3] - normal[n - 3, n - 2] * second - normal[n - 3, n - 1] * last) / ti.max(
        normal[n - 3, n - 3], 1e-9
    )
    return last, second, third, share, explained


@ti.func
def quadric_of(sums: Static, lane: i32, least: f32):
    """Return value and slopes of a lane's quadric by its sums (see `_SUMS`), and the value's share of the variance.

    They are those of the plane where the bend explains less than `least`.
    """
    m00, m01, m02, m03, m04 = sums[0, lane], sums[1, lane], sums[2, lane], sums[3, lane], sums[4, lane]
    m10, m11, m12, m13 = sums[5, lane], sums[6, lane], sums[7, lane], sums[8, lane]
    m20, m21, m22 = sums[9, lane], sums[10, lane], sums[11, lane]
    m30, m31, m40 = sums[12, lane], sums[13, lane], sums[14, lane]
    # In the order u^2, u v, v^2, u, v, 1.
    normal = mat6(
        [
            [m04 + _FLAT, m13, m22, m03, m12, m02],
            [m13, m22 + _FLAT, m31, m12, m21, m11],
            [m22, m31, m40 + _FLAT, m21, m30, m20],
            [m03, m12, m21, m02 + _LEVEL, m11, m01],
            [m12, m21, m30, m11, m20 + _LEVEL, m10],
            [m02, m11, m20, m01, m10, m00],
        ]
    )
    rest = vec6(
        sums[_RIGHT_SIDE + 2, lane],
        sums[_RIGHT_SIDE + 4, lane],
        sums[_RIGHT_SIDE + 5, lane],
        sums[_RIGHT_SIDE + 1, lane],
        sums[_RIGHT_SIDE + 3, lane],
        sums[_RIGHT_SIDE, lane],
    )
    value, down, right, share, explained = solved(normal, rest, 6)
    # In the order u, v, 1.
    flat_normal = mat3([[m02 + _LEVEL, m11, m01], [m11, m20 + _LEVEL, m10], [m01, m10, m00]])
    flat_rest = vec3(sums[_RIGHT_SIDE + 1, lane], sums[_RIGHT_SIDE + 3, lane], sums[_RIGHT_SIDE, lane])
    flat_value, flat_down, flat_right, flat_share, flat_explained = solved(flat_normal, flat_rest, 3)
    flat = explained - flat_explained < least
    value, share = ti.select(flat, flat_value, value), ti.select(flat, flat_share, share)
    return value, ti.select(flat, flat_down, down), ti.select(flat, flat_right, right), share


@ti.func
def add_row(
    sums: Static,
    values: Static,
    weights: Static,
    middle: Static,
    scale: Static,
    left: Static,
    right: Static,
    v: f32,
    stride: i32,
):
    """Add a row's samples to the sums of every lane: values above the middle's, by weights and the lane's scale.

    `left` and `right` say how many samples count.
    """
    v2 = v * v
    for lane in range(STRIP):
        place = lane + FARTHEST
        s0, t0 = weights[place], weights[place] * (values[place] - middle[lane])
        s1, s2, s3, s4, t1, t2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        # Two samples at a time, as far to the left as to the right.
        for i in ti.static(range(1, SIDE + 1)):
            tap = ti.static(1.0 - i * i / (SIDE + 1) ** 2)
            one, other = place - i * stride, place + i * stride
            w1 = ti.select(i <= left[lane], tap * weights[one], 0.0)
            w2 = ti.select(i <= right[lane], tap * weights[other], 0.0)
            z1, z2 = w1 * (values[one] - middle[lane]), w2 * (values[other] - middle[lane])
            s0 += w2 + w1
            s1 += i * (w2 - w1)
            s2 += ti.static(i**2) * (w2 + w1)
            s3 += ti.static(i**3) * (w2 - w1)
            s4 += ti.static(i**4) * (w2 + w1)
            t0 += z2 + z1
            t1 += i * (z2 - z1)
            t2 += ti.static(i**2) * (z2 + z1)
        s0, s1, s2, s3, s4 = scale[lane] * s0, scale[lane] * s1, scale[lane] * s2, scale[lane] * s3, scale[lane] * s4
        t0, t1, t2 = scale[lane] * t0, scale[lane] * t1, scale[lane] * t2
        for n, part in ti.static(enumerate((s0, s1, s2, s3, s4))):
            sums[n, lane] += part
        for n, part in ti.static(enumerate((s0, s1, s2, s3))):
            sums[5 + n, lane] += v * part
        for n, part in ti.static(enumerate((s0, s1, s2))):
            sums[9 + n, lane] += v2 * part
        for n, part in ti.static(enumerate((s0, s1))):
            sums[12 + n, lane] += v2 * v * part
        sums[14, lane] += v2 * v2 * s0
        for n, part in ti.static(enumerate((t0, t1, t2, v * t0, v * t1, v2 * t0))):
            sums[_RIGHT_SIDE + n, lane] += part


@kernel
def fit_windows_kernel(
    depth: F32Array2,  # (H, W)
    precision: F32Array2,  # (H, W) 1 / sigma^2; 0 where a pixel does not count
    runs: U8Array3,  # (4, H, W) linked pixels: see `Run`
    top: i32,  # the first row that is wanted
    out: F32Array4,  # (3, 4, rows, W) see `Fit`, of samples 1, 2 and 4 px apart
):
    """Fit the quadrics of some rows in all three windows."""
    height, width, rows = depth.shape[0], depth.shape[1], out.shape[2]
    strips = rows * strip_count(width, STRIP)
    for t in range(WINDOWS * strips):
        window = t // strips
        stride = 1 << window
        row, first, count = strip_at(t - window * strips, width, STRIP)
        y, start = top + row, first - FARTHEST
        values, weights = _segment(0.0), _segment(0.0)
        middle, own, scale, sums = _lanes(0.0), _lanes(0.0), _lanes(0.0), _window_sums(0.0)
        above, below, left, right = _whole_lanes(0), _whole_lanes(0), _whole_lanes(0), _whole_lanes(0)
        beside = _whole_lanes(0)
        for lane in range(count):
            middle[lane] = depth[y, first + lane]
            own[lane] = 1.0 / ti.max(precision[y, first + lane], _LEAST)
            above[lane] = ti.cast(runs[Run.ABOVE, y, first + lane], i32) >> window
            below[lane] = ti.cast(runs[Run.BELOW, y, first + lane], i32) >> window
        for k in range(-SIDE, SIDE + 1):
            j = y + k * stride
            if j >= 0 and j < height:
                for i in range(ti.max(0, -start), ti.min(STRIP + 2 * FARTHEST, width - start)):
                    weights[i] = precision[j, start + i]
                    # What does not count may be no number.
                    values[i] = ti.select(weights[i] > 0.0, depth[j, start + i], 0.0)
                for lane in range(count):
                    left[lane] = ti.cast(runs[Run.LEFT, j, first + lane], i32) >> window
                    right[lane] = ti.cast(runs[Run.RIGHT, j, first + lane], i32) >> window
                    if k == 0:
                        beside[lane] = ti.min(left[lane], right[lane])
                taper = 1.0 - k * k * ti.static(1.0 / (SIDE + 1) ** 2)
                for lane in range(STRIP):
                    reached = (k >= -above[lane]) & (k <= below[lane])
                    scale[lane] = ti.select(reached, taper * own[lane], 0.0)
                add_row(sums, values, weights, middle, scale, left, right, ti.cast(k, ti.f32), stride)
        apart, alike = 1.0 / stride, ti.select(window == 0, _ALIKE[0], ti.select(window == 1, _ALIKE[1], _ALIKE[2]))
        for lane in range(STRIP):
            whole = (above[lane] >= SIDE) & (below[lane] >= SIDE) & (beside[lane] >= SIDE)
            least = ti.select(whole, -1e30, _LEAST_BEND * alike * own[lane])
            value, slope_down, slope_right, share = quadric_of(sums, lane, least)
            values[lane], weights[lane] = value, own[lane] * share * alike
            middle[lane], own[lane] = slope_down * apart, slope_right * apart
        for lane in range(count):
            place = first + lane
            out[window, Fit.VALUE, row, place] = values[lane]
            out[window, Fit.SLOPE_DOWN, row, place] = middle[lane]
            out[window, Fit.SLOPE_RIGHT, row, place] = own[lane]
            out[window, Fit.VARIANCE, row, place] = weights[lane]


@kernel
def measure_runs_kernel(
    links: U8Array2,  # (H, W) bits
    out: U8Array3,  # (4, H, W) see `Run`
):
    height, width = links.shape[0], links.shape[1]
    for t in range(height * SPREAD):
        if t % SPREAD == 0:
            y, run = t // SPREAD, 0
            for x in range(width):
                if x > 0:
                    run = ti.select((links[y, x - 1] & RIGHT) != 0, ti.min(run + 1, FARTHEST), 0)
                out[Run.LEFT, y, x] = ti.cast(run, ti.u8)
            run = 0
            for k in range(width):
                x = width - 1 - k
                run = ti.select((links[y, x] & RIGHT) != 0, ti.min(run + 1, FARTHEST), 0)
                out[Run.RIGHT, y, x] = ti.cast(run, ti.u8)
    for t in range(strip_count(width, STRIP) * SPREAD):
        if t % SPREAD == 0:
            first = t // SPREAD * STRIP
            end = ti.min(first + STRIP, width)
            for x in range(first, end):
                out[Run.ABOVE, 0, x] = ti.cast(0, ti.u8)
                out[Run.BELOW, height - 1, x] = ti.cast(0, ti.u8)
            for y in range(1, height):
                for x in range(first, end):
                    run = ti.min(ti.cast(out[Run.ABOVE, y - 1, x], i32) + 1, FARTHEST)
                    out[Run.ABOVE, y, x] = ti.cast(ti.select((links[y - 1, x] & DOWN) != 0, run, 0), ti.u8)
            for k in range(1, height):
                y = height - 1 - k
                for x in range(first, end):
                    run = ti.min(ti.cast(out[Run.BELOW, y + 1, x], i32) + 1, FARTHEST)
                    out[Run.BELOW, y, x] = ti.cast(ti.select((links[y, x] & DOWN) != 0, run, 0), ti.u8)


def measure_runs(links: U8) -> npt.NDArray[np.uint8]:
    """Return how many pixels are linked with each one way after the other, up to `FARTHEST`, (4, H, W): see `Run`."""
    runs = np.zeros((len(Run), *links.shape), np.uint8)
    if runs.size:
        measure_runs_kernel(links, runs)
    return runs


def fit_windows(depth: F32, precision: F32, runs: U8, top: int, out: npt.NDArray[np.float32]) -> None:
    """Fit the quadrics of the rows from `top` on in all three windows.

    Parameters
    ----------
    depth : (H, W) float32
        Of no account where there is no precision.
    precision : (H, W) float32
        1 / sigma^2; 0 where a pixel does not count.
    runs : (4, H, W) uint8
        Results of `measure_runs`.
    top : int
        The first row.
    out : (3, 4, rows, W) float32
        Results of the quadrics of samples 1, 2 and 4 px apart: see `Fit`.
    """
    fit_windows_kernel(depth, precision, runs, top, out)


def precision_of(sigma: F32, counts: U8) -> npt.NDArray[np.float32]:
    """Return 1 / sigma^2, and 0 for pixels that do not count."""
    sigma, counts = runtime.to_host(sigma), runtime.to_host(counts)
    return np.divide(1, np.square(sigma), out=np.zeros(sigma.shape, np.float32), where=counts != 0)
