"""The slopes of patches: where two surfaces touch the phase may go on, but seldom as steeply."""

import numpy as np
import numpy.typing as npt

from tikernels import runtime
from tikernels._taichi import F32Array2, I32Array2, Static, f32, i32, ti
from tikernels.arrays import F32, I32
from tikernels.launching import kernel
from tikernels.phase.phase_vector import PI
from tikernels.unwrapping.tables import (
    ORDER_BITS,
    ORDER_MASK,
    ORDER_ZERO,
    Cell,
    add_alone,
    cell_bounds,
    cell_count,
    patch_number,
)

# What is summed of a patch, x and y from its cell's corner, u its phase: 1, x, y, u, x x, x y, y y, x u, y u.
_SUMS = 9
# Of each block of this many pixels squared one is used: slopes are good to 0.003 rad per px at a noise of 0.03 rad.
_EVERY = 2
# A patch of a few pixels hardly shows a slope (px^2).
_PRIOR = 5.0


@ti.func
def add_pixel(x: f32, y: f32, u: f32, patch: i32, sums: Static):
    """Add a pixel to the sums of its patch."""
    terms = ti.Vector([1.0, x, y, u, x * x, x * y, y * y, x * u, y * u])
    for k in ti.static(range(_SUMS)):
        add_alone(sums[patch, k], terms[k])


@kernel
def sum_patches_kernel(
    phase: F32Array2,  # (H, W) rad
    labels: I32Array2,  # (H, W) patch and order in it
    cells: I32Array2,  # (3, cells + 1) see `Cell`; numbered
    draft_bits: i32,
    out_sums: F32Array2,  # (patches, _SUMS)
):
    """Sum up what a plane through each patch's phase needs."""
    height, width = phase.shape[0], phase.shape[1]
    for cell in range(cell_count(height, width)):
        top, left, bottom, right = cell_bounds(cell, height, width)
        for patch in range(cells[Cell.PATCHES, cell], cells[Cell.PATCHES, cell + 1]):
            for k in ti.static(range(_SUMS)):
                out_sums[patch, k] = 0.0
        for row in range((bottom - top) // _EVERY):
            for column in range((right - left) // _EVERY):
                y, x = top + _EVERY * row, left + _EVERY * column
                label = labels[y, x]
                if label >= 0:
                    u = phase[y, x] + 2.0 * PI * ti.cast((label & ORDER_MASK) - ORDER_ZERO, ti.f32)
                    place = ti.Vector([ti.cast(x - left, ti.f32), ti.cast(y - top, ti.f32)])
                    add_pixel(place[0], place[1], u, patch_number(label >> ORDER_BITS, cells, draft_bits), out_sums)


def measure_slopes(phase: F32, labels: I32, cells: I32, draft_bits: int, count: int) -> npt.NDArray[np.float64]:
    """Fit a plane to the phase of every patch.

    Parameters
    ----------
    phase : (H, W) float32
        rad in [-pi, pi].
    labels : (H, W) int32
        Patch and order in it.
    cells : (3, cells + 1) int32
        See `Cell`; numbered.
    draft_bits : int
        A cell has places for 2^bits patches.
    count : int
        Number of patches.

    Returns
    -------
    (2, P) float64
        Slopes along the rows and down the columns, rad per px.
    """
    sums = runtime.empty((count, _SUMS), np.float32)
    sum_patches_kernel(phase, labels, cells, draft_bits, sums)
    n, x, y, u, xx, xy, yy, xu, yu = runtime.to_host(sums).astype(np.float64).T  # synchronises
    n = np.maximum(n, 1)
    xx, xy, yy = xx - x * x / n + _PRIOR, xy - x * y / n, yy - y * y / n + _PRIOR
    xu, yu = xu - x * u / n, yu - y * u / n
    return np.asarray(np.stack([yy * xu - xy * yu, xx * yu - xy * xu]) / (xx * yy - xy * xy))
