"""How sure each pixel is: what the fit says of the phase, checked against what rows really differ by, and in mm.

A pixel's variance is the fit's, one over its precision. Smoothing along the stripes averages the camera's noise, but
only where all the neighbours are there, and never the channels' model's own error, which they share.
"""

import cv2
import numpy as np
import numpy.typing as npt

from tikernels import _checks, runtime
from tikernels._taichi import F32Array1, F32Array2, F32Array3, Static, U8Array2, f32, i32, ti, vec3
from tikernels.arrays import F32, U8, Mask
from tikernels.depth.triangulation import ProjectorGeometry, load_projector, ray_depth
from tikernels.errors import ShapeError
from tikernels.phase.color_balance import SIGMA_ACROSS
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
# The shift of a point is measured between its phase and this much more, rad.
_BESIDE = 0.02
# Rows differ by less than the noise where it was overrated, but not by less than half of it.
_LEAST_SCATTER = 0.5
# About 60,000 pixels tell how far rows scatter, to half a per cent.
_SCATTER_SAMPLES = 60_000
# Median of a normal distribution's absolute values, in standard deviations.
_MEDIAN_SIZE = 0.6745
# A grid point for every two pixels of a blur's standard deviation is enough.
_GRID = 2


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


def phase_sigma(
    precision: F32, support: U8, empty: F32, averaged: float, scatter: float, out: F32 | None = None
) -> F32:
    """Return the standard deviation of the smoothed phase.

    Parameters
    ----------
    precision : (H, W) float32
        1 / rad^2, one over the variance that the fit found.
    support : (H, W) uint8
        OFF, PARTLY or WHOLE.
    empty : (H, W) float32
        Which part of the window that the channels' model is fitted to is off the mask, 0..1.
    averaged : float
        What is left of the variance after smoothing, as a share.
    scatter : float
        How far rows really differ, in units of what is expected.
    out : (H, W) float32, optional
        Where the result goes.

    Returns
    -------
    (H, W) float32
        rad; NaN off the mask. A buffer of the device if none is given.

    Raises
    ------
    ShapeError
        A shape or dtype is another one, or `out` cannot be written.
    """
    precision = _checks.read_array("precision", precision, (None, None), np.float32)
    shape = (int(precision.shape[0]), int(precision.shape[1]))
    support = _checks.read_array("support", support, shape, np.uint8)
    empty = _checks.read_array("empty", empty, shape, np.float32)
    out = _checks.out_buffer("out", out, shape, np.float32)
    phase_sigma_kernel(precision, support, empty, averaged, scatter, out)
    return out


