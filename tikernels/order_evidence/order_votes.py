"""Compare a frame's orders with those of the frame before, where both see a surface.

Between two frames of a video a surface moves by less than half a cycle of phase, so the whole cycles that a pixel's
phase lacks to that of the frame before are those that its region lacks to be absolute, wherever the pixel still sees
the same surface. Where it does not, it votes for anything: at the edges of what moves. A vote is sound where the frame
before shows no edge within reach. What has moved goes on moving: the frame before is taken with the change of phase
that each of its regions had last, so that half a cycle is what the motion may change by, and not the motion.
"""

import functools

import numpy as np
import numpy.typing as npt

from tikernels import checks, runtime
from tikernels._taichi import F32Array2, I32Array2, i32, ti
from tikernels.arrays import F32, I32
from tikernels.launching import kernel
from tikernels.phase.phase_vector import PI
from tikernels.unwrapping.patches import Patches
from tikernels.unwrapping.tables import (
    CELL_HEIGHT,
    CELL_WIDTH,
    ORDER_BITS,
    ORDER_MASK,
    ORDER_ZERO,
    Patch,
    cells_of,
    patch_number,
)

#: Pixels of a cell that vote: every fourth both ways.
VOTES_A_CELL = (CELL_HEIGHT // 4) * (CELL_WIDTH // 4)
#: Columns of the votes: patch (-1: none), whole cycles lacking, what is left over in parts of a cycle, region there
#: before, and whether the vote is sound.
PATCH, LACKING, REST, BEFORE, SOUND = range(5)
#: What is left over is counted in parts of a cycle.
RESTS_A_CYCLE = 64
# An edge is looked for at these distances (px): what moves by less from frame to frame votes for its own surface.
_REACH = (5, 10)
# Where the phase of three pixels in a row bends by more (rad), another surface begins, far enough away for its pixels
# to vote for another order; a ball's rim or a nose bends by 1 to 2 in a coarse image.
_MAX_BEND = 2.5


@ti.func
def smooth_around(phase: F32Array2, y: i32, x: i32) -> i32:
    """Return whether a surface continues around a pixel; not where the image ends."""
    height, width, far = phase.shape[0], phase.shape[1], ti.static(_REACH[-1])
    smooth = 0
    if ti.min(y, x) >= far and y < height - far and x < width - far:
        smooth = 1
        for reach in ti.static(_REACH):
            for dy, dx in ti.static(((0, 1), (1, 0), (1, 1), (1, -1))):
                one, other = phase[y - reach * dy, x - reach * dx], phase[y + reach * dy, x + reach * dx]
                bend = one + other - 2.0 * phase[y, x]
                if ti.math.isnan(bend) or ti.abs(bend) > _MAX_BEND:
                    smooth = 0
    return smooth


@kernel
def vote_orders_kernel(
    phase: F32Array2,  # (H, W) rad
    labels: I32Array2,  # (H, W) patch and order in it
    cells: I32Array2,  # (3, cells + 1) see `Cell`; numbered
    draft_bits: i32,
    patches: I32Array2,  # (11, capacity) see `Patch`; offsets are read
    before: F32Array2,  # (H, W) rad, unwrapped phase of the frame before; NaN outside its mask
    region_before: I32Array2,  # (H, W)
    change: F32Array2,  # (regions + 1, 3) rad by which the phase of each region before is expected to change, and its
    # slopes, rad per px, along rows and columns
    out_votes: I32Array2,  # (5, cells * VOTES_A_CELL)
):
    """Ask every fourth pixel both ways what its patch lacks to agree with the frame before."""
    height, width = phase.shape[0], phase.shape[1]
    columns = (width + CELL_WIDTH - 1) // CELL_WIDTH
    for vote in range(out_votes.shape[1]):
        cell, place = vote // VOTES_A_CELL, vote % VOTES_A_CELL
        y = (cell // columns) * CELL_HEIGHT + 4 * (place // (CELL_WIDTH // 4)) + 1
        x = (cell % columns) * CELL_WIDTH + 4 * (place % (CELL_WIDTH // 4)) + 1
        patch, cycles, rest, region, sound = -1, 0, 0, 0, 0
        if y < height and x < width:
            label = labels[y, x]
            region = region_before[y, x]
            if label >= 0 and region > 0:
                patch = patch_number(label >> ORDER_BITS, cells, draft_bits)
                order = (label & ORDER_MASK) - ORDER_ZERO + patches[Patch.OFFSET, patch]
                expected = before[y, x] + change[region, 0] + change[region, 1] * x + change[region, 2] * y
                lacking = (expected - phase[y, x]) / (2.0 * PI) - ti.cast(order, ti.f32)
                cycles = ti.cast(ti.round(lacking), i32)
                rest = ti.cast(ti.round(ti.cast(RESTS_A_CYCLE, ti.f32) * (lacking - ti.cast(cycles, ti.f32))), i32)
                sound = smooth_around(before, y, x)
        out_votes[PATCH, vote] = patch
        out_votes[LACKING, vote] = cycles
        out_votes[REST, vote] = rest
        out_votes[BEFORE, vote] = region
        out_votes[SOUND, vote] = sound


@functools.cache
def _vote_places(shape: tuple[int, int]) -> npt.NDArray[np.int64]:
    """Return the row and the column of every pixel that may vote in an image of this shape, (2, N)."""
    vote = np.arange(cells_of(*shape)[0] * cells_of(*shape)[1] * VOTES_A_CELL)
    (row, column), place = np.divmod(vote // VOTES_A_CELL, cells_of(*shape)[1]), vote % VOTES_A_CELL
    across = CELL_WIDTH // 4
    return np.stack([row * CELL_HEIGHT + 4 * (place // across) + 1, column * CELL_WIDTH + 4 * (place % across) + 1])


def vote_orders(
    phase: F32, patches: Patches, unwrapped_before: F32, region_before: I32, change: npt.NDArray[np.float32]
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int64]]:
    """Let pixels vote for the whole cycles that their patches lack to agree with the frame before.

    Parameters
    ----------
    phase : (H, W) float32
        rad in [-pi, pi].
    patches : Patches
        The frame's.
    unwrapped_before : (H, W) float32
        Unwrapped phase of the frame before, rad; NaN outside its mask.
    region_before : (H, W) int32
        Its regions.
    change : (regions + 1, 3) float32
        By how much the phase of each is expected to change since, rad, and the slopes of that along rows and columns,
        rad per px, the first pixel at 0.

    Returns
    -------
    votes : (N, 5) int32
        Patch, whole cycles lacking, what is left over in RESTS_A_CYCLE, region there before, and 1 where the vote is
        sound. Column by column in memory.
    places : (2, N) int64
        Row and column of each.

    Raises
    ------
    ShapeError
        A shape or dtype is another one.
    """
    phase = checks.read_array("phase", phase, patches.shape, np.float32)
    before = checks.read_array("unwrapped_before", unwrapped_before, patches.shape, np.float32)
    region_before = checks.read_array("region_before", region_before, patches.shape, np.int32)
    change = checks.read_array("change", change, (None, 3), np.float32)
    votes = runtime.empty((5, patches.cells * VOTES_A_CELL), np.int32)
    of_patches = (patches.labels, patches.cell_table, patches.draft_bits, patches.table)
    vote_orders_kernel(phase, *of_patches, before, region_before, change, votes)
    cast = runtime.to_host(votes)  # synchronises
    voting = np.flatnonzero(cast[PATCH] >= 0)
    return cast.take(voting, axis=1).T, _vote_places(patches.shape).take(voting, axis=1)
