"""How sure the phase of each pixel is: what the fit says, checked against what rows really differ by.

    sigma^2 = scatter^2 (smoothed + model / precision) + misfit / precision + error + edge^2 empty

One over the fit's precision (`phase_fit.py`) is the variance of a pixel's phase. What smoothing makes of it
(`smoothing.py`) is for noise; the channels' model's own error, which neighbours share, stays.

What that model is wrong by the fit's misfit tells. Its mean is one where the model is right, and a model that is wrong
across the phase is as wrong along it: the usual scaling of a fit's variance by its chi square, place by place. Over a
few pixels misfit is that mean less one, where chance does not make it: at an edge of paint, a highlight, a spot of
another colour. Over the balance window error is the mean of (misfit - 1) / precision, as of a surface whose colour acts
otherwise than the model says; and edges between surfaces add to it (`surface_edges.py`). What is wrong in the same way
as brightness or phase does not show. Smoothing leaves all of that.

Whatever else differs from row to row, such as ripple that balance and crosstalk leave, shows in the scatter: third
differences over four rows a quarter of a cycle apart, which leave a surface's bend out, in units of what the law of
propagation expects of them (JCGM 100:2008, 5.1.2, doi:10.59161/JCGM100-2008E). Their median tells it, where noise is
most of what is expected: a model is wrong in the same way over many rows, which then scatter less than they are off.
Near an edge of the mask part of the balance window is empty.
"""

import cv2
import numpy as np
import numpy.typing as npt

from tikernels import checks, runtime
from tikernels._taichi import F32Array2, U8Array2, f32, i32, ti, vec2
from tikernels.arrays import F32, U8, Mask
from tikernels.errors import ShapeError
from tikernels.launching import kernel
from tikernels.phase.balance_window import SIGMA_ACROSS, SIGMA_ALONG
from tikernels.phase.phase_fit import MAX_MISFIT
from tikernels.phase.smoothing import left_of_differences, left_of_variance
from tikernels.strips import STRIP, strip_at, strip_count

# The error of the channels' model is this share of a pixel's variance: it is fitted to some fifty samples for three
# channels' gains and offsets.
_MODEL_ERROR = 0.03
# Misfits are averaged over this many pixels both ways. Where the model is right their mean exceeds one by less than the
# second: two standard deviations, sqrt(2 / 25) each. A single pixel counts for no more than the third.
_AROUND_PX, _BY_CHANCE, _MOST_MISFIT = 5, 0.57, 50.0
# In the mean over the window a pixel counts for no more than this, rad^2: a highlight is not its neighbourhood's error.
_MOST_VARIANCE = 0.25
# Columns of a cycle that tell that mean.
_COLUMNS_A_CYCLE = 2.5
# Where part of the window that the model is fitted to is empty, as near an edge, it follows the other side's shading:
# an error in rad, whatever the noise, that grows with the root of that part.
_EDGE_ERROR = 0.025
_LEAST_PRECISION = 1e-6  # 1 / rad^2
# Rows differ by less than the noise where it was overrated, but not by less than half of it.
_LEAST_SCATTER = 0.5
# About 60,000 pixels tell how far rows scatter, to half a per cent.
_SCATTER_SAMPLES = 60_000
# So do those that are this sure beside the surest: of dark ones less is known.
_TELLING = 0.1
# Median of a normal distribution's absolute values, in standard deviations.
_MEDIAN_SIZE = 0.6745
# A grid point for every two pixels of a blur's standard deviation is enough.
_GRID = 2


@ti.func
def smoothed_variances(
    precision: F32Array2,
    misfit: F32Array2,
    error: F32Array2,
    smoothed: F32Array2,
    mask: U8Array2,
    independent: f32,
    y: i32,
    x: i32,
) -> vec2:
    """Variances of a pixel's phase after smoothing, rad^2: by noise, NaN off the mask, and by the light's model."""
    variance = 1.0 / ti.max(precision[y, x], _LEAST_PRECISION)
    noise = independent * smoothed[y, x] + _MODEL_ERROR * variance
    model = misfit[y, x] * variance + error[y, x]
    return vec2([ti.select(mask[y, x] == 0, ti.math.nan, noise), model])


@kernel
def compare_rows_kernel(
    phase: F32Array2,  # (H, W) rad, unwrapped
    precision: F32Array2,  # (H, W) 1 / rad^2
    misfit: F32Array2,  # (H, W) beyond one
    error: F32Array2,  # (H, W) rad^2, the model's
    smoothed: F32Array2,  # (H, W) rad^2, the noise's after smoothing
    mask: U8Array2,  # (H, W)
    independent: f32,  # what of a difference's variance smoothing leaves, over what it would leave of independent rows
    step: i32,  # px between the rows that are compared
    every: i32,  # px between the columns
    out: F32Array2,  # (H - 3 step, ceil(W / every))
):
    """Third differences over four rows in units of what they are expected to be: surfaces bend."""
    rows, columns = out.shape[0], out.shape[1]
    for sample in range(rows * columns):
        y, x = sample // columns, sample % columns * every
        difference, expected = 0.0, vec2(0.0)
        for k in ti.static(range(4)):
            weight = ti.static((1.0, -3.0, 3.0, -1.0)[k])
            difference += weight * phase[y + k * step, x]
            here = smoothed_variances(precision, misfit, error, smoothed, mask, independent, y + k * step, x)
            expected += weight * weight * here
        ratio = ti.abs(difference) / ti.sqrt(expected.sum())
        out[y, sample % columns] = ti.select(expected[0] > expected[1], ratio, ti.math.nan)


