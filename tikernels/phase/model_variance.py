"""Error of the channels' model, as a variance of the phase, determined by the fit's misfit.

    variance = misfit / precision + error

The mean of the misfit is one where the model is right, and a model that is wrong across the phase is as wrong along it:
the usual scaling of a fit's variance by its chi square, place by place. Over a few pixels `misfit` is that mean less
one, where chance does not make it: at an edge of paint, a highlight, a spot of another colour. Over the balance window
`error` is the mean of (misfit - 1) / precision, as of a surface whose colour acts otherwise than in the model.
"""

from functools import cache
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from tikernels import checks, runtime
from tikernels._taichi import F32Array2, U8Array2, f32, i32, ti
from tikernels.arrays import F32, U8
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
from tikernels.phase.balance_window import SIGMA_ACROSS, SIGMA_ALONG, block_rows
from tikernels.phase.phase_fit import MAX_MISFIT
from tikernels.phase.phase_vector import TINY

# Misfits are averaged over this many pixels both ways.
_AROUND_PX = 5
# In the mean over the window a pixel counts for no more than this, rad^2: a highlight is not its neighbourhood's error.
_MOST_VARIANCE = 0.25


@ti.func
def divided_by(misfit: f32) -> f32:
    """Return what the fit has divided a pixel's precision by already, for its misfit is large."""
    return ti.max(1.0, misfit * (1.0 / MAX_MISFIT))


@kernel
def sum_blocks_kernel(
    precision: F32Array2,  # (H, W) 1 / rad^2
    misfit: F32Array2,  # (H, W)
    mask: U8Array2,  # (H, W)
    step: i32,  # side of a block, px
    out_excess: F32Array2,  # (rows, columns) rad^2, the mean over a column of each block, 0 off the mask
    out_share: F32Array2,  # (rows, columns) which part of that lies on the mask
):
    """Average what the model's error adds to the variance, block by block."""
    height, width, columns = mask.shape[0], mask.shape[1], out_share.shape[1]
    for block in range(out_share.shape[0] * columns):
        row, column = block // columns, block % columns
        x = ti.min(column * step + step // 2, width - 1)
        first, stop = row * step, ti.min((row + 1) * step, height)
        excess, share = 0.0, 0.0
        for y in range(first, stop):
            if mask[y, x] != 0:
                sure = ti.max(divided_by(misfit[y, x]) * precision[y, x], TINY)
                variance = (misfit[y, x] - 1.0) / sure
                excess += ti.min(variance, _MOST_VARIANCE)
                share += 1.0
        out_excess[row, column] = excess / ti.cast(stop - first, ti.f32)
        out_share[row, column] = share / ti.cast(stop - first, ti.f32)


@cache
def _model_variance_kernel(wide: bool) -> Any:
    """Return the kernel for rows of vectors, or of numbers."""
    lanes = Lanes.of(wide)

    @kernel(whole_vectors=wide)
    def model_variance_kernel(
        precision: planes(wide),  # (H, W) 1 / rad^2
        misfit: planes(wide),  # (H, W)
        total: planes(wide),  # (H, W) of the misfits around
        count: planes(wide),  # (H, W) of pixels around that are on the mask
        error: planes(wide),  # (H, W) rad^2, over the balance window
        out: planes(wide),  # (H, W) rad^2
    ):
        height, width = out.shape[0], width_of(out, wide)
        for t in range(height * lane_count(width, wide)):
            y, place = lanes_at(t, width, wide)
            own = load_lanes(misfit, lanes.floats, y, place, width, wide)
            sure = load_lanes(precision, lanes.floats, y, place, width, wide)
            sums = load_lanes(total, lanes.floats, y, place, width, wide)
            counts = load_lanes(count, lanes.floats, y, place, width, wide)
            variance = load_lanes(error, lanes.floats, y, place, width, wide)
            for k in range(lanes.count):
                many = ti.max(counts[k], 1.0)
                mean = sums[k] / many
                # Beyond two standard deviations of the mean where the model is right.
                beyond = ti.select(mean > 1.0 + 2.0 * ti.sqrt(2.0 / many), mean - 1.0, 0.0)
                variance[k] += beyond / (divided_by(own[k]) * ti.max(sure[k], TINY))
            store_lanes(out, y, place, width, variance, wide)

    return model_variance_kernel


def model_variance(precision: F32, misfit: F32, mask: U8, period_px: float, out: F32 | None = None) -> F32:
    """Return the variance that the channels' model leaves, whatever is averaged over.

    Parameters
    ----------
    precision : (H, W) float32
        1 / rad^2, one over the variance that the fit found.
    misfit : (H, W) float32
        Misfit of the model; see `FittedPhase`.
    mask : (H, W) uint8
        Valid pixels.
    period_px : float
        Camera px per cycle.
    out : (H, W) float32, optional
        Output array.

    Returns
    -------
    (H, W) float32
        rad^2. A buffer of the device if none is given.

    Raises
    ------
    ShapeError
        A shape or dtype is another one, or `out` cannot be written.
    """
    precision = checks.read_array("precision", precision, (None, None), np.float32)
    shape = (int(precision.shape[0]), int(precision.shape[1]))
    misfit = checks.read_array("misfit", misfit, shape, np.float32)
    mask = checks.read_array("mask", mask, shape, np.uint8)
    out = checks.out_buffer("out", out, shape, np.float32)
    inside, seen = runtime.to_host(mask), runtime.to_host(misfit)  # synchronises
    # What is beyond is the pixel's own, and not its neighbours'.
    counted = np.where(inside != 0, np.minimum(seen, np.float32(MAX_MISFIT)), np.float32(0))
    sums = (_sums_around(counted), _sums_around(inside), _window_error(precision, misfit, mask, period_px))
    rows, wide = whole_rows(precision, misfit, *(runtime.to_device(part) for part in sums), out)
    _model_variance_kernel(wide)(*(as_lanes(array, wide) for array in rows))
    put_back(rows[-1], out)
    return out


def _sums_around(values: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    """Return the sums over the pixels around each, (H, W) float32; beyond the image there is nothing."""
    sums, side = runtime.empty_on_host(values.shape, np.float32), (_AROUND_PX, _AROUND_PX)
    cv2.boxFilter(values, cv2.CV_32F, side, sums, normalize=False, borderType=cv2.BORDER_CONSTANT)
    return sums


def _window_error(precision: F32, misfit: F32, mask: U8, period_px: float) -> npt.NDArray[np.float32]:
    """Return the variance that the model leaves over the balance window, (H, W) float32, rad^2."""
    height, width = (int(length) for length in mask.shape)
    step = block_rows(period_px)
    blocks = (-(-height // step), -(-width // step))
    excess, share = runtime.empty(blocks, np.float32), runtime.empty(blocks, np.float32)
    sum_blocks_kernel(precision, misfit, mask, step, excess, share)
    along, across = SIGMA_ALONG * period_px / step, SIGMA_ACROSS * period_px / step
    sums, shares = (
        cv2.GaussianBlur(runtime.to_host(part), (0, 0), along, sigmaY=across) for part in (excess, share)
    )  # synchronises
    error = np.maximum(sums / np.maximum(shares, np.float32(TINY)), 0)
    between = runtime.empty_on_host((blocks[0] * step, blocks[1] * step), np.float32)
    cv2.resize(error, between.shape[::-1], between, interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(between[:height, :width])
