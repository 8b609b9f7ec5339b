"""How sure each pixel is: what the fit says of the phase, checked against what rows really differ by, and in mm.

A pixel's variance is the fit's, one over its precision. Smoothing along the stripes averages the camera's noise, but
only where all the neighbours are there, and never the channels' model's own error, which they share.
"""

from tikernels._taichi import F32Array1, F32Array2, F32Array3, Static, U8Array2, f32, i32, ti, vec3
from tikernels.depth.triangulation import load_projector, ray_depth
from tikernels.phase.phase_vector import PI, STRIP

#: Where a pixel is: off the mask, on it, and on it with all the neighbours that smoothing averages over.
OFF, PARTLY, WHOLE = 0, 1, 2
# The error of the channels' model is this share of a pixel's variance: it is fitted to some fifty samples for three
# channels' gains and offsets.
_MODEL_ERROR = 0.03
# Where part of the window that the model is fitted to is empty, as near an edge, it follows the other side's shading:
# an error in rad, whatever the noise, that grows with the root of that part.
_EDGE_ERROR = 0.025
_LEAST_PRECISION = 1e-6  # 1 / rad^2
# By so much more phase a point's shift is measured, rad.
_BESIDE = 0.02


@ti.func
def smoothed_variance(precision: F32Array2, support: U8Array2, averaged: f32, y: i32, x: i32) -> f32:
    """Variance of a pixel's phase after smoothing, rad^2; NaN off the mask."""
    share = ti.select(support[y, x] == WHOLE, averaged, 1.0) + _MODEL_ERROR
    variance = share / ti.max(precision[y, x], _LEAST_PRECISION)
    return ti.select(support[y, x] == OFF, ti.math.nan, variance)


@ti.kernel
def compare_rows_kernel(
    phase: F32Array2,  # (H, W) rad, unwrapped
    precision: F32Array2,  # (H, W) 1 / rad^2
    support: U8Array2,  # (H, W)
    averaged: f32,  # what smoothing leaves of the variance
    step: i32,  # px between the rows that are compared
    every: i32,  # px between the columns
    out: F32Array2,  # (H - 3 step, ceil(W / every))
):
    """Third differences over four rows in units of what they are expected to be: surfaces bend."""
    rows, columns = out.shape[0], out.shape[1]
    for sample in range(rows * columns):
        y, x = sample // columns, sample % columns * every
        rest, variance = 0.0, 0.0
        for k in ti.static(range(4)):
            weight = ti.static((1.0, -3.0, 3.0, -1.0)[k])
            rest += weight * phase[y + k * step, x]
            variance += weight * weight * smoothed_variance(precision, support, averaged, y + k * step, x)
        out[y, sample % columns] = ti.abs(rest) / ti.sqrt(variance)


@ti.kernel
def phase_sigma_kernel(
    precision: F32Array2,  # (H, W) 1 / rad^2
    support: U8Array2,  # (H, W)
    empty: F32Array2,  # (H, W) the part of the model's window that is off the mask
    averaged: f32,  # what smoothing leaves of the variance
    scatter: f32,  # by how much more rows differ than expected
    out: F32Array2,  # (H, W) rad; NaN outside the mask
):
    height, width = out.shape[0], out.shape[1]
    strips = (width + STRIP - 1) // STRIP
    for t in range(height * strips):
        y, first = t // strips, (t % strips) * STRIP
        for x in range(first, ti.min(first + STRIP, width)):
            variance = scatter * scatter * smoothed_variance(precision, support, averaged, y, x)
            out[y, x] = ti.sqrt(variance + _EDGE_ERROR * _EDGE_ERROR * empty[y, x])


@ti.kernel
def point_sigma_kernel(
    phase: F32Array2,  # (H, W) rad, absolute
    phase_sigma: F32Array2,  # (H, W) rad
    points: F32Array3,  # (H, W, 3) mm
    rays: F32Array3,  # (H, W, 2) x, y at unit depth
    projector: F32Array1,
    axis: Static,
    distorted: Static,
    out: F32Array2,  # (H, W) mm along the ray; NaN where there is no point
):
    height, width = out.shape[0], out.shape[1]
    strips = (width + STRIP - 1) // STRIP
    for t in range(height * strips):
        y, first = t // strips, (t % strips) * STRIP
        for x in range(first, ti.min(first + STRIP, width)):
            rotation, translation, lens, focal, center, period = load_projector(projector)
            ray = vec3(rays[y, x, 0], rays[y, x, 1], 1.0)
            row = (phase[y, x] + _BESIDE) * (period / (2.0 * PI))
            depth = ray_depth(ray, row, rotation, translation, focal, center, lens, axis, distorted)
            depth = ti.select(depth > 0.0, depth, ti.math.nan)
            shift = ti.abs(depth - points[y, x, 2]) * ti.sqrt(1.0 + ray.x * ray.x + ray.y * ray.y)
            out[y, x] = shift * phase_sigma[y, x] / _BESIDE
