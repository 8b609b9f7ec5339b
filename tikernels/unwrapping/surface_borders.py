"""Borders between patches: the number of pixels over which the surface continues, and over which it steps.

The phase is compared across four pixels with what the slopes on either side predict. Two surfaces that touch may agree
in places, where the step between them is a whole cycle; along most of their border they do not. Pixels at a border may
see both surfaces or two paints, and their phase is neither's. So the four pixels are laid across the border at each of
the four places where they reach over it, and the second least departure counts.
"""

from enum import IntEnum
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from tikernels import runtime
from tikernels._taichi import F32Array2, I32Array1, I32Array2, Static, f32, i32, ivec2, ivec4, ti, vec2, vec3, vec4
from tikernels.arrays import F32, I32
from tikernels.launching import kernel
from tikernels.phase.wrapped_phase import NO_PHASE, has_phase, whole_cycles, without_cycles
from tikernels.unwrapping.continuity import frame_rates
from tikernels.unwrapping.even_light import mean_change
from tikernels.unwrapping.table_columns import columns_at
from tikernels.unwrapping.tables import (
    ORDER_BITS,
    ORDER_MASK,
    Cell,
    Patch,
    cell_bounds,
    cell_count,
    cells_of,
    patch_number,
)

# The phase is compared with that this many pixels away; slopes are taken over this many. Steeper ones (rad per px,
# relative to the usual change) are no slopes, and count as none.
_REACH, _SLOPE_PX, _MAX_SLOPE = 4, 2, 0.6
# A surface goes on where the phase departs by less than the first, and steps where it departs by more than the second
# (rad); or by these many standard deviations of what departs around, along the stripes and across by its own, where
# noise, ripple or relief make that more.
_GOES_ON, _STEPS = 0.15, 0.25
_GOES_ON_SIGMAS, _STEPS_SIGMAS = 2.5, 4.0
_SIGMA_OF_MEDIAN = 1.4826
# Where that is more than this (rad), no departure distinguishes a step from noise.
_MOST = 2.0
# Around a cell are those up to this many further: a bumpy surface departs by more than the wall behind it.
_AROUND = 2
# Pairs of patches that a cell may note; what it has no place for does not count.
_PLACES = 24

Integers = npt.NDArray[np.int64]


class _Note(IntEnum):
    """Rows of what cells note of the pairs of patches that border on each other."""

    LOW = 0  # the patches,
    HIGH = 1
    SHIFT = 2  # the shift from the first to the second,
    GOES_ON = 3  # and the bits of the numbers of pixels over which the surface goes on,
    STEPS = 4  # and over which it steps, as float32


class Borders(NamedTuple):
    """Pairs of patches with a common border; a pair may be there several times."""

    ends: Integers
    """(2, N) the patches, the smaller number first."""
    shift: Integers
    """(N,) whole cycles by which the zeros of their orders differ where the surface goes on; see `Contact.SHIFT`."""
    going_on: npt.NDArray[np.float64]
    """(N,) pixels over which the surface goes on; a dim one counts less."""
    stepping: npt.NDArray[np.float64]
    """(N,) pixels over which it steps."""


class CellSamples(NamedTuple):
    """Samples of the phase in each cell, before borders are measured."""

    departures: npt.NDArray[np.float32]
    """(2, cells) rad, how far the phase departs at one place, along and across the stripes; NO_PHASE if unknown."""
    changes: npt.NDArray[np.float32]
    """(cells,) the `mean_change` across the stripes, as a share of the usual one."""


@ti.func
def slope_beyond(difference: f32, rate: f32) -> f32:
    """Return a slope, rad per px, beyond the usual change; 0 where it is too steep to be one."""
    slope = without_cycles(difference - _SLOPE_PX * rate) / _SLOPE_PX
    return ti.select(ti.abs(slope) > _MAX_SLOPE, 0.0, slope)


