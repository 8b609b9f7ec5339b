"""A weighted quadric around a pixel, over the pixels that are linked with it.

Of the pixels at distances (u, v) around one those count that links lead to: along the column first, then along the row.
Least squares with the weights

    w = (1 - u^2 / r^2) (1 - v^2 / r^2) (sigma_0 / sigma)^2

find z = a + b_u u + b_v v + c_uu u^2 + c_uv u v + c_vv v^2, of 7 x 7 samples that are a stride apart. Where too few are
linked to tell the bend, a weak prior (that there is none) leaves a plane.
"""

import numpy as np
import numpy.typing as npt

from tikernels import runtime
from tikernels._taichi import F32Array2, U8Array2, f32, i32, mat6, ti, vec6
from tikernels.arrays import F32, U8
from tikernels.depth.step_cutting import DOWN, RIGHT
from tikernels.launching import kernel
from tikernels.strips import SPREAD

#: Samples on either side of the pixel, and the largest distance that links are followed to, px: four to a sample.
SIDE = 3
FARTHEST = 4 * SIDE
# What is left of a pixel's variance by samples 1, 2 and 4 px apart, over what would be left if their errors had nothing
# in common: by the errors' correlations after the phase's smoothing (docs/method.md, 7).
_ALIKE = (6.2, 3.0, 1.1)
# Weight of the prior that a surface does not bend, of the middle pixel's: seen only where nothing else tells the bend.
_FLAT = 1e-3
# And that it does not slope.
_LEVEL = 1e-5


@ti.func
def solved(normal: mat6, rest: vec6):
    """Return the last three unknowns of six, the last one first, and its share of the variance."""
    # The share is at the end of the elimination.
    for p in ti.static(range(6)):
        reciprocal = 1.0 / ti.max(normal[p, p], 1e-9)
        for row in ti.static(range(p + 1, 6)):
            factor = normal[row, p] * reciprocal
            for column in ti.static(range(p + 1, 6)):
                normal[row, column] -= factor * normal[p, column]
            rest[row] -= factor * rest[p]
    share = 1.0 / ti.max(normal[5, 5], 1e-9)
    last = rest[5] * share
    fifth = (rest[4] - normal[4, 5] * last) / ti.max(normal[4, 4], 1e-9)
    fourth = (rest[3] - normal[3, 4] * fifth - normal[3, 5] * last) / ti.max(normal[3, 3], 1e-9)
    return last, fifth, fourth, share


@ti.func
def row_moments(
    depth: F32Array2,
    precision: F32Array2,
    j: i32,
    x: i32,
    first: i32,
    last: i32,
    stride: i32,
    taper: f32,
    middle: f32,
):
    """Return a row's sums of w u^0 to w u^4, and of w z u^0 to w z u^2, z above the middle pixel's value."""
    s0, s1, s2, s3, s4, t0, t1, t2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(first, last + 1):
        u = ti.cast(i, ti.f32)
        weight = taper * precision[j, x + i * stride] * (1.0 - u * u * ti.static(1.0 / (SIDE + 1) ** 2))
        z = weight * (depth[j, x + i * stride] - middle)
        s0 += weight
        t0 += z
        weight, z = weight * u, z * u
        s1 += weight
        t1 += z
        weight, z = weight * u, z * u
        s2 += weight
        t2 += z
        weight *= u
        s3 += weight
        s4 += weight * u
    return s0, s1, s2, s3, s4, t0, t1, t2


