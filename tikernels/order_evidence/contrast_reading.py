"""Read a pattern's code: the contrast of every cycle in every patch.

The contrast of a cycle is its mean modulation over its mean background. Neither the surface's reflectance nor its
shading is in it; what changes it otherwise (ambient light, blur) changes slowly. Pixels weigh (1 - (phase / pi)^2)^2:
most in the middle of the cycle, where the symbol is its own, and in such a way that the ripple which a response that is
not linear gives the modulation, three times per cycle, sums up to nothing over a whole cycle, however few pixels it
has. What part of a cycle has of the ripple is summed, too.
"""

from functools import cache
from math import ceil
from typing import Any

import numpy as np
import numpy.typing as npt

from tikernels import checks, runtime
from tikernels._taichi import AnyArray3, F32Array2, F32Array3, I32Array2, U8Array2, f32, i32, ti, vec3, vec6
from tikernels.arrays import F32, LevelsImage
from tikernels.launching import kernel
from tikernels.phase.color_balance import Gains, gain_at
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.phase_vector import PI, color_at, matrix_of
from tikernels.phase.surfaces import neutral_light
from tikernels.raw.linearization import LEVEL_TYPES
from tikernels.unwrapping.patches import Patches
from tikernels.unwrapping.tables import (
    CELL_HEIGHT,
    CELL_WIDTH,
    NOTHING,
    ORDER_BITS,
    ORDER_MASK,
    ORDER_ZERO,
    Cell,
    add_alone,
    cell_bounds,
    patch_number,
)

#: A cell's columns are read in blocks so wide, px.
BLOCK_WIDTH = 4
BLOCKS = CELL_WIDTH // BLOCK_WIDTH
#: What is summed of a cycle: the weights, and the weighted modulation, background (levels), phase (rad), and cosine and
#: sine of three times the phase.
TOTAL, MODULATION, BACKGROUND, PHASE, COSINE, SINE = range(6)
SUMS = 6


@ti.func
def cosine(turns: f32) -> f32:
    """Cosine of a whole turn's fraction, to two hundredths: a smooth step from crest to trough."""
    half = 2.0 * ti.abs(turns - ti.round(turns))
    return 1.0 - 2.0 * half * half * (3.0 - 2.0 * half)


@ti.func
def add_cycle(label: i32, sums: vec6, block: i32, cells: I32Array2, draft_bits: i32, out_sums: F32Array3):
    """Add what one column shows of a cycle to the sums of its patch, order and block."""
    slot = (label & ORDER_MASK) - ORDER_ZERO + out_sums.shape[1] // 2
    if label >= 0 and slot >= 0 and slot < out_sums.shape[1]:
        patch = patch_number(label >> ORDER_BITS, cells, draft_bits)
        for k in ti.static(range(SUMS)):
            add_alone(out_sums[patch, slot, SUMS * block + k], sums[k])


