"""Uncertainty of each pixel's phase: the fit's own, checked against the actual differences between rows.

    sigma^2 = scatter^2 (smoothed + own / precision) + model + edge^2 empty

One over the fit's precision (`phase_fit.py`) is the variance of a pixel's phase. The effect of smoothing on it
(`smoothing.py`) is for noise; the channels' model's own error, which neighbours share, stays. That error follows from
the fit's misfit (`model_variance.py`), and edges between surfaces add to it (`surface_edges.py`). What is wrong in the
same way as brightness or phase does not show. Smoothing leaves all of that.

Whatever else differs from row to row, such as ripple that balance and crosstalk leave, shows in the scatter: third
differences over four rows a third of a cycle apart, which leave a surface's bend out, in units of what the law of
propagation expects of them (JCGM 100:2008, 5.1.2, doi:10.59161/JCGM100-2008E). At a third of a cycle, ripple of once or
twice per cycle counts sqrt(27 / 20) as much as noise, and that of three times per cycle not at all; at a quarter, that
of twice per cycle counts 1.8 times. Their median shows it, where noise is most of what is expected: a model is wrong in
the same way over many rows, which then scatter less than they are off. Near an edge of the mask part of the balance
window is empty.
"""

from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from tikernels import checks, runtime
from tikernels._taichi import F32Array2, U8Array2, f32, i32, ti
from tikernels.arrays import F32, U8, Mask
from tikernels.errors import ShapeError
from tikernels.lanes import (
    Lanes,
    as_lanes,
    lane_count,
    lanes_at,
    load_lanes,
    planes,
    put_back,
    store_lanes,
    whole_rows,
    width_of,
)
from tikernels.launching import kernel
from tikernels.phase.balance_window import SIGMA_ACROSS, block_rows
from tikernels.phase.frame_statistics import MEDIAN_SIZE
from tikernels.phase.model_variance import model_variance
from tikernels.phase.phase_vector import TINY
from tikernels.phase.smoothing import THIRD_DIFFERENCE, left_of_differences, left_of_variance
from tikernels.phase.wide_blur import wide_blur

# The error of the channels' model is this share of a pixel's variance: it is fitted to some fifty samples for three
# channels' gains and offsets.
OWN_ERROR = 0.03
# Where part of the window that the model is fitted to is empty, as near an edge, it follows the other side's shading:
# an error in rad, whatever the noise, that grows with the root of that part.
_EDGE_ERROR = 0.025
# The standard deviation of a phase of which nothing is known but the cycle, rad: no more can be unsure.
_UNKNOWN = np.pi / np.sqrt(3)


@ti.func
def smoothed_noise(precision: f32, smoothed: f32, independent: f32) -> f32:
    """Return a pixel's variance by noise after smoothing, rad^2."""
    return independent * smoothed + OWN_ERROR / ti.max(precision, TINY)