def compare_rows(
    phase: F32, precision: F32, support: U8, averaged: float, step: int, every: int, out: F32 | None = None
) -> F32:
    """Return how far rows differ, in units of what the noise makes them: third differences, as surfaces bend.

    Parameters
    ----------
    phase : (H, W) float32
        rad, unwrapped; NaN off the mask.
    precision : (H, W) float32
        1 / rad^2.
    support : (H, W) uint8
        OFF, PARTLY or WHOLE.
    averaged : float
        What is left of the variance after smoothing, as a share.
    step, every : int
        px between the rows that are compared, and between the columns that are looked at.
    out : (H - 3 step, ceil(W / every)) float32, optional
        Where the result goes.

    Returns
    -------
    (H - 3 step, ceil(W / every)) float32
        0 or more, a standard deviation of one where the noise is as expected; NaN where a row is off the mask.

    Raises
    ------
    ShapeError
        A shape or dtype is another one, four rows are more than there are, or `out` cannot be written.
    """
    phase = _checks.read_array("phase", phase, (None, None), np.float32)
    height, width = int(phase.shape[0]), int(phase.shape[1])
    precision = _checks.read_array("precision", precision, (height, width), np.float32)
    support = _checks.read_array("support", support, (height, width), np.uint8)
    if height <= 3 * step:
        raise ShapeError(f"phase has {height} rows: four rows {step} px apart need {3 * step + 1}")
    out = _checks.out_buffer("out", out, (height - 3 * step, -(-width // every)), np.float32)
    compare_rows_kernel(phase, precision, support, averaged, step, every, out)
    return out


def point_sigma(
    phase: F32, phase_sigma: F32, points: F32, rays: F32, projector: ProjectorGeometry, out: F32 | None = None
) -> F32:
    """Return how far a standard deviation of the phase moves each point along its ray.

    Parameters
    ----------
    phase : (H, W) float32
        rad, absolute.
    phase_sigma : (H, W) float32
        rad.
    points : (H, W, 3) float32
        mm, what `triangulate` made of the phase.
    rays : (H, W, 2) float32
        x and y of every camera pixel's ray at unit depth.
    projector : ProjectorGeometry
        The projector.
    out : (H, W) float32, optional
        Where the result goes.

    Returns
    -------
    (H, W) float32
        mm; NaN where there is no point. A buffer of the device if none is given.

    Raises
    ------
    ShapeError
        A shape or dtype is another one, or `out` cannot be written.
    """
    phase = _checks.read_array("phase", phase, (None, None), np.float32)
    shape = (int(phase.shape[0]), int(phase.shape[1]))
    phase_sigma = _checks.read_array("phase_sigma", phase_sigma, shape, np.float32)
    points = _checks.read_array("points", points, (*shape, 3), np.float32)
    rays = _checks.read_array("rays", rays, (*shape, 2), np.float32)
    out = _checks.out_buffer("out", out, shape, np.float32)
    point_sigma_kernel(phase, phase_sigma, points, rays, *projector.arguments(), out)
    return out


def estimate_phase_sigma(unwrapped: F32, precision: F32, mask: Mask, pairs: int, period_px: float) -> F32:
    """Estimate every pixel's standard deviation, stripes along the rows.

    Parameters
    ----------
    unwrapped : (H, W) float32
        rad; NaN off the mask.
    precision : (H, W) float32
        1 / rad^2, what the fit says of the phase before smoothing.
    mask : (H, W) bool or uint8
        Valid pixels.
    pairs : int
        Neighbours on either side that `smooth_phase` averaged over.
    period_px : float
        Camera px a cycle.

    Returns
    -------
    (H, W) float32
        rad; NaN off the mask; in a buffer of the device.

    Raises
    ------
    ShapeError
        A shape or dtype is another one.
    """
    inside = runtime.to_host(_checks.read_mask("mask", mask, tuple(unwrapped.shape)))  # synchronises
    support = _support(inside, pairs)
    averaged = 1 / (2 * pairs + 1)
    scatter = _scatter(unwrapped, precision, support, averaged, period_px)
    return phase_sigma(precision, support, _empty_share(inside, period_px), averaged, scatter)


def _support(inside: npt.NDArray[np.uint8], pairs: int) -> npt.NDArray[np.uint8]:
    """Return OFF, PARTLY or WHOLE of every pixel, which are 0, 1 and 2: the mask, and the mask without its margins."""
    return np.asarray(inside + cv2.erode(inside, np.ones((1, 2 * pairs + 1), np.uint8)), np.uint8)


def _scatter(
    unwrapped: F32, precision: F32, support: npt.NDArray[np.uint8], averaged: float, period_px: float
) -> float:
    """Return how far rows a quarter of a cycle apart differ, in units of what is expected; 1 where none tells."""
    step, every = max(2, round(period_px / 4)), max(1, support.size // _SCATTER_SAMPLES)
    if len(support) <= 3 * step:
        return 1.0
    ratio = runtime.to_host(compare_rows(unwrapped, precision, support, averaged, step, every))  # synchronises
    ratio = ratio[np.isfinite(ratio)]
    return max(_LEAST_SCATTER, float(np.median(ratio)) / _MEDIAN_SIZE) if len(ratio) else 1.0


def _empty_share(inside: npt.NDArray[np.uint8], period_px: float) -> npt.NDArray[np.float32]:
    """Return which part of the balance window around each pixel is off the mask, (H, W) float32 in 0..1."""
    width_px = SIGMA_ACROSS * period_px
    # A wide Gaussian is as smooth on a coarser grid, and costs less.
    coarser = max(1, int(width_px / _GRID))
    share = inside.astype(np.float32)
    size = share.shape[::-1]
    if coarser > 1:
        share = cv2.resize(share, (-(-size[0] // coarser), -(-size[1] // coarser)), interpolation=cv2.INTER_AREA)
    share = cv2.GaussianBlur(share, (0, 0), width_px / coarser, borderType=cv2.BORDER_CONSTANT)
    if coarser > 1:
        share = cv2.resize(share, size, interpolation=cv2.INTER_LINEAR)
    return np.asarray(1 - np.minimum(share, 1), np.float32)