@cache
def measure_contrast_kernel(mixed: bool) -> Any:
    """Return the kernel that sums every patch's modulation and background, order by order."""

    @kernel
    def measure_contrast(
        image: AnyArray3,  # (H, W, 3) levels
        surface_labels: U8Array2,  # (H, W) see `Surfaces`
        unmixing: F32Array3,  # (N, 3, 3)
        besides: F32Array2,  # (N, 3) levels
        inverse_matrix: F32Array2,  # (3, 3) undoes the crosstalk
        gains: F32Array3,  # (Hg, Wg, 3)
        spacing_px: i32,  # px between two nodes of the gains
        phase: F32Array2,  # (H, W) rad
        modulation: F32Array2,  # (H, W) levels
        labels: I32Array2,  # (H, W) patch and order inside it
        cells: I32Array2,  # (3, cells + 1) see `Cell`; numbered
        draft_bits: i32,
        out_sums: F32Array3,  # (patches, slots, BLOCKS SUMS) weight, and weighted modulation, background ...
    ):
        """Walk down the columns of each cell, cycle by cycle."""
        height, width = phase.shape[0], phase.shape[1]
        for cell in range(cells.shape[1] - 1):
            top, left, bottom, right = cell_bounds(cell, height, width)
            # The background is the mean of the projector's channels.
            means = matrix_of(inverse_matrix).transpose() @ vec3(1.0 / 3.0)
            for patch in range(cells[Cell.PATCHES, cell], cells[Cell.PATCHES, cell + 1]):
                for slot in range(out_sums.shape[1]):
                    for k in range(SUMS * BLOCKS):
                        out_sums[patch, slot, k] = 0.0
            # Within a cell the gains hardly change: along its middle column as in a straight line.
            middle = (left + right) // 2
            first = means * gain_at(gains, spacing_px, top, middle)
            change = (means * gain_at(gains, spacing_px, bottom, middle) - first) / (bottom - top)
            # Down a column a cycle's pixels follow each other.
            for x in range(left, right):
                block = (x - left) // BLOCK_WIDTH
                label, sums = NOTHING, vec6(0.0)
                for y in range(top, bottom):
                    here = labels[y, x]
                    if here != label:
                        add_cycle(label, sums, block, cells, draft_bits, out_sums)
                        label, sums = here, vec6(0.0)
                    # Beside a surface's end a pixel sees something else, too.
                    above, below = labels[ti.max(y - 1, 0), x], labels[ti.min(y + 1, height - 1), x]
                    before, after = labels[y, ti.max(x - 1, 0)], labels[y, ti.min(x + 1, width - 1)]
                    if ti.min(label, above, below, before, after) >= 0:
                        channels = neutral_light(color_at(image, y, x), unmixing, besides, surface_labels, y, x, mixed)
                        light = (first + (y - top) * change).dot(channels)
                        angle = phase[y, x]
                        ripple, within = 1.5 / PI * angle, 1.0 - angle * angle / (PI * PI)
                        seen = vec6(1.0, modulation[y, x], light, angle, cosine(ripple), cosine(ripple - 0.25))
                        sums += within * within * seen
                add_cycle(label, sums, block, cells, draft_bits, out_sums)

    return measure_contrast


def measure_contrast(
    image: LevelsImage,
    crosstalk: Crosstalk,
    gains: Gains,
    phase: F32,
    modulation: F32,
    patches: Patches,
    period_px: float,
) -> npt.NDArray[np.float32]:
    """Sum the modulation and the background of every cycle in every patch.

    Parameters
    ----------
    image : (H, W, 3) uint8, uint16 or float32
        Linear light, levels, stripes along the rows.
    crosstalk : Crosstalk
        Undone in the background.
    gains : Gains
        Measured on this image.
    phase : (H, W) float32
        rad in [-pi, pi].
    modulation : (H, W) float32
        Levels.
    patches : Patches
        The frame's.
    period_px : float
        Rows per cycle.

    Returns
    -------
    (P, slots, BLOCKS, SUMS) float32
        By patch, by the order in it with 0 in the middle, and by block: the sum of the weights, and the weighted sums
        of modulation and background (levels), of the phase (rad), and of the ripple's cosine and sine.

    Raises
    ------
    ShapeError
        A shape or dtype is another one.
    """
    image = checks.read_array("image", image, (*patches.shape, 3), *LEVEL_TYPES)
    phase = checks.read_array("phase", phase, patches.shape, np.float32)
    modulation = checks.read_array("modulation", modulation, patches.shape, np.float32)
    # As many orders as a cell holds, before its first pixel's and after it; slopes may double them.
    slots = 2 * ceil(2 * CELL_HEIGHT / period_px) + 1
    sums = runtime.empty((patches.count, slots, SUMS * BLOCKS), np.float32)
    surfaces = crosstalk.surfaces
    light = (image, surfaces.labels, surfaces.unmixing, surfaces.ambient, crosstalk.inverse)
    seen = (gains.gains, gains.spacing_px, phase, modulation)
    of_patches = (patches.labels, patches.cell_table, patches.draft_bits)
    measure_contrast_kernel(surfaces.mixed)(*light, *seen, *of_patches, sums)
    return runtime.to_host(sums).reshape(patches.count, slots, BLOCKS, SUMS)  # synchronises