@ti.func
def departure(phase: F32Array2, y: i32, x: i32, down: i32, rate: f32) -> vec2:
    """Return how far (rad) the phase departs from what the slopes before and after predict; NO_PHASE if unknown.

    Then the whole cycles that were taken off.
    """
    dy, dx = down, 1 - down
    result = vec2(NO_PHASE, 0.0)
    far = _REACH + _SLOPE_PX
    if y >= _SLOPE_PX * dy and x >= _SLOPE_PX * dx and y + far * dy < phase.shape[0] and x + far * dx < phase.shape[1]:
        one, two = phase[y - _SLOPE_PX * dy, x - _SLOPE_PX * dx], phase[y, x]
        three, four = phase[y + _REACH * dy, x + _REACH * dx], phase[y + far * dy, x + far * dx]
        if has_phase(one) and has_phase(two) and has_phase(three) and has_phase(four):
            slope = rate + 0.5 * (slope_beyond(two - one, rate) + slope_beyond(four - three, rate))
            departs = three - two - _REACH * slope
            result = vec2(ti.abs(without_cycles(departs)), whole_cycles(departs))
    return result


@kernel
def sample_cells_kernel(
    phase: F32Array2,  # (H, W) rad
    rates: F32Array2,  # see `frame_rates`
    labels: I32Array2,  # (H, W) negative: no patch's
    out_samples: F32Array2,  # (3, cells) see `CellSamples`: departures along and across, changes
):
    """Measure at one place of each cell by how much the phase departs, and over the cell how it changes."""
    height, width = phase.shape[0], phase.shape[1]
    for cell in range(cell_count(height, width)):
        along, across, _ = frame_rates(rates)
        top, left, bottom, right = cell_bounds(cell, height, width)
        y, x = (top + bottom) // 2, (left + right) // 2
        for down in range(2):
            out_samples[down, cell] = departure(phase, y, x, down, ti.select(down == 1, across, along))[0]
        out_samples[2, cell] = mean_change(phase, labels, ivec4(top, left, bottom, right), across)


@ti.func
def note_border(ends: ivec2, shift: i32, px: f32, steps: i32, cell: i32, count: Static, out_notes: I32Array2):
    """Add pixels to those of a pair of patches in a cell's notes."""
    low, high = ti.min(ends[0], ends[1]), ti.max(ends[0], ends[1])
    upwards = ti.select(ends[0] == low, shift, -shift)
    place, noted = count, ti.min(count, _PLACES)
    cells = out_notes.shape[1] // _PLACES
    for k in range(noted):
        at = k * cells + cell
        if out_notes[_Note.LOW, at] == low and out_notes[_Note.HIGH, at] == high:
            if out_notes[_Note.SHIFT, at] == upwards:
                place = k
    if place < _PLACES:
        at = place * cells + cell
        if place == count:
            out_notes[_Note.LOW, at], out_notes[_Note.HIGH, at], out_notes[_Note.SHIFT, at] = low, high, upwards
            out_notes[_Note.GOES_ON, at], out_notes[_Note.STEPS, at] = 0, 0
            count += 1
        seen = ti.bit_cast(out_notes[_Note.GOES_ON + steps, at], ti.f32) + px
        out_notes[_Note.GOES_ON + steps, at] = ti.bit_cast(seen, ti.i32)