@ti.func
def fitted_quadric(
    depth: F32Array2,
    precision: F32Array2,
    left: U8Array2,
    right: U8Array2,
    y: i32,
    x: i32,
    up: i32,
    down: i32,
    stride: i32,
    own: f32,
):
    """Return value above the pixel's own, slopes down and to the right a px, and the value's variance.

    What does not count has no precision; `own` is the pixel's variance.
    """
    middle = depth[y, x]
    m00, m01, m02, m03, m04 = 0.0, 0.0, 0.0, 0.0, 0.0
    m10, m11, m12, m13 = 0.0, 0.0, 0.0, 0.0
    m20, m21, m22 = 0.0, 0.0, 0.0
    m30, m31, m40 = 0.0, 0.0, 0.0
    z00, z01, z02, z10, z11, z20 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(-ti.min(SIDE, up // stride), ti.min(SIDE, down // stride) + 1):
        j = y + k * stride
        v = ti.cast(k, ti.f32)
        taper = own * (1.0 - v * v * ti.static(1.0 / (SIDE + 1) ** 2))
        first = -ti.min(SIDE, ti.cast(left[j, x], ti.i32) // stride)
        last = ti.min(SIDE, ti.cast(right[j, x], ti.i32) // stride)
        s0, s1, s2, s3, s4, t0, t1, t2 = row_moments(depth, precision, j, x, first, last, stride, taper, middle)
        v2 = v * v
        m00 += s0
        m01 += s1
        m02 += s2
        m03 += s3
        m04 += s4
        m10 += v * s0
        m11 += v * s1
        m12 += v * s2
        m13 += v * s3
        m20 += v2 * s0
        m21 += v2 * s1
        m22 += v2 * s2
        m30 += v2 * v * s0
        m31 += v2 * v * s1
        m40 += v2 * v2 * s0
        z00 += t0
        z01 += t1
        z02 += t2
        z10 += v * t0
        z11 += v * t1
        z20 += v2 * t0
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
    rest = vec6(z02, z11, z20, z01, z10, z00)
    value, slope_down, slope_right, share = solved(normal, rest)
    apart = 1.0 / stride
    alike = ti.select(stride == 1, _ALIKE[0], ti.select(stride == 2, _ALIKE[1], _ALIKE[2]))
    return value, slope_down * apart, slope_right * apart, own * share * alike


@ti.func
def column_run(links: U8Array2, y: i32, x: i32):
    """Return how many linked pixels there are above a pixel, and below."""
    up, down, on = 0, 0, 1
    for k in range(ti.min(y, FARTHEST)):
        on *= ti.cast((links[y - k - 1, x] & DOWN) != 0, i32)
        up += on
    on = 1
    for k in range(ti.min(links.shape[0] - y, FARTHEST)):
        on *= ti.cast((links[y + k, x] & DOWN) != 0, i32)
        down += on
    return up, down


@kernel
def measure_runs_kernel(
    links: U8Array2,  # (H, W) bits
    out_left: U8Array2,  # (H, W) linked pixels to the left
    out_right: U8Array2,  # (H, W) and to the right
):
    height, width = links.shape[0], links.shape[1]
    for t in range(height * SPREAD):
        if t % SPREAD == 0:
            y, run = t // SPREAD, 0
            for x in range(width):
                if x > 0:
                    run = ti.select((links[y, x - 1] & RIGHT) != 0, ti.min(run + 1, FARTHEST), 0)
                out_left[y, x] = ti.cast(run, ti.u8)
            run = 0
            for k in range(width):
                x = width - 1 - k
                run = ti.select((links[y, x] & RIGHT) != 0, ti.min(run + 1, FARTHEST), 0)
                out_right[y, x] = ti.cast(run, ti.u8)


def measure_runs(links: U8) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8]]:
    """Return how many pixels are linked in a row to the left and to the right of each, up to `FARTHEST`."""
    left, right = (np.empty(links.shape, np.uint8) for _ in range(2))
    measure_runs_kernel(links, left, right)
    return left, right


def precision_of(sigma: F32, counts: U8) -> npt.NDArray[np.float32]:
    """Return 1 / sigma^2, and 0 for pixels that do not count."""
    sigma, counts = runtime.to_host(sigma), runtime.to_host(counts)
    return np.divide(1, np.square(sigma), out=np.zeros(sigma.shape, np.float32), where=counts != 0)
