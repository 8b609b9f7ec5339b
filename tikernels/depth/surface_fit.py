"""Fit a quadric around every pixel, on its side of all steps, in a window as wide as the surface's own bend allows.

The quadric of `quadric.py` is fitted to samples 1, 2 and 4 px apart. A wider window is taken as long as the intervals
a +- 1.5 sigma_a of its value, of the narrower ones' and of the pixel itself have a value in common: what a window
flattens lies outside of them [1]. The narrowest is tried only where the second fails.

References
----------
1. A. Goldenshluger, A. Nemirovski, On spatially adaptive estimation of nonparametric regression, Mathematical Methods
   of Statistics 6, 135 (1997); V. Katkovnik, IEEE Transactions on Signal Processing 47, 2567 (1999),
   doi:10.1109/78.782208.
"""

from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from tikernels import checks, runtime
from tikernels._taichi import F32Array2, F32Array3, F32Array4, U8Array2, f32, i32, ti
from tikernels.arrays import F32, U8, Mask
from tikernels.depth.quadric import WINDOWS, Fit, fit_windows, measure_runs, precision_of
from tikernels.launching import kernel
from tikernels.strips import STRIP, strip_at, strip_count

# Half of an interval that must share a value with the others, in standard deviations: with 2 the rim of a simulated
# head is flattened by a millimetre, with 1 the wall behind it keeps a tenth more of its noise.
_HALF = 1.5
# The window that most pixels around one take counts, px; and no wider one than the narrowest of those next to it.
_ODD_PX, _NEAR_PX = 7, 5
# Where a surface ends it often bends away, and a wide window has seen one side only: as near as this, px, a pixel takes
# no wider window than its own choice, and not the widest.
_END_PX, _WIDEST_AT_END = 3, WINDOWS - 1
# Rows that are fitted at a time, so that all windows' fits of a large picture need not be kept; and those next to them
# that determine which window counts.
_ROWS, _BESIDE = 256, _ODD_PX // 2 + 2 * (_NEAR_PX // 2)


class FittedSurface(NamedTuple):
    """Results of the fit at every pixel."""

    depth: npt.NDArray[np.float32]
    """(H, W) float32: the quadric's value, in the depth's unit; where there is no pixel, as it was."""
    slope: npt.NDArray[np.float32]
    """(H, W, 2) float32: its change a px down and to the right."""
    sigma: npt.NDArray[np.float32]
    """(H, W) float32: the value's standard deviation, by that of the pixels; 0 where there is none."""
    level: npt.NDArray[np.float32]
    """(H, W) float32: how wide the window was: 0 the pixel itself, 1 to 3 for samples 1, 2 and 4 px apart."""


@ti.func
def in_common(low: f32, high: f32, value: f32, variance: f32):
    """Return what an interval has in common with a value's own."""
    half = _HALF * ti.sqrt(variance)
    return ti.max(low, value - half), ti.min(high, value + half)


@kernel
def choose_windows_kernel(
    fits: F32Array4,  # (3, 4, rows, W) see `fit_windows`
    precision: F32Array2,  # (H, W) 1 / sigma^2
    mask: U8Array2,  # (H, W)
    top: i32,  # the first of the rows
    out_level: U8Array2,  # (rows, W)
):
    width = mask.shape[1]
    for t in range(out_level.shape[0] * strip_count(width, STRIP)):
        row, first, count = strip_at(t, width, STRIP)
        y = top + row
        for x in range(first, first + count):
            level = 0
            if mask[y, x] != 0:
                low, high = in_common(-1e30, 1e30, 0.0, 1.0 / precision[y, x])
                # The second window, the third where that is accepted, the first where it is not.
                window = 1
                for _ in range(2):
                    value, variance = fits[window, Fit.VALUE, row, x], fits[window, Fit.VARIANCE, row, x]
                    lowest, highest = in_common(low, high, value, variance)
                    accepted = lowest <= highest
                    if accepted:
                        low, high, level = lowest, highest, window + 1
                    window = ti.select(accepted, 2, 0)
            out_level[row, x] = ti.cast(level, ti.u8)