@ti.func
def border_at(
    phase: F32Array2, quality: F32Array2, usual: vec3, limits: vec4, labels: I32Array2, down: Static, y: i32, x: i32
):
    """Return the labels on both sides of a border that begins after a pixel, its pixels, and whether it steps.

    Negative labels: there is none, or it shows nothing. Then the whole cycles to add there to count from here.
    """
    dy, dx = ti.static((down, 1 - down))
    here, there, px, shift = -1, -1, 0.0, 0
    least, second = NO_PHASE, NO_PHASE
    last, first = labels[y, x], labels[y + dy, x + dx]
    if last >= 0 and (last >> ORDER_BITS) != (first >> ORDER_BITS):
        for before in range(_REACH):
            if second < limits[2 * down]:  # it goes on, whatever the other places show
                break
            y1, x1 = y - before * dy, x - before * dx
            y2, x2 = y1 + _REACH * dy, x1 + _REACH * dx
            if y1 >= 0 and x1 >= 0 and y2 < phase.shape[0] and x2 < phase.shape[1]:
                one, two = labels[y1, x1], labels[y2, x2]
                if one >= 0 and two >= 0 and (one >> ORDER_BITS) != (two >> ORDER_BITS):
                    departs = departure(phase, y1, x1, down, usual[down])
                    second = ti.min(second, ti.max(least, departs[0]))
                    if departs[0] < least:
                        least = departs[0]
                        px = ti.min(4.0 * ti.min(quality[y1, x1], quality[y2, x2]) / usual[2], 1.0)
                        here, there = one, two
                        shift = (one & ORDER_MASK) - (two & ORDER_MASK) - ti.cast(departs[1], i32)
    steps = ti.cast(second > limits[2 * down + 1], i32)
    if not has_phase(second) or (second >= limits[2 * down] and steps == 0):
        here, there = -1, -1
    return here, there, px, steps, shift


@kernel
def measure_borders_kernel(
    phase: F32Array2,  # (H, W) rad
    quality: F32Array2,  # (H, W)
    rates: F32Array2,  # see `frame_rates`
    labels: I32Array2,  # (H, W) patch and order in it
    cells: I32Array2,  # (3, cells + 1) see `Cell`; numbered
    draft_bits: i32,
    patches: I32Array2,  # (11, capacity) see `Patch`
    limits: F32Array2,  # (4, cells) rad: up to which a surface goes on and from which it steps, along and across
    out_notes: I32Array2,  # (5, _PLACES cells), by place: see `_Note`
    out_counts: I32Array1,  # (cells,) how many pairs
):
    """Look at the pixels after which another patch begins, to the right and below."""
    height, width = phase.shape[0], phase.shape[1]
    for cell in range(cell_count(height, width)):
        along, across, mean_quality = frame_rates(rates)
        usual = vec3(along, across, mean_quality)
        top, left, bottom, right = cell_bounds(cell, height, width)
        bounds, count = ivec4(top, left, bottom, right), 0
        own = vec4(limits[0, cell], limits[1, cell], limits[2, cell], limits[3, cell])
        # In a cell that a single patch fills another one begins only after the last column and row.
        filled = patches[Patch.PIXELS, cells[Cell.PATCHES, cell]] == (bottom - top) * (right - left)
        for down in ti.static(range(2)):
            start = ivec2(top, left)
            if filled:
                start[1 - down] = bounds[3 - down] - 1
            stop = ivec2(height - down, width - (1 - down))
            for y in range(start[0], ti.min(bounds[2], stop[0])):
                for x in range(start[1], ti.min(bounds[3], stop[1])):
                    here, there, px, steps, shift = border_at(phase, quality, usual, own, labels, down, y, x)
                    if here >= 0:
                        one = patch_number(here >> ORDER_BITS, cells, draft_bits)
                        ends = ivec2(one, patch_number(there >> ORDER_BITS, cells, draft_bits))
                        note_border(ends, shift, px, steps, cell, count, out_notes)
        out_counts[cell] = count


