"""Write the unwrapped phase, the mask and the regions; leave out what contradicts itself next to a step.

The last pixel before a step is left out where the step has a pixel that belongs to neither side, or where only the
orders show it: at the rim of a round object it can pass for the other surface. So are cells that hide a step.
"""

from functools import cache
from typing import Any

import numpy as np

from tikernels._taichi import F32Array2, I32Array1, I32Array2, Static, f32, i32, ti
from tikernels.arrays import F32, I32, U8
from tikernels.lanes import (
    Lanes,
    as_lanes,
    in_vectors,
    lane_count,
    lanes_at,
    load_lanes,
    planes,
    store_lanes,
)
from tikernels.launching import constant, kernel
from tikernels.phase.phase_vector import PI
from tikernels.phase.smoothing import MAX_DEPARTURE
from tikernels.unwrapping.continuity import frame_rates
from tikernels.unwrapping.tables import (
    BETWEEN,
    CELL_HEIGHT,
    CELL_WIDTH,
    CONTACT_BITS,
    HAS_STEPS,
    HIDES_STEP,
    ORDER_BITS,
    ORDER_MASK,
    ORDER_ZERO,
    Cell,
    Contact,
    Final,
    Patch,
    Region,
    patch_number,
    step_to,
)

# Phase and labels again where they are not wide: nothing. A GPU copies NumPy arrays there and back, each argument by
# itself, so none may be there twice.
_NO_ROWS: tuple[F32, I32] = (constant(np.zeros((1, 1), np.float32)), constant(np.zeros((1, 1), np.int32)))


@ti.func
def mark_overruled(cell: i32, cells: I32Array2, draft_bits: i32, patches: I32Array2, draft_contacts: I32Array2):
    """Mark the cells at both ends of each contact that the orders of its patches have not followed."""
    for k in range(cells[Cell.CONTACTS, cell + 1] - cells[Cell.CONTACTS, cell]):
        e = (cell << (draft_bits + CONTACT_BITS)) + k
        draft_a, draft_b = draft_contacts[Contact.FROM, e], draft_contacts[Contact.TO, e]
        a, b = patch_number(draft_a, cells, draft_bits), patch_number(draft_b, cells, draft_bits)
        if patches[Patch.OFFSET, b] != patches[Patch.OFFSET, a] + draft_contacts[Contact.SHIFT, e]:
            cells[Cell.STEPS, draft_a >> draft_bits] = 1
            cells[Cell.STEPS, draft_b >> draft_bits] = 1


@kernel
def finish_patches_kernel(
    serial: Static,  # whether one thread does it
    cell_total: i32,
    columns: i32,  # cells a row
    cells: I32Array2,  # (3, cells + 1) see `Cell`; numbered; steps are marked
    draft_bits: i32,
    patches: I32Array2,  # (11, capacity) see `Patch`
    draft_contacts: I32Array2,  # (5, 4 cells << bits) see `Contact`
    regions: I32Array2,  # (4, capacity) see `Region`
    numbers: I32Array1,  # number of the region of each root; 0: too small
    out_final: I32Array2,  # (3, cells << bits) see `Final`
):
    """Collect what is needed to write the result, and find the cells that have steps or are next to one that has."""
    ti.loop_config(serialize=serial)
    for cell in range(cell_total):
        for k in range(cells[Cell.PATCHES, cell + 1] - cells[Cell.PATCHES, cell]):
            draft, patch = (cell << draft_bits) + k, cells[Cell.PATCHES, cell] + k
            root = patches[Patch.ROOT, patch]
            number = ti.select(patches[Patch.PIXELS, patch] > 0, numbers[root], 0)
            out_final[Final.REGION, draft] = number
            out_final[Final.ORDER, draft] = patches[Patch.OFFSET, patch] - regions[Region.ORDER, root] - ORDER_ZERO
            if number == 0:
                cells[Cell.STEPS, cell] = 1
        mark_overruled(cell, cells, draft_bits, patches, draft_contacts)
    ti.loop_config(serialize=serial)
    for cell in range(cell_total):
        column = cell % columns
        steps = cells[Cell.STEPS, cell]
        if column > 0:
            steps |= cells[Cell.STEPS, cell - 1]
        if column < columns - 1:
            steps |= cells[Cell.STEPS, cell + 1]
        if cell >= columns:
            steps |= cells[Cell.STEPS, cell - columns]
        if cell + columns < cell_total:
            steps |= cells[Cell.STEPS, cell + columns]
        out_final[Final.STEPS, cell] = steps * HAS_STEPS