@kernel
def blend_windows_kernel(
    fits: F32Array4,  # (3, 4, rows, W) see `fit_windows`
    depth: F32Array2,  # (H, W)
    precision: F32Array2,  # (H, W) 1 / sigma^2
    mask: U8Array2,  # (H, W)
    top: i32,  # the first of the rows
    level: F32Array2,  # (rows, W) what to take, between whole levels a mean of both
    wanted: i32,  # the first row that is wanted
    out_depth: F32Array2,  # (wanted rows, W)
    out_slope: F32Array3,  # (wanted rows, W, 2) a px, down and to the right
    out_sigma: F32Array2,  # (wanted rows, W)
):
    width = mask.shape[1]
    for t in range(out_depth.shape[0] * strip_count(width, STRIP)):
        number, first, count = strip_at(t, width, STRIP)
        y = wanted + number
        row = y - top
        for x in range(first, first + count):
            value, doubt, by_row, by_column = 0.0, 0.0, 0.0, 0.0
            if mask[y, x] != 0:
                own = 1.0 / precision[y, x]
                lower = ti.min(ti.cast(level[row, x], i32), WINDOWS - 1)
                for k in range(2):
                    part = ti.abs(1.0 - k - level[row, x] + lower)
                    # Level 0 is the pixel itself, with the slope of the narrowest window.
                    window = ti.max(lower + k - 1, 0)
                    by_row += part * fits[window, Fit.SLOPE_DOWN, row, x]
                    by_column += part * fits[window, Fit.SLOPE_RIGHT, row, x]
                    if lower + k > 0:
                        value += part * fits[window, Fit.VALUE, row, x]
                        doubt += part * ti.sqrt(ti.min(fits[window, Fit.VARIANCE, row, x], own))
                    else:
                        doubt += part * ti.sqrt(own)
            out_depth[number, x] = depth[y, x] + value
            out_slope[number, x, 0], out_slope[number, x, 1] = by_row, by_column
            out_sigma[number, x] = doubt


def fit_surface(depth: F32, sigma: F32, mask: Mask, links: U8) -> FittedSurface:
    """Fit a quadric around every pixel.

    Parameters
    ----------
    depth : (H, W) float32
        In mm or rad; of no account outside the mask.
    sigma : (H, W) float32
        Its standard deviation, in the same unit; positive.
    mask : (H, W) bool or uint8
        Pixels that have a depth.
    links : (H, W) uint8
        Links between pixels of one surface; see `link_pixels`. None leads out of the mask.

    Returns
    -------
    FittedSurface
        Value, slopes, standard deviation and window.

    Raises
    ------
    ShapeError
        A shape or dtype is another one.
    """
    depth = checks.read_array("depth", depth, (None, None), np.float32)
    shape = (int(depth.shape[0]), int(depth.shape[1]))
    sigma = checks.read_array("sigma", sigma, shape, np.float32)
    mask = checks.read_mask("mask", mask, shape)
    links = checks.read_array("links", links, shape, np.uint8)
    precision, runs, counts = precision_of(sigma, mask), measure_runs(links), runtime.to_host(mask)
    fitted, level, doubt = (np.empty(shape, np.float32) for _ in range(3))
    slope = np.empty((*shape, 2), np.float32)
    for first in range(0, shape[0], _ROWS):
        last = min(first + _ROWS, shape[0])
        top, bottom = max(first - _BESIDE, 0), min(last + _BESIDE, shape[0])
        fits = np.empty((WINDOWS, len(Fit), bottom - top, shape[1]), np.float32)
        fit_windows(depth, precision, runs, top, fits)
        chosen = np.empty((bottom - top, shape[1]), np.uint8)
        choose_windows_kernel(fits, precision, mask, top, chosen)
        wide = _agreed(chosen, counts[top:bottom])
        level[first:last] = wide[first - top : last - top]
        # The rows alone: what a GPU writes to a part of an array, it would write to all of it.
        out = (fitted[first:last], slope[first:last], doubt[first:last])
        blend_windows_kernel(fits, depth, precision, mask, top, wide, first, *out)
    return FittedSurface(fitted, slope, doubt, level)


def _agreed(chosen: npt.NDArray[np.uint8], mask: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    """Return which window to take, by what the pixels around each one chose: what is off the mask does not count.

    What few pixels say of their window against all others is chance, and so are the lines along which a quadric happens
    to be right.
    """
    inside = (mask != 0).view(np.uint8)
    half = _summed(inside, _ODD_PX) // 2
    most = np.zeros_like(chosen)
    for least in range(1, WINDOWS + 1):
        most += _summed((chosen >= least).view(np.uint8), _ODD_PX) > half
    near = np.ones((_NEAR_PX, _NEAR_PX), np.uint8)
    narrowest = cv2.erode(np.where(inside, most, np.uint8(WINDOWS)), near) * inside
    mean = _summed(narrowest, _NEAR_PX) / np.maximum(_summed(inside, _NEAR_PX), 1, dtype=np.float32)
    end = cv2.erode(inside, np.ones((2 * _END_PX + 1, 2 * _END_PX + 1), np.uint8)) == 0
    return np.asarray(np.where(end, np.minimum(mean, np.minimum(chosen, _WIDEST_AT_END)), mean) * inside)


def _summed(pixels: npt.NDArray[np.uint8], size_px: int) -> npt.NDArray[np.uint8]:
    """Return the sum over a square around each pixel; beyond the image goes on what is at its border."""
    summed = cv2.boxFilter(pixels, -1, (size_px, size_px), normalize=False, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(summed)
