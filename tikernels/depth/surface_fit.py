"""Fit a quadric around every pixel, on its side of all steps, in a window as wide as the surface's own bend allows.

The quadric of `quadric.py` is fitted to samples 1, 2 and 4 px apart. A wider window is taken as long as the intervals
a +- 1.5 sigma_a of its value, of the narrower ones' and of the pixel itself have a value in common: what a window
flattens lies outside of them [1]. The narrowest is asked only where the second fails.

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

from tikernels import checks
from tikernels._taichi import F32Array2, F32Array3, U8Array2, f32, i32, ti
from tikernels.arrays import F32, U8, Mask
from tikernels.depth.quadric import column_run, fitted_quadric, measure_runs, precision_of
from tikernels.launching import kernel
from tikernels.strips import STRIP, strip_at, strip_count

# Windows with samples 1, 2 and 4 px apart.
_LEVELS = 3
# Half of an interval that must share a value with the others, in standard deviations: with 2 the rim of a simulated
# head is flattened by a millimetre, with 1 the wall behind it keeps a tenth more of its noise.
_HALF = 1.5
# The window that most pixels around one take counts, px; and no wider one than the narrowest of those beside it.
_ODD_PX, _NEAR_PX = 7, 5
# Levels are means over so few pixels that they differ by more than this or not at all.
_SAME_LEVEL = 1e-3


class FittedSurface(NamedTuple):
    """What the fit says of every pixel."""

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
    depth: F32Array2,  # (H, W)
    precision: F32Array2,  # (H, W) 1 / sigma^2
    mask: U8Array2,  # (H, W)
    links: U8Array2,  # (H, W) bits
    left: U8Array2,  # (H, W) linked pixels to the left
    right: U8Array2,  # (H, W) and to the right
    out_depth: F32Array2,  # (H, W)
    out_slope: F32Array3,  # (H, W, 2) a px, down and to the right
    out_sigma: F32Array2,  # (H, W)
    out_level: U8Array2,  # (H, W)
):
    height, width = depth.shape[0], depth.shape[1]
    for t in range(height * strip_count(width, STRIP)):
        y, first, count = strip_at(t, width, STRIP)
        for x in range(first, first + count):
            best, by_row, by_column, doubt, level = 0.0, 0.0, 0.0, 0.0, 0
            if mask[y, x] != 0:
                up, down = column_run(links, y, x)
                own = 1.0 / precision[y, x]
                doubt = own
                low, high = in_common(-1e30, 1e30, 0.0, own)
                # The second window, the third where that is accepted, the first where it is not.
                stride = 2
                for _ in range(2):
                    value, at_row, at_column, variance = fitted_quadric(
                        depth, precision, left, right, y, x, up, down, stride, own
                    )
                    lowest, highest = in_common(low, high, value, variance)
                    accepted = lowest <= highest
                    if accepted:
                        low, high = lowest, highest
                        best, doubt = value, ti.min(variance, own)
                        level = ti.select(stride == 4, 3, stride)
                    if accepted or stride == 1:  # the narrowest tells the slope in any case
                        by_row, by_column = at_row, at_column
                    stride = ti.select(accepted, 4, 1)
            out_depth[y, x] = depth[y, x] + best
            out_slope[y, x, 0], out_slope[y, x, 1] = by_row, by_column
            out_sigma[y, x] = ti.sqrt(doubt)
            out_level[y, x] = ti.cast(level, ti.u8)


@kernel
def blend_windows_kernel(
    depth: F32Array2,  # (H, W)
    precision: F32Array2,  # (H, W) 1 / sigma^2
    mask: U8Array2,  # (H, W)
    links: U8Array2,  # (H, W) bits
    left: U8Array2,  # (H, W) linked pixels to the left
    right: U8Array2,  # (H, W) and to the right
    level: F32Array2,  # (H, W) what to take, between whole levels a mean of both
    taken: U8Array2,  # (H, W) what has been taken
    fitted: F32Array2,  # (H, W) with that; becomes what is to be taken
    slope: F32Array3,  # (H, W, 2) likewise
    sigma: F32Array2,  # (H, W) likewise
):
    height, width = depth.shape[0], depth.shape[1]
    for t in range(height * strip_count(width, STRIP)):
        y, first, count = strip_at(t, width, STRIP)
        for x in range(first, first + count):
            # Read and written in any case: a GPU gets only what a kernel reads.
            value, doubt = fitted[y, x], sigma[y, x]
            by_row, by_column = slope[y, x, 0], slope[y, x, 1]
            if mask[y, x] != 0 and ti.abs(level[y, x] - taken[y, x]) > _SAME_LEVEL:
                up, down = column_run(links, y, x)
                own = 1.0 / precision[y, x]
                lower = ti.min(ti.cast(level[y, x], i32), _LEVELS - 1)
                value, doubt, by_row, by_column = depth[y, x], 0.0, 0.0, 0.0
                for k in range(2):
                    part = ti.abs(1.0 - k - level[y, x] + lower)
                    # Level 0 is the pixel itself, with the slope of the narrowest window.
                    above, at_row, at_column, variance = fitted_quadric(
                        depth, precision, left, right, y, x, up, down, 1 << ti.max(lower + k - 1, 0), own
                    )
                    by_row += part * at_row
                    by_column += part * at_column
                    if lower + k > 0:
                        value += part * above
                        doubt += part * ti.sqrt(ti.min(variance, own))
                    else:
                        doubt += part * ti.sqrt(own)
            fitted[y, x], sigma[y, x] = value, doubt
            slope[y, x, 0], slope[y, x, 1] = by_row, by_column


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
        What is on one surface with what; see `link_pixels`. None leads out of the mask.

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
    known = (depth, precision_of(sigma, mask), mask, links, *measure_runs(links))
    chosen = np.empty(shape, np.uint8)
    fitted, slope, doubt = np.empty(shape, np.float32), np.empty((*shape, 2), np.float32), np.empty(shape, np.float32)
    choose_windows_kernel(*known, fitted, slope, doubt, chosen)
    # What few pixels say of their window against all others is chance, and so are the lines along which a quadric
    # happens to be right.
    narrowest = cv2.erode(cv2.medianBlur(chosen, _ODD_PX), np.ones((_NEAR_PX, _NEAR_PX), np.uint8))
    level = cv2.blur(narrowest.astype(np.float32), (_NEAR_PX, _NEAR_PX))
    blend_windows_kernel(*known, level, chosen, fitted, slope, doubt)
    return FittedSurface(fitted, slope, doubt, np.asarray(level, np.float32))
