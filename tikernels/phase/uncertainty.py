"""How sure the phase of each pixel is: what the fit says, checked against what rows really differ by.

    sigma^2 = scatter^2 ((averaged + model) / precision + error) + edge^2 empty

One over the fit's precision (`phase_fit.py`) is the variance of a pixel's phase. Smoothing over n pixels leaves
averaged = 1 / n of it, but only where all the neighbours are there, and never the channels' model's own error, which
they share. What that model is wrong by around a place, error, the misfit of the fit tells (`model_error.py`); smoothing
leaves it, too. Whatever else differs from row to row, such as ripple that balance and crosstalk leave, shows in the
scatter: third differences over four rows a quarter of a cycle apart, which leave a surface's bend out, in units of what
the law of propagation expects of them (JCGM 100:2008, 5.1.2, doi:10.59161/JCGM100-2008E). Their median tells it,
whatever they are at edges. Near an edge of the mask part of the balance window is empty.
"""

import cv2
import numpy as np
import numpy.typing as npt

from tikernels import checks, runtime
from tikernels._taichi import F32Array2, U8Array2, f32, i32, ti
from tikernels.arrays import F32, U8, Mask
from tikernels.errors import ShapeError
from tikernels.phase.balance_window import SIGMA_ACROSS
from tikernels.strips import STRIP, strip_at, strip_count

#: Where a pixel is: off the mask, on it, and on it with all the neighbours that smoothing averages over.
OFF, PARTLY, WHOLE = 0, 1, 2
# The error of the channels' model is this share of a pixel's variance: it is fitted to some fifty samples for three
# channels' gains and offsets.
_MODEL_ERROR = 0.03
# Where part of the window that the model is fitted to is empty, as near an edge, it follows the other side's shading:
# an error in rad, whatever the noise, that grows with the root of that part.
_EDGE_ERROR = 0.025
_LEAST_PRECISION = 1e-6  # 1 / rad^2
# Rows differ by less than the noise where it was overrated, but not by less than half of it.
_LEAST_SCATTER = 0.5
# About 60,000 pixels tell how far rows scatter, to half a per cent.
_SCATTER_SAMPLES = 60_000
# Median of a normal distribution's absolute values, in standard deviations.
_MEDIAN_SIZE = 0.6745
# A grid point for every two pixels of a blur's standard deviation is enough.
_GRID = 2


@ti.func
def smoothed_variance(
    precision: F32Array2, error: F32Array2, neighbours: U8Array2, averaged: f32, y: i32, x: i32
) -> f32:
    """Variance of a pixel's phase after smoothing, rad^2; NaN off the mask."""
    share = ti.select(neighbours[y, x] == WHOLE, averaged, 1.0) + _MODEL_ERROR
    variance = share / ti.max(precision[y, x], _LEAST_PRECISION) + error[y, x]
    return ti.select(neighbours[y, x] == OFF, ti.math.nan, variance)


@ti.kernel
def compare_rows_kernel(
    phase: F32Array2,  # (H, W) rad, unwrapped
    precision: F32Array2,  # (H, W) 1 / rad^2
    error: F32Array2,  # (H, W) rad^2, the model's
    neighbours: U8Array2,  # (H, W)
    averaged: f32,  # what smoothing leaves of the variance
    step: i32,  # px between the rows that are compared
    every: i32,  # px between the columns
    out: F32Array2,  # (H - 3 step, ceil(W / every))
):
    """Third differences over four rows in units of what they are expected to be: surfaces bend."""
    rows, columns = out.shape[0], out.shape[1]
    for sample in range(rows * columns):
        y, x = sample // columns, sample % columns * every
        difference, variance = 0.0, 0.0
        for k in ti.static(range(4)):
            weight = ti.static((1.0, -3.0, 3.0, -1.0)[k])
            difference += weight * phase[y + k * step, x]
            variance += weight * weight * smoothed_variance(precision, error, neighbours, averaged, y + k * step, x)
        out[y, sample % columns] = ti.abs(difference) / ti.sqrt(variance)


@ti.kernel
def phase_sigma_kernel(
    precision: F32Array2,  # (H, W) 1 / rad^2
    error: F32Array2,  # (H, W) rad^2, the model's
    neighbours: U8Array2,  # (H, W)
    empty: F32Array2,  # (H, W) the part of the model's window that is off the mask
    averaged: f32,  # what smoothing leaves of the variance
    scatter: f32,  # by how much more rows differ than expected
    out: F32Array2,  # (H, W) rad; NaN outside the mask
):
    """Add up what makes a pixel's phase uncertain."""
    height, width = out.shape[0], out.shape[1]
    for t in range(height * strip_count(width, STRIP)):
        y, first, count = strip_at(t, width, STRIP)
        for x in range(first, first + count):
            variance = scatter * scatter * smoothed_variance(precision, error, neighbours, averaged, y, x)
            out[y, x] = ti.sqrt(variance + _EDGE_ERROR * _EDGE_ERROR * empty[y, x])