@kernel
def compare_rows_kernel(
    phase: F32Array2,  # (H, W) rad, unwrapped
    precision: F32Array2,  # (H, W) 1 / rad^2
    model: F32Array2,  # (H, W) rad^2, the model's
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
        difference, noise, wrong, holds = 0.0, 0.0, 0.0, True
        for k in ti.static(range(len(THIRD_DIFFERENCE))):
            weight, row = ti.static(float(THIRD_DIFFERENCE[k])), y + k * step
            holds &= mask[row, x] != 0
            difference += weight * phase[row, x]
            noise += weight * weight * smoothed_noise(precision[row, x], smoothed[row, x], independent)
            wrong += weight * weight * model[row, x]
        ratio = ti.abs(difference) / ti.sqrt(noise + wrong)
        out[y, sample % columns] = ti.select(holds & (noise > wrong), ratio, ti.math.nan)


@cache
def _phase_sigma_kernel(wide: bool) -> Any:
    """Return the kernel for rows of vectors, or of numbers."""
    lanes = Lanes.of(wide)

    @kernel(whole_vectors=wide)
    def phase_sigma_kernel(
        precision: planes(wide),  # (H, W) 1 / rad^2
        model: planes(wide),  # (H, W) rad^2, the model's
        smoothed: planes(wide),  # (H, W) rad^2, the noise's after smoothing
        mask: planes(wide, ti.u8),  # (H, W)
        empty: planes(wide),  # (H, W) the part of the model's window that is off the mask
        scatter: f32,  # by how much more rows differ than expected
        out: planes(wide),  # (H, W) rad; NaN outside the mask
    ):
        height, width = out.shape[0], width_of(out, wide)
        for t in range(height * lane_count(width, wide)):
            y, place = lanes_at(t, width, wide)
            sure = load_lanes(precision, lanes.floats, y, place, width, wide)
            wrong = load_lanes(model, lanes.floats, y, place, width, wide)
            sigma = load_lanes(smoothed, lanes.floats, y, place, width, wide)
            holds = load_lanes(mask, lanes.bytes, y, place, width, wide)
            missing = load_lanes(empty, lanes.floats, y, place, width, wide)
            for k in range(lanes.count):
                noise = scatter * scatter * smoothed_noise(sure[k], sigma[k], 1.0)
                total = ti.sqrt(noise + wrong[k] + _EDGE_ERROR * _EDGE_ERROR * missing[k])
                sigma[k] = ti.select(holds[k] != 0, ti.min(total, _UNKNOWN), ti.math.nan)
            store_lanes(out, y, place, width, sigma, wide)

    return phase_sigma_kernel


def phase_sigma(
    precision: F32, model: F32, smoothed: F32, mask: U8, empty: F32, scatter: float, out: F32 | None = None
) -> F32:
    """Return the standard deviation of the smoothed phase.

    Parameters
    ----------
    precision : (H, W) float32
        1 / rad^2, one over the variance that the fit found.
    model : (H, W) float32
        rad^2, the variance that the channels' model leaves; see `model_variance`.
    smoothed : (H, W) float32
        rad^2, the variance by noise after smoothing.
    mask : (H, W) uint8
        Valid pixels.
    empty : (H, W) float32
        Part of the window that the channels' model is fitted to that is off the mask, 0..1.
    scatter : float
        Actual difference of rows, in units of what is expected.
    out : (H, W) float32, optional
        Output array.

    Returns
    -------
    (H, W) float32
        rad, at most pi / sqrt(3), as of a phase of which nothing is known; NaN off the mask. A buffer of the device if
        none is given.

    Raises
    ------
    ShapeError
        A shape or dtype is another one, or `out` cannot be written.
    """
    precision = checks.read_array("precision", precision, (None, None), np.float32)
    shape = (int(precision.shape[0]), int(precision.shape[1]))
    model = checks.read_array("model", model, shape, np.float32)
    smoothed = checks.read_array("smoothed", smoothed, shape, np.float32)
    mask = checks.read_array("mask", mask, shape, np.uint8)
    empty = checks.read_array("empty", empty, shape, np.float32)
    out = checks.out_buffer("out", out, shape, np.float32)
    rows, wide = whole_rows(precision, model, smoothed, mask, empty, out)
    seen = (as_lanes(array, wide) for array in rows[:-1])
    _phase_sigma_kernel(wide)(*seen, scatter, as_lanes(rows[-1], wide))
    put_back(rows[-1], out)
    return out


def compare_rows(
    phase: F32,
    precision: F32,
    model: F32,
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
    model : (H, W) float32
        rad^2, the variance that the channels' model leaves; see `model_variance`.
    smoothed : (H, W) float32
        rad^2, the variance by noise after smoothing.
    mask : (H, W) uint8
        Valid pixels.
    independent : float
        Variance of the differences that smoothing leaves, over what it would leave if the rows were independent.
    step, every : int
        px between the rows that are compared, and between the columns that are looked at.
    out : (H - 3 step, ceil(W / every)) float32, optional
        Output array.

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
    model = checks.read_array("model", model, (height, width), np.float32)
    smoothed = checks.read_array("smoothed", smoothed, (height, width), np.float32)
    mask = checks.read_array("mask", mask, (height, width), np.uint8)
    rows = height - (len(THIRD_DIFFERENCE) - 1) * step
    if rows <= 0:
        raise ShapeError(f"phase has {height} rows: four rows {step} px apart need {height - rows + 1}")
    out = checks.out_buffer("out", out, (rows, -(-width // every)), np.float32)
    compare_rows_kernel(phase, precision, model, smoothed, mask, independent, step, every, out)
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
        1 / rad^2, the fit's, of the phase before smoothing.
    smoothed : (H, W) float32
        rad^2, the variance that noise leaves after smoothing; see `Smoother`.
    misfit : (H, W) float32, optional
        Misfit of the model, see `FittedPhase`; None: the model is right.
    mask : (H, W) bool or uint8
        Valid pixels.
    edges : (H, W) float32, optional
        rad^2, what edges between surfaces make; see `surface_edges`; None: nothing.
    pairs : int
        Neighbours on either side that the smoothing fitted.
    period_px : float
        Camera px per cycle.

    Returns
    -------
    (H, W) float32
        rad; NaN off the mask; in a buffer of the device.

    Raises
    ------
    ShapeError
        A shape or dtype is another one.
    """
    mask = checks.read_mask("mask", mask, tuple(unwrapped.shape))
    inside = runtime.to_host(mask)  # synchronises
    if misfit is None:
        model = runtime.to_device(np.zeros(inside.shape, np.float32))
    else:
        model = model_variance(precision, misfit, mask, period_px)
    if edges is not None:
        model = runtime.to_device(runtime.to_host(model) + edges)  # synchronises
    known = (precision, model, smoothed, mask)
    scatter = _scatter(unwrapped, *known, pairs, period_px)
    return phase_sigma(*known, runtime.to_device(_empty_share(inside, period_px)), scatter)


def _scatter(
    unwrapped: F32, precision: F32, model: F32, smoothed: F32, mask: U8, pairs: int, period_px: float
) -> float:
    """Return how far rows a third of a cycle apart differ, in units of what is expected; 1 without evidence."""
    step, every = max(2, round(period_px / 3)), 2 * block_rows(period_px)
    if int(mask.shape[0]) <= (len(THIRD_DIFFERENCE) - 1) * step:
        return 1.0
    squares = sum(weight**2 for weight in THIRD_DIFFERENCE)
    independent = left_of_differences(pairs, step) / left_of_variance(pairs) / squares
    compared = compare_rows(unwrapped, precision, model, smoothed, mask, independent, step, every)
    ratio = runtime.to_host(compared)  # synchronises
    known = np.isfinite(ratio)
    return float(np.median(ratio[known])) / MEDIAN_SIZE if known.any() else 1.0


def _empty_share(inside: npt.NDArray[np.uint8], period_px: float) -> npt.NDArray[np.float32]:
    """Return which part of the balance window around each pixel is off the mask, (H, W) float32 in 0..1."""
    width_px = SIGMA_ACROSS * period_px
    share = wide_blur(inside.astype(np.float32), width_px, width_px)
    np.minimum(share, 1, out=share)
    return np.subtract(1, share, out=share)