@kernel
def phase_sigma_kernel(
    precision: F32Array2,  # (H, W) 1 / rad^2
    misfit: F32Array2,  # (H, W) beyond one
    error: F32Array2,  # (H, W) rad^2, the model's
    smoothed: F32Array2,  # (H, W) rad^2, the noise's after smoothing
    mask: U8Array2,  # (H, W)
    empty: F32Array2,  # (H, W) the part of the model's window that is off the mask
    scatter: f32,  # by how much more rows differ than expected
    out: F32Array2,  # (H, W) rad; NaN outside the mask
):
    """Add up what makes a pixel's phase uncertain."""
    height, width = out.shape[0], out.shape[1]
    for t in range(height * strip_count(width, STRIP)):
        y, first, count = strip_at(t, width, STRIP)
        for x in range(first, first + count):
            variances = smoothed_variances(precision, misfit, error, smoothed, mask, 1.0, y, x)
            variance = scatter * scatter * variances[0] + variances[1]
            out[y, x] = ti.sqrt(variance + _EDGE_ERROR * _EDGE_ERROR * empty[y, x])


def phase_sigma(
    precision: F32,
    misfit: F32,
    error: F32,
    smoothed: F32,
    mask: U8,
    empty: F32,
    scatter: float,
    out: F32 | None = None,
) -> F32:
    """Return the standard deviation of the smoothed phase.

    Parameters
    ----------
    precision : (H, W) float32
        1 / rad^2, one over the variance that the fit found.
    misfit : (H, W) float32
        What the channels' model leaves over of a few pixels, beyond one; in units of the precision's variance.
    error : (H, W) float32
        rad^2, the variance that the channels' model leaves over the balance window.
    smoothed : (H, W) float32
        rad^2, the variance by noise after smoothing.
    mask : (H, W) uint8
        Valid pixels.
    empty : (H, W) float32
        Which part of the window that the channels' model is fitted to is off the mask, 0..1.
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
    misfit = checks.read_array("misfit", misfit, shape, np.float32)
    error = checks.read_array("error", error, shape, np.float32)
    smoothed = checks.read_array("smoothed", smoothed, shape, np.float32)
    mask = checks.read_array("mask", mask, shape, np.uint8)
    empty = checks.read_array("empty", empty, shape, np.float32)
    out = checks.out_buffer("out", out, shape, np.float32)
    phase_sigma_kernel(precision, misfit, error, smoothed, mask, empty, scatter, out)
    return out


def compare_rows(
    phase: F32,
    precision: F32,
    misfit: F32,
    error: F32,
    smoothed: F32,
    mask: U8,
    independent: float,
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
    misfit : (H, W) float32
        What the channels' model leaves over of a few pixels, beyond one; in units of the precision's variance.
    error : (H, W) float32
        rad^2, the variance that the channels' model leaves over the balance window.
    smoothed : (H, W) float32
        rad^2, the variance by noise after smoothing.
    mask : (H, W) uint8
        Valid pixels.
    independent : float
        What smoothing leaves of the variance of the differences, over what it would leave if the rows were independent.
    step, every : int
        px between the rows that are compared, and between the columns that are looked at.
    out : (H - 3 step, ceil(W / every)) float32, optional
        Where the result goes.

    Returns
    -------
    (H - 3 step, ceil(W / every)) float32
        0 or more, a standard deviation of one where the noise is as expected; NaN where a row is off the mask, or more
        is expected of the light's model than of noise.

    Raises
    ------
    ShapeError
        A shape or dtype is another one, four rows are more than there are, or `out` cannot be written.
    """
    phase = checks.read_array("phase", phase, (None, None), np.float32)
    height, width = int(phase.shape[0]), int(phase.shape[1])
    precision = checks.read_array("precision", precision, (height, width), np.float32)
    misfit = checks.read_array("misfit", misfit, (height, width), np.float32)
    error = checks.read_array("error", error, (height, width), np.float32)
    smoothed = checks.read_array("smoothed", smoothed, (height, width), np.float32)
    mask = checks.read_array("mask", mask, (height, width), np.uint8)
    if height <= 3 * step:
        raise ShapeError(f"phase has {height} rows: four rows {step} px apart need {3 * step + 1}")
    out = checks.out_buffer("out", out, (height - 3 * step, -(-width // every)), np.float32)
    compare_rows_kernel(phase, precision, misfit, error, smoothed, mask, independent, step, every, out)
    return out


def estimate_phase_sigma(
    unwrapped: F32,
    precision: F32,
    smoothed: F32,
    misfit: F32 | None,
    mask: Mask,
    edges: npt.NDArray[np.float32] | None,
    pairs: int,
    period_px: float,
) -> F32:
    """Estimate every pixel's standard deviation, stripes along the rows.

    Parameters
    ----------
    unwrapped : (H, W) float32
        rad; NaN off the mask.
    precision : (H, W) float32
        1 / rad^2, what the fit says of the phase before smoothing.
    smoothed : (H, W) float32
        rad^2, the variance that noise leaves after smoothing; see `Smoother`.
    misfit : (H, W) float32, optional
        What it says of the model, see `FittedPhase`; None: the model is right.
    mask : (H, W) bool or uint8
        Valid pixels.
    edges : (H, W) float32, optional
        rad^2, what edges between surfaces make; see `surface_edges`; None: nothing.
    pairs : int
        Neighbours on either side that the smoothing fitted.
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
    around, error = np.zeros(inside.shape, np.float32), np.zeros(inside.shape, np.float32)
    if misfit is not None:
        over: npt.NDArray[np.float32] = np.minimum(runtime.to_host(misfit), np.float32(_MOST_MISFIT))
        over = np.where(inside != 0, over, np.float32(0))
        # The fit has divided the precision by the larger ones already.
        divided = np.maximum(np.float32(1), over / np.float32(MAX_MISFIT))
        around = _misfit_around(over, inside) / divided
        error = _window_error(over, divided * runtime.to_host(precision), inside, period_px)
    if edges is not None:
        error = error + edges
    known = (precision, around, error, smoothed, inside)
    scatter = _scatter(unwrapped, *known, pairs, period_px)
    return phase_sigma(*known, _empty_share(inside, period_px), scatter)


def _misfit_around(misfit: npt.NDArray[np.float32], inside: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    """Return the mean misfit around every pixel, beyond what chance makes of one."""
    side, border = (_AROUND_PX, _AROUND_PX), cv2.BORDER_CONSTANT
    share = cv2.blur(inside.astype(np.float32), side, borderType=border)
    mean = cv2.blur(misfit, side, borderType=border) / np.maximum(share, np.float32(1e-3))
    by_chance = _BY_CHANCE / np.sqrt(np.maximum(share, np.float32(1e-3)))
    return np.where(mean > 1 + by_chance, mean - 1, np.float32(0))


def _window_error(
    misfit: npt.NDArray[np.float32],
    precision: npt.NDArray[np.float32],
    inside: npt.NDArray[np.uint8],
    period_px: float,
) -> npt.NDArray[np.float32]:
    """Return the variance that the model leaves over the balance window, (H, W) float32, rad^2."""
    step = max(1, int(period_px / _COLUMNS_A_CYCLE))
    misfit, weight = misfit[:, ::step], inside[:, ::step].astype(np.float32)
    variance = (misfit - 1) / np.maximum(precision[:, ::step], np.float32(_LEAST_PRECISION))
    excess = weight * np.minimum(variance, np.float32(_MOST_VARIANCE))
    size = (misfit.shape[1], -(-len(misfit) // step))
    along, across = SIGMA_ALONG * period_px / step, SIGMA_ACROSS * period_px / step
    sums, shares = (
        cv2.GaussianBlur(cv2.resize(part, size, interpolation=cv2.INTER_AREA), (0, 0), along, sigmaY=across)
        for part in (excess, weight)
    )
    error = np.maximum(sums / np.maximum(shares, np.float32(1e-3)), 0)
    return np.asarray(cv2.resize(error, inside.shape[::-1], interpolation=cv2.INTER_LINEAR), np.float32)


def _scatter(
    unwrapped: F32,
    precision: F32,
    misfit: F32,
    error: F32,
    smoothed: F32,
    mask: npt.NDArray[np.uint8],
    pairs: int,
    period_px: float,
) -> float:
    """Return how far rows a quarter of a cycle apart differ, in units of what is expected; 1 where none tells."""
    step, every = max(2, round(period_px / 4)), max(1, mask.size // _SCATTER_SAMPLES)
    if len(mask) <= 3 * step:
        return 1.0
    independent = left_of_differences(pairs, step) / (20 * left_of_variance(pairs))
    compared = compare_rows(unwrapped, precision, misfit, error, smoothed, mask, independent, step, every)
    ratio = runtime.to_host(compared)  # synchronises
    sure = runtime.to_host(precision)[: len(ratio), ::every]
    known = np.isfinite(ratio)
    if not known.any():
        return 1.0
    ratio = ratio[known & (sure >= _TELLING * np.percentile(sure[known], 90))]
    return max(_LEAST_SCATTER, float(np.median(ratio)) / _MEDIAN_SIZE)


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