def phase_sigma(
    precision: F32, error: F32, neighbours: U8, empty: F32, averaged: float, scatter: float, out: F32 | None = None
) -> F32:
    """Return the standard deviation of the smoothed phase.

    Parameters
    ----------
    precision : (H, W) float32
        1 / rad^2, one over the variance that the fit found.
    error : (H, W) float32
        rad^2, the variance that the channels' model leaves.
    neighbours : (H, W) uint8
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
    precision = checks.read_array("precision", precision, (None, None), np.float32)
    shape = (int(precision.shape[0]), int(precision.shape[1]))
    error = checks.read_array("error", error, shape, np.float32)
    neighbours = checks.read_array("neighbours", neighbours, shape, np.uint8)
    empty = checks.read_array("empty", empty, shape, np.float32)
    out = checks.out_buffer("out", out, shape, np.float32)
    phase_sigma_kernel(precision, error, neighbours, empty, averaged, scatter, out)
    return out


def compare_rows(
    phase: F32,
    precision: F32,
    error: F32,
    neighbours: U8,
    averaged: float,
    step: int,
    every: int,
    out: F32 | None = None,
) -> F32:
    """Return how far rows differ, in units of what the noise makes them: third differences, as surfaces bend.

    Parameters
    ----------
    phase : (H, W) float32
        rad, unwrapped; NaN off the mask.
    precision : (H, W) float32
        1 / rad^2.
    error : (H, W) float32
        rad^2, the variance that the channels' model leaves.
    neighbours : (H, W) uint8
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
    phase = checks.read_array("phase", phase, (None, None), np.float32)
    height, width = int(phase.shape[0]), int(phase.shape[1])
    precision = checks.read_array("precision", precision, (height, width), np.float32)
    error = checks.read_array("error", error, (height, width), np.float32)
    neighbours = checks.read_array("neighbours", neighbours, (height, width), np.uint8)
    if height <= 3 * step:
        raise ShapeError(f"phase has {height} rows: four rows {step} px apart need {3 * step + 1}")
    out = checks.out_buffer("out", out, (height - 3 * step, -(-width // every)), np.float32)
    compare_rows_kernel(phase, precision, error, neighbours, averaged, step, every, out)
    return out


def estimate_phase_sigma(
    unwrapped: F32, precision: F32, error: F32, spacing_px: int, mask: Mask, pairs: int, period_px: float
) -> F32:
    """Estimate every pixel's standard deviation, stripes along the rows.

    Parameters
    ----------
    unwrapped : (H, W) float32
        rad; NaN off the mask.
    precision : (H, W) float32
        1 / rad^2, what the fit says of the phase before smoothing.
    error : (Hg, Wg) float32
        rad^2, what `ModelError` found, by node.
    spacing_px : int
        px between two nodes.
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
    inside = runtime.to_host(checks.read_mask("mask", mask, tuple(unwrapped.shape)))  # synchronises
    neighbours = _neighbours(inside, pairs)
    averaged = 1 / (2 * pairs + 1)
    everywhere = _between_nodes(runtime.to_host(error), inside.shape, spacing_px)
    known = (precision, everywhere, neighbours)
    scatter = _scatter(unwrapped, *known, averaged, period_px)
    return phase_sigma(*known, _empty_share(inside, period_px), averaged, scatter)


def _between_nodes(values: npt.NDArray[np.float32], shape: tuple[int, ...], spacing_px: int) -> npt.NDArray[np.float32]:
    """Return values at nodes as values at pixels, (H, W) float32."""
    size = (values.shape[1] * spacing_px, values.shape[0] * spacing_px)
    return np.ascontiguousarray(cv2.resize(values, size, interpolation=cv2.INTER_LINEAR)[: shape[0], : shape[1]])


def _neighbours(inside: npt.NDArray[np.uint8], pairs: int) -> npt.NDArray[np.uint8]:
    """Return OFF, PARTLY or WHOLE of every pixel, which are 0, 1 and 2: the mask, and the mask without its margins."""
    return np.asarray(inside + cv2.erode(inside, np.ones((1, 2 * pairs + 1), np.uint8)), np.uint8)


def _scatter(
    unwrapped: F32, precision: F32, error: F32, neighbours: npt.NDArray[np.uint8], averaged: float, period_px: float
) -> float:
    """Return how far rows a quarter of a cycle apart differ, in units of what is expected; 1 where none tells."""
    step, every = max(2, round(period_px / 4)), max(1, neighbours.size // _SCATTER_SAMPLES)
    if len(neighbours) <= 3 * step:
        return 1.0
    ratio = runtime.to_host(
        compare_rows(unwrapped, precision, error, neighbours, averaged, step, every)
    )  # synchronises
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
