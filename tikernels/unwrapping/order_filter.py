"""Correct single wrong orders by their surroundings: the in-place filter of section 4.2 of Je, Lee and Park 2004.

phi2 = phi1 + 2 pi round((mean of phi over the window - phi1) / 2 pi), pixel after pixel from the image's centre: its
row to the left, then to the right, then row by row up, then down (equation 4.3). In place means that a pixel sees its
corrected predecessors, which makes the filter sequential. But a pixel can only change if its window requires it with
nothing corrected, or if a predecessor in its window changed; so all windows are summed in parallel first, and only what
can change is looked at again, until nothing changes any more. What is left then obeys the sequential filter's equation
at every pixel, and as each pixel depends on its predecessors alone, there is only one such result.

Phases are summed as integers, 2^16 per cycle: such sums are exact in any order, so that the orders agree bit for bit
however the work is divided. A sum may wrap around; its difference from a multiple of the pixel's own phase does not
while the mean lies within 2^15 / window^2 cycles.
"""

import numpy as np

from tikernels import checks, runtime
from tikernels._taichi import F32Array2, I32Array1, I32Array2, U8Array2, i32, ti
from tikernels.arrays import F32, Mask
from tikernels.errors import ShapeError
from tikernels.launching import kernel
from tikernels.phase.phase_vector import PI
from tikernels.strips import STRIP, strip_at, strip_count
from tikernels.transposing import transpose

_CYCLE = 2**16
_BAND = 32  # rows that one thread walks down

_MAX_WINDOW_PX = 31  # 961 pixels: means within 34 cycles


@kernel
def sum_rows_kernel(
    unwrapped: F32Array2,  # (H, W) rad
    mask: U8Array2,  # (H, W)
    reach: i32,  # px on either side
    out_phase: I32Array2,  # (H, W) 2^16 per cycle; 0 outside the mask
    out_sums: I32Array2,  # (H, W) over the window's row
    out_counts: I32Array2,  # (H, W) valid pixels in it
):
    """Count phases as integers, and sum them over the window's row around every pixel."""
    height, width = unwrapped.shape[0], unwrapped.shape[1]
    for t in range(height * strip_count(width, STRIP)):
        y, start, length = strip_at(t, width, STRIP)
        for x in range(start, start + length):
            phase = 0
            if mask[y, x] != 0:
                phase = ti.cast(ti.round(unwrapped[y, x] * (_CYCLE / (2.0 * PI))), ti.i32)
            out_phase[y, x] = phase
    for t in range(height * strip_count(width, STRIP)):
        y, start, length = strip_at(t, width, STRIP)
        total, count = 0, 0
        for x in range(ti.max(start - reach, 0), ti.min(start + reach, width)):
            total += out_phase[y, x]
            count += ti.cast(mask[y, x] != 0, ti.i32)
        for x in range(start, start + length):
            if x + reach < width:
                total += out_phase[y, x + reach]
                count += ti.cast(mask[y, x + reach] != 0, ti.i32)
            out_sums[y, x] = total
            out_counts[y, x] = count
            if x - reach >= 0:
                total -= out_phase[y, x - reach]
                count -= ti.cast(mask[y, x - reach] != 0, ti.i32)