@ti.func
def beyond_step(
    phase: F32Array2, labels: I32Array2, final: I32Array2, y: i32, x: i32, y2: i32, x2: i32, rate: f32
) -> i32:
    """Return whether a neighbour's region is too small, or the same one whole cycles away."""
    label, label2 = labels[y, x], labels[y2, x2]
    draft, draft2 = label >> ORDER_BITS, label2 >> ORDER_BITS
    beyond = 0
    if final[Final.REGION, draft2] == 0:
        beyond = 1
    if final[Final.REGION, draft2] == final[Final.REGION, draft]:
        cycles = (label2 & ORDER_MASK) - (label & ORDER_MASK)
        cycles += final[Final.ORDER, draft2] - final[Final.ORDER, draft]
        change = phase[y2, x2] - phase[y, x] + 2.0 * PI * ti.cast(cycles, ti.f32)
        if ti.abs(change - rate) > 2.0 * MAX_DEPARTURE:
            beyond = 1
    return beyond


@ti.func
def beside_step(phase: F32Array2, rates: F32Array2, labels: I32Array2, final: I32Array2, y: i32, x: i32) -> i32:
    """Return whether a neighbour saw two surfaces, is too small a region, or lies whole cycles away."""
    along, across, _ = frame_rates(rates)
    beside = 0
    for side in range(4):
        dy, dx = step_to(side)
        y2 = ti.min(ti.max(y + dy, 0), labels.shape[0] - 1)
        x2 = ti.min(ti.max(x + dx, 0), labels.shape[1] - 1)
        label2 = labels[y2, x2]
        if label2 == BETWEEN:
            beside = 1
        if label2 >= 0 and label2 >> ORDER_BITS != labels[y, x] >> ORDER_BITS:
            beside |= beyond_step(phase, labels, final, y, x, y2, x2, dx * along + dy * across)
    return beside


@ti.func
def leave_out_steps(
    phase: F32Array2,
    rates: F32Array2,
    labels: I32Array2,
    final: I32Array2,
    steps: i32,
    y: i32,
    first: i32,
    start: i32,
    stop: i32,
    region: Static,
):
    """Take pixels of a row that lie in one cell out of their regions: all of them, or those next to a step."""
    if steps == HIDES_STEP:
        for k in range(start, stop):
            region[k] = 0
    if steps == HAS_STEPS:
        for k in range(start, stop):
            if region[k] > 0:
                region[k] = region[k] * (1 - beside_step(phase, rates, labels, final, y, first + k))


@ti.func
def find_regions(label: Static, final: I32Array2, start: Static, count: i32, region: Static):
    """Find the regions of a row's pixels that lie in one cell, and their orders, which take the place of the labels."""
    draft, differs = label[start] >> ORDER_BITS, 0
    for k in range(start, start + CELL_WIDTH):
        differs |= (label[k] >> ORDER_BITS) ^ draft
    if differs == 0 and draft >= 0:
        # Most rows of a cell are one patch's.
        number, order = final[Final.REGION, draft], final[Final.ORDER, draft]
        for k in range(start, start + CELL_WIDTH):
            region[k] = number
            label[k] = (label[k] & ORDER_MASK) + order
    else:
        for k in range(start, ti.min(start + CELL_WIDTH, count)):
            if label[k] >= 0:
                own = label[k] >> ORDER_BITS
                region[k] = final[Final.REGION, own]
                label[k] = (label[k] & ORDER_MASK) + final[Final.ORDER, own]