def _limits(departures: npt.NDArray[np.float32], rows: int, columns: int) -> npt.NDArray[np.float32]:
    """Return (4, cells) rad, up to which a surface goes on and from which it steps, along and across the stripes.

    Parameters
    ----------
    departures : (2, cells)
        By how much the phase departs at a place of each cell, along and across; NO_PHASE if unknown.
    """
    size = 2 * _AROUND + 1
    # One picture above the other, and a frame around each.
    framed = np.full((2, rows + 2 * _AROUND, columns + 2 * _AROUND), NO_PHASE, np.float32)
    framed[:, _AROUND:-_AROUND, _AROUND:-_AROUND] = departures.reshape(2, rows, columns)
    pictures = framed.reshape(-1, framed.shape[2])
    median = cv2.medianBlur(pictures, size)
    # Where some of those around are missing, because they are unknown or outside, the median is of the others.
    missing = cv2.dilate((pictures >= NO_PHASE).astype(np.uint8), np.ones((size, size), np.uint8)) != 0
    inside = np.zeros(framed.shape, bool)
    inside[:, _AROUND:-_AROUND, _AROUND:-_AROUND] = True
    some = np.flatnonzero(missing.ravel() & inside.ravel())
    offsets = np.arange(-_AROUND, _AROUND + 1)
    near = (offsets[:, None] * pictures.shape[1] + offsets).ravel()
    around = np.sort(pictures.ravel()[some[:, None] + near], axis=1)
    found = np.count_nonzero(around < NO_PHASE, axis=1)
    lower = around[np.arange(len(some)), np.maximum(found - 1, 0) // 2]
    median.ravel()[some] = np.where(found > 0, lower, 0)
    sigma = _SIGMA_OF_MEDIAN * median.reshape(framed.shape)[:, _AROUND:-_AROUND, _AROUND:-_AROUND].reshape(2, -1)
    steps = np.maximum(_STEPS, _STEPS_SIGMAS * sigma)
    steps[steps > _MOST] = NO_PHASE
    goes_on = np.maximum(_GOES_ON, _GOES_ON_SIGMAS * sigma)
    return np.stack([goes_on, steps], axis=1).reshape(4, -1).astype(np.float32)


def sample_cells(phase: F32, rates: F32, labels: I32) -> CellSamples:
    """Measure how far the phase departs in each cell, and by how much it changes.

    Parameters
    ----------
    phase : (H, W) float32
        rad in [-pi, pi]; NO_PHASE outside the mask.
    rates : (N, 5) float32
        Results of `measure_rates`.
    labels : (H, W) int32
        Patch and order in it.
    """
    rows, columns = cells_of(int(phase.shape[0]), int(phase.shape[1]))
    samples = runtime.empty((3, rows * columns), np.float32)
    sample_cells_kernel(phase, rates, labels, samples)
    along, across, changes = runtime.to_host(samples)  # synchronises
    return CellSamples(np.stack([along, across]), changes)


def measure_borders(
    phase: F32,
    quality: F32,
    rates: F32,
    labels: I32,
    cells: I32,
    draft_bits: int,
    patches: I32,
    departures: npt.NDArray[np.float32],
) -> Borders:
    """Measure over how many pixels the surface continues from each patch to the next, and over how many it steps.

    Parameters
    ----------
    phase : (H, W) float32
        rad in [-pi, pi]; NO_PHASE outside the mask.
    quality : (H, W) float32
        Larger is better; the modulation.
    rates : (N, 5) float32
        Results of `measure_rates`.
    labels : (H, W) int32
        Patch and order in it.
    cells : (3, cells + 1) int32
        See `Cell`; numbered.
    draft_bits : int
        A cell has places for 2^bits patches.
    patches : (11, capacity) int32
        See `Patch`.
    departures : (2, cells) float32
        See `CellSamples`.
    """
    rows, columns = cells_of(int(phase.shape[0]), int(phase.shape[1]))
    count = rows * columns
    limits = _limits(departures, rows, columns)
    notes, counts = runtime.empty((len(_Note), _PLACES * count), np.int32), runtime.empty((count,), np.int32)
    measure_borders_kernel(phase, quality, rates, labels, cells, draft_bits, patches, limits, notes, counts)
    number = runtime.to_host(counts)  # synchronises
    place = np.arange(number.sum()) - np.repeat(np.cumsum(number) - number, number)
    used = columns_at(notes, place * count + np.repeat(np.arange(count), number))  # synchronises
    px = used[_Note.GOES_ON :].view(np.float32).astype(np.float64)
    return Borders(used[: _Note.SHIFT].astype(np.int64), used[_Note.SHIFT].astype(np.int64), *px)