@ti.func
def rounded_cycles(excess: i32, count: i32) -> i32:
    """Round excess / count to whole cycles, halves away from zero."""
    cycle = count * _CYCLE
    cycles = (ti.abs(excess) + cycle // 2) // cycle
    return ti.select(excess < 0, -cycles, cycles)


@ti.func
def sum_down(
    row_sums: I32Array2,
    row_counts: I32Array2,
    reach: i32,
    top: i32,
    start: i32,
    stop: i32,
    out_totals: I32Array2,
    out_counts: I32Array2,
):
    """Sum the rows' sums over whole windows, from row to row down a band of columns."""
    height = row_sums.shape[0]
    for x in range(start, stop):
        total, count = 0, 0
        for y in range(ti.max(top - reach, 0), ti.min(top + reach + 1, height)):
            total += row_sums[y, x]
            count += row_counts[y, x]
        out_totals[top, x] = total
        out_counts[top, x] = count
    for y in range(top + 1, ti.min(top + _BAND, height)):
        for x in range(start, stop):
            total, count = out_totals[y - 1, x], out_counts[y - 1, x]
            if y + reach < height:
                total += row_sums[y + reach, x]
                count += row_counts[y + reach, x]
            if y - 1 - reach >= 0:
                total -= row_sums[y - 1 - reach, x]
                count -= row_counts[y - 1 - reach, x]
            out_totals[y, x] = total
            out_counts[y, x] = count


@kernel
def sum_windows_kernel(
    phase: I32Array2,  # (H, W) 2^16 per cycle
    mask: U8Array2,  # (H, W)
    row_sums: I32Array2,  # (H, W)
    row_counts: I32Array2,  # (H, W)
    reach: i32,
    out_excess: I32Array2,  # (H, W) window sum less the pixel's own phase times the count
    out_counts: I32Array2,  # (H, W)
    out_cycles: I32Array2,  # (H, W) corrections: none yet
    out_active: U8Array2,  # (H, W) pixels whose window says that they change
    out_later: U8Array2,  # (H, W) cleared
    out_changed: I32Array1,
):
    """Sum all windows with nothing corrected, and find the pixels that they would change."""
    height, width = phase.shape[0], phase.shape[1]
    bands = (height + _BAND - 1) // _BAND
    ti.loop_config(serialize=True)
    for _ in range(1):
        out_changed[0] = 0
    for t in range(bands * strip_count(width, STRIP)):
        band, start, length = strip_at(t, width, STRIP)
        top, stop = band * _BAND, start + length
        sum_down(row_sums, row_counts, reach, top, start, stop, out_excess, out_counts)
        for y in range(top, ti.min(top + _BAND, height)):
            for x in range(start, stop):
                out_cycles[y, x] = 0
                out_later[y, x] = ti.cast(0, ti.u8)
                active = 0
                if mask[y, x] != 0:
                    excess = out_excess[y, x] - out_counts[y, x] * phase[y, x]
                    out_excess[y, x] = excess
                    active = ti.cast(rounded_cycles(excess, out_counts[y, x]) != 0, ti.i32)
                out_active[y, x] = ti.cast(active, ti.u8)
                if active == 1:
                    out_changed[0] = 1


@ti.func
def precedes(y: i32, x: i32, y2: i32, x2: i32, middle_y: i32, middle_x: i32) -> i32:
    """Return whether the filter reaches (y, x) before (y2, x2)."""
    earlier = 0
    if y != y2:
        # The middle row, the rows above it upwards, the rows below it downwards.
        rank = ti.select(y <= middle_y, middle_y - y, y)
        rank2 = ti.select(y2 <= middle_y, middle_y - y2, y2)
        earlier = ti.cast(rank < rank2, ti.i32)
    else:
        rank = ti.select(x <= middle_x, middle_x - x, x)
        rank2 = ti.select(x2 <= middle_x, middle_x - x2, x2)
        earlier = ti.cast(rank < rank2, ti.i32)
    return earlier


@ti.func
def cycles_before(cycles: I32Array2, reach: i32, y: i32, x: i32) -> i32:
    """Sum the corrections of the pixels in a window that the filter comes to before the middle one."""
    height, width = cycles.shape[0], cycles.shape[1]
    total = 0
    for y2 in range(ti.max(y - reach, 0), ti.min(y + reach + 1, height)):
        for x2 in range(ti.max(x - reach, 0), ti.min(x + reach + 1, width)):
            if cycles[y2, x2] != 0:
                if precedes(y2, x2, y, x, height // 2, width // 2):
                    total += cycles[y2, x2]
    return total


@ti.func
def look_again(mask: U8Array2, reach: i32, y: i32, x: i32, active: U8Array2, later: U8Array2, out_changed: I32Array1):
    """Mark the pixels that see a change: those of its row at once, others for later, which is noted."""
    height, width = mask.shape[0], mask.shape[1]
    for y2 in range(ti.max(y - reach, 0), ti.min(y + reach + 1, height)):
        for x2 in range(ti.max(x - reach, 0), ti.min(x + reach + 1, width)):
            if mask[y2, x2] != 0 and precedes(y, x, y2, x2, height // 2, width // 2):
                if y2 == y:
                    active[y2, x2] = ti.cast(1, ti.u8)
                else:
                    later[y2, x2] = ti.cast(1, ti.u8)
                    out_changed[0] = 1


@kernel
def correct_active_kernel(
    mask: U8Array2,  # (H, W)
    excess: I32Array2,  # (H, W) of the uncorrected windows
    counts: I32Array2,  # (H, W)
    reach: i32,
    cycles: I32Array2,  # (H, W) corrections; read and written
    active: U8Array2,  # (H, W) pixels to look at; cleared
    later: U8Array2,  # (H, W) pixels to look at next time
    out_changed: I32Array1,
):
    """Correct the pixels that may change; a thread takes a row, so that what it changes there counts at once."""
    height, width = mask.shape[0], mask.shape[1]
    ti.loop_config(serialize=True)
    for _ in range(1):
        out_changed[0] = 0
    for y in range(height):
        for step in range(width):
            x = ti.select(step <= width // 2, width // 2 - step, step)  # in the filter's own order
            if active[y, x] != 0:
                active[y, x] = ti.cast(0, ti.u8)
                total = cycles_before(cycles, reach, y, x)
                corrected = rounded_cycles(excess[y, x] + _CYCLE * total, counts[y, x])
                if corrected != cycles[y, x]:
                    cycles[y, x] = corrected
                    look_again(mask, reach, y, x, active, later, out_changed)


@kernel
def add_cycles_kernel(
    unwrapped: F32Array2,  # (H, W) rad
    cycles: I32Array2,  # (H, W)
    out: F32Array2,  # (H, W) rad
):
    """Add whole cycles to every pixel."""
    for pixel in range(unwrapped.shape[0] * unwrapped.shape[1]):
        y, x = pixel // unwrapped.shape[1], pixel % unwrapped.shape[1]
        out[y, x] = unwrapped[y, x] + 2.0 * PI * ti.cast(cycles[y, x], ti.f32)


def correct_fringe_order(
    unwrapped_phase: F32, mask: Mask, window_px: int = 11, stripes: str = "horizontal", *, out: F32 | None = None
) -> F32:
    """Pull pixels that are whole cycles away from their surroundings back, as the sequential filter does.

    Parameters
    ----------
    unwrapped_phase : (H, W) float32
        rad; anything outside the mask.
    mask : (H, W) bool or uint8
        Valid pixels; the mean runs over the valid pixels of the window.
    window_px : int
        Odd side of the square window, 3 to 31 px.
    stripes : {"horizontal", "vertical"}
        The filter runs along the stripes first: from the centre (row H // 2, column W // 2) to the left, then to the
        right, then row by row up, then down; for vertical stripes with rows and columns exchanged.
    out : (H, W) float32, optional
        Output array.

    Returns
    -------
    (H, W) float32
        rad; the input plus whole cycles, outside the mask the input.

    Raises
    ------
    ShapeError
        A shape or dtype is another one, the window is even or out of range, `stripes` is unknown, or `out` cannot be
        written.

    Notes
    -----
    phi2 = phi1 + 2 pi round((mean of phi over the window - phi1) / 2 pi), equation 4.3 of Je, Lee and Park 2004.

    The filter knows no steps: next to a real one of more than half a cycle it pulls pixels across. Use it on one
    surface.

    Examples
    --------
    >>> import numpy as np, tikernels
    >>> _ = tikernels.init("cpu")
    >>> phase = np.zeros((21, 21), np.float32)
    >>> phase[4, 7] += np.float32(2 * np.pi)
    >>> float(np.abs(correct_fringe_order(phase, phase < 99)).max())
    0.0
    """
    if stripes not in ("horizontal", "vertical"):
        raise ShapeError(f"stripes is {stripes!r}: choose horizontal or vertical")
    if window_px % 2 == 0 or not 3 <= window_px <= _MAX_WINDOW_PX:
        raise ShapeError(f"window_px is {window_px}: take an odd number from 3 to {_MAX_WINDOW_PX}")
    unwrapped_phase = checks.read_array("unwrapped_phase", unwrapped_phase, (None, None), np.float32)
    shape = (int(unwrapped_phase.shape[0]), int(unwrapped_phase.shape[1]))
    mask = checks.read_mask("mask", mask, shape)
    out = checks.out_array("out", out, shape, np.float32)
    unwrapped, result = unwrapped_phase, out
    if stripes == "vertical":
        unwrapped, mask, shape = transpose(unwrapped), transpose(mask), shape[::-1]
        result = runtime.empty(shape, np.float32)
    reach = window_px // 2
    phase, row_sums, row_counts, excess, counts, cycles = (runtime.empty(shape, np.int32) for _ in range(6))
    active, later = (runtime.empty(shape, np.uint8) for _ in range(2))
    changed = runtime.empty((1,), np.int32)
    sum_rows_kernel(unwrapped, mask, reach, phase, row_sums, row_counts)
    windows = (phase, mask, row_sums, row_counts, reach, excess, counts, cycles, active, later, changed)
    sum_windows_kernel(*windows)
    while runtime.to_host(changed)[0]:  # synchronises
        correct_active_kernel(mask, excess, counts, reach, cycles, active, later, changed)
        active, later = later, active
    add_cycles_kernel(unwrapped, cycles, result)
    if stripes == "vertical":
        transpose(result, out)
    return out