@ti.func
def write_cell(
    phase: F32Array2,
    rates: F32Array2,
    labels: I32Array2,
    final: I32Array2,
    cell: i32,
    c: Static,
    y: i32,
    first: i32,
    count: i32,
    label: Static,
    region: Static,
):
    """Find the regions and orders of a row's pixels that lie in the c-th cell from `cell` on; none at steps."""
    find_regions(label, final, c * CELL_WIDTH, count, region)
    steps, stop = final[Final.STEPS, cell + c], ti.min((c + 1) * CELL_WIDTH, count)
    leave_out_steps(phase, rates, labels, final, steps, y, first, c * CELL_WIDTH, stop, region)


@cache
def _write_unwrapped_kernel(wide: bool) -> Any:
    """Return the kernel for rows of vectors, or of numbers."""
    lanes = Lanes.of(wide)

    @kernel(whole_vectors=wide)
    def write_unwrapped_kernel(
        phase: F32Array2,  # (H, W) rad; NO_PHASE outside the mask
        rates: F32Array2,  # see `frame_rates`
        labels: I32Array2,  # (H, W)
        final: I32Array2,  # (3, cells << bits) see `Final`
        phase_rows: planes(wide),  # (H, W) the phase again, if it is wide,
        label_rows: planes(wide, ti.i32),  # (H, W) and the labels
        out_unwrapped: planes(wide),  # (H, W) rad; NaN outside the mask
        out_mask: planes(wide, ti.u8),  # (H, W) 1 inside
        out_region: planes(wide, ti.i32),  # (H, W) region's number from 1; 0 outside
    ):
        height, width = phase.shape[0], phase.shape[1]
        cells = (width + CELL_WIDTH - 1) // CELL_WIDTH
        for t in range(height * lane_count(width, wide)):
            y, place = lanes_at(t, width, wide)
            first, count = place * lanes.count, ti.min(lanes.count, width - place * lanes.count)
            label, unwrapped = lanes.integers(0), lanes.floats(0.0)
            if ti.static(wide):
                label, unwrapped = label_rows[y, place], phase_rows[y, place]
            else:
                label = load_lanes(labels, lanes.integers, y, place, width, wide)
                unwrapped = load_lanes(phase, lanes.floats, y, place, width, wide)
            region, inside = lanes.integers(0), lanes.bytes(0)
            cell = (y // CELL_HEIGHT) * cells + first // CELL_WIDTH
            for c in range((count + CELL_WIDTH - 1) // CELL_WIDTH):
                write_cell(phase, rates, labels, final, cell, c, y, first, count, label, region)
            for k in range(lanes.count):
                value = unwrapped[k] + 2.0 * PI * ti.cast(label[k], ti.f32)
                unwrapped[k] = ti.select(region[k] > 0, value, ti.math.nan)
                inside[k] = ti.cast(region[k] > 0, ti.u8)
            store_lanes(out_unwrapped, y, place, width, unwrapped, wide)
            store_lanes(out_mask, y, place, width, inside, wide)
            store_lanes(out_region, y, place, width, region, wide)

    return write_unwrapped_kernel


def write_unwrapped(
    phase: F32, rates: F32, labels: I32, final: I32, out_unwrapped: F32, out_mask: U8, out_region: I32
) -> None:
    """Write every pixel's phase with its order, unless it is outside the regions or next to a step.

    Parameters
    ----------
    phase : (H, W) float32
        rad; NO_PHASE outside the mask.
    rates : (N, 5) float32
        See `frame_rates`.
    labels : (H, W) int32
        Patch and order in it.
    final : (3, cells << bits) int32
        See `Final`.
    out_unwrapped : (H, W) float32
        rad; NaN outside the mask.
    out_mask : (H, W) uint8
        1 inside.
    out_region : (H, W) int32
        The region's number from 1; 0 outside.
    """
    outputs = (out_unwrapped, out_mask, out_region)
    wide = in_vectors(phase, labels, *outputs)
    again = (phase, labels) if wide else _NO_ROWS
    rows = (as_lanes(array, wide) for array in (*again, *outputs))
    _write_unwrapped_kernel(wide)(phase, rates, labels, final, *rows)
