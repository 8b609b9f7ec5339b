"""Let surfaces grow at their rims into pixels that were measured, but which unwrapping gave to none.

Where a surface turns away its phase changes by much from pixel to pixel, and a cell that may hide a step of whole
cycles is left out as a whole; yet most of these pixels are lit, seen, and fitted well. Such a pixel belongs to the
surface next to it where it goes on as that one does. With p its phase, u_1 and u_2 those of the two pixels before it on
a side, g the usual change there (`phase_change.py`), and b the brightness without the fringe,

    |p + 2 pi k - (2 u_1 - u_2)| < 0.5 t + 2.5 sqrt(var(p) + 0.54 var(p_1)),    t = |u_1 - u_2 - g|,
    -max(0.2, 0.06 + 0.6 t) < log(b / b_1) < 0.06 + 0.6 t,

because what turns away may turn away further, and gets darker, and what does not does neither, but that a last pixel
sees some of the darkness beyond; smoothing along the stripes leaves 0.27 of the variance of a single pixel's p_1. Where
noise would let 0.8 rad pass, which is a step (`smoothing.py`), nothing is decided, and neither where one of the next
three pixels, fitted as well, departs from p + u_1 - u_2 by 1.5 rad: there another surface begins. The side that fits
best of four determines the order k. At least two of the eight neighbours must be of that surface and none of another: a
pixel that sees two surfaces at once belongs to neither. Rims grow by one pixel per pass.

What lies beyond a rim may shine into its pixels by blur. To their variance that adds

    (0.1 b_max / b)^2,

with b_max the brightest of the eight pixels around that belongs to no surface (`doubt_rims`).
"""

import numpy as np

from tikernels import checks, runtime
from tikernels._taichi import F32Array2, I32Array1, I32Array2, Static, U8Array2, f32, i32, ti, u1, vec2
from tikernels.arrays import F32, I32, U8
from tikernels.launching import kernel
from tikernels.phase.phase_fit import MAX_MISFIT
from tikernels.phase.phase_vector import PI
from tikernels.phase.smoothing import MAX_DEPARTURE
from tikernels.phase.wrapped_phase import has_phase
from tikernels.unwrapping.continuity import frame_rates
from tikernels.unwrapping.rim_pixels import lies_at_rim
from tikernels.unwrapping.tables import cell_bounds, cell_count, cells_of, step_to

# By how many pixels rims grow: half a cell that was left out, from both its sides.
_TURNS = 6
# What smoothing along the stripes leaves of a pixel's variance.
_SMOOTHED = 0.27
# How much of what a surface turns by it may turn further, and how many standard deviations are noise.
_BEND, _SURE = 0.5, 2.5
# How much a brightness's logarithm may change, by how much more for a radian that the surface turns by, and how much it
# may fall where darkness lies beyond.
_ALIKE, _DARKENS, _DIMMER = 0.06, 0.6, 0.2
# Neighbours whose phases differ by more (rad) see two surfaces.
_STEP = 1.5
# Of the eight pixels around one, those that must be of its surface at least.
_LEAST_COUNT = 2
# A pixel at the new rim may see this share of the light beyond it, by blur.
_LEAK = 0.1
# Precisions and brightnesses below count as this: where there is a phase both are far above.
_LEAST = 1e-6


@ti.func
def steps_beyond(phase: F32Array2, misfit: F32Array2, y: i32, x: i32, side: i32, expected: f32, usual: vec2) -> f32:
    """Return by how much (rad) three pixels beyond a rim depart from what is expected of the middle one, at (y, x)."""
    dy, dx = step_to(side)
    most = 0.0
    for k in ti.static(range(-1, 2)):
        j, i = y + k * dx, x + k * dy
        if j >= 0 and j < phase.shape[0] and i >= 0 and i < phase.shape[1]:
            if has_phase(phase[j, i]) and misfit[j, i] < MAX_MISFIT:
                departs = phase[j, i] - expected - k * (dx * usual[1] + dy * usual[0])
                most = ti.max(most, ti.abs(departs - 2.0 * PI * ti.round(departs * (0.5 / PI))))
    return most


@ti.func
def goes_on(
    phase: F32Array2,
    precision: F32Array2,
    misfit: F32Array2,
    brightness: F32Array2,
    rates: F32Array2,
    unwrapped: F32Array2,
    region: I32Array2,
    y: i32,
    x: i32,
) -> vec2:
    """Return a pixel's unwrapped phase in the surface that it continues best, and that region's number, 0 if none."""
    height, width = region.shape[0], region.shape[1]
    along, across, _ = frame_rates(rates)
    usual, result, best = vec2(along, across), vec2(0.0), 1.0
    for side in range(4):
        dy, dx = step_to(side)
        y1, x1, y2, x2 = y + dy, x + dx, y + 2 * dy, x + 2 * dx
        if y2 >= 0 and y2 < height and x2 >= 0 and x2 < width:
            if region[y1, x1] > 0 and region[y2, x2] == region[y1, x1]:
                slope = unwrapped[y1, x1] - unwrapped[y2, x2]
                turn = ti.abs(slope + dy * across + dx * along)
                expected = unwrapped[y1, x1] + slope
                value = phase[y, x] + 2.0 * PI * ti.round((expected - phase[y, x]) * (0.5 / PI))
                smoothed = _SMOOTHED / ti.max(precision[y1, x1], _LEAST)
                noise = ti.sqrt(1.0 / ti.max(precision[y, x], _LEAST) + 2.0 * smoothed)
                most = _BEND * turn + _SURE * noise
                share = ti.abs(value - expected) / most
                ratio = ti.max(brightness[y, x], _LEAST) / ti.max(brightness[y1, x1], _LEAST)
                brighter, most_brighter = ti.log(ratio), _ALIKE + _DARKENS * turn
                alike = brighter < most_brighter and brighter > -ti.max(most_brighter, _DIMMER)
                steep = ti.max(ti.abs(slope), steps_beyond(phase, misfit, y - dy, x - dx, side, value + slope, usual))
                if alike and share < best and steep < _STEP and most < MAX_DEPARTURE:
                    best = share
                    result = vec2(value, ti.cast(region[y1, x1], f32))
    return result


@ti.func
def brightest_beyond(brightness: F32Array2, region: I32Array2, y: i32, x: i32) -> f32:
    """Return the brightness of the brightest pixel around one that is on no surface; 0: there is none."""
    brightest = 0.0
    for place in range(9):
        j, i = y + place // 3 - 1, x + place % 3 - 1
        if j >= 0 and j < region.shape[0] and i >= 0 and i < region.shape[1]:
            brightest = ti.max(brightest, ti.select(region[j, i] == 0, brightness[j, i], 0.0))
    return brightest


@ti.func
def lies_among_its_own(unwrapped: F32Array2, region: I32Array2, y: i32, x: i32, value: f32, number: i32) -> u1:
    """Return whether a pixel of this phase and region has neighbours on its surface, and none on another."""
    own, others = 0, 0
    for place in range(9):
        j, i = y + place // 3 - 1, x + place % 3 - 1
        if j >= 0 and j < region.shape[0] and i >= 0 and i < region.shape[1]:
            if region[j, i] > 0:
                same = region[j, i] == number and ti.abs(unwrapped[j, i] - value) <= _STEP
                own += ti.cast(same, i32)
                others += ti.cast(not same, i32)
    return own >= _LEAST_COUNT and others == 0


@ti.func
def mark_growth(
    phase: F32Array2,
    precision: F32Array2,
    misfit: F32Array2,
    brightness: F32Array2,
    rates: F32Array2,
    unwrapped: F32Array2,
    region: I32Array2,
    cell: i32,
) -> i32:
    """Mark what goes on from a surface in a cell by minus its number; return how many pixels belonged to none."""
    left_over = 0
    top, left, bottom, right = cell_bounds(cell, region.shape[0], region.shape[1])
    for y in range(top, bottom):
        for x in range(left, right):
            if region[y, x] == 0 and has_phase(phase[y, x]) and misfit[y, x] < MAX_MISFIT:
                left_over += 1
                found = goes_on(phase, precision, misfit, brightness, rates, unwrapped, region, y, x)
                number = ti.cast(found.y, i32)
                if number > 0 and lies_among_its_own(unwrapped, region, y, x, found.x, number):
                    unwrapped[y, x] = found.x
                    region[y, x] = -number
    return left_over


@ti.func
def add_growth(mask: U8Array2, region: I32Array2, cell: i32):
    """Add to their surface the pixels of a cell that are marked."""
    top, left, bottom, right = cell_bounds(cell, region.shape[0], region.shape[1])
    for y in range(top, bottom):
        for x in range(left, right):
            # The mask is read as well, because a GPU gets only what a kernel reads.
            if region[y, x] < 0 and mask[y, x] == 0:
                region[y, x] = -region[y, x]
                mask[y, x] = ti.cast(1, ti.u8)


@kernel
def grow_rims_kernel(
    phase: F32Array2,  # (H, W) rad; NO_PHASE where there is none
    precision: F32Array2,  # (H, W) 1 / rad^2
    misfit: F32Array2,  # (H, W)
    brightness: F32Array2,  # (H, W) levels
    rates: F32Array2,  # see `frame_rates`
    unwrapped: F32Array2,  # (H, W) rad
    mask: U8Array2,  # (H, W)
    region: I32Array2,  # (H, W) from 1; 0: none; less during a pass: of a pixel that is to be added
    open_cells: I32Array1,  # (cells,) scratch: how many pixels belonged to no surface
    first: i32,  # turns that have been taken
    turns: Static,  # to take
):
    """Note in each turn what is to be added, and only then add it: no pixel depends on who is looked at first."""
    for turn in ti.static(range(turns)):
        for cell in range(open_cells.shape[0]):
            if first + turn == 0 or open_cells[cell] != 0:
                open_cells[cell] = mark_growth(phase, precision, misfit, brightness, rates, unwrapped, region, cell)
        for cell in range(open_cells.shape[0]):
            if open_cells[cell] != 0:
                add_growth(mask, region, cell)


def grow_rims(phase: F32, precision: F32, misfit: F32, brightness: F32, rates: F32, out: tuple[F32, U8, I32]) -> None:
    """Add pixels next to surfaces' rims that continue them.

    Parameters
    ----------
    phase : (H, W) float32
        Of each pixel by itself, rad; NO_PHASE where there is none.
    precision : (H, W) float32
        One over its variance, 1 / rad^2.
    misfit : (H, W) float32
        The square of what its fit leaves over, over that one's variance.
    brightness : (H, W) float32
        Of the surface, without the fringe; up to a factor.
    rates : (N, 5) float32
        Results of `measure_rates`.
    out : three (H, W)
        Unwrapped phase, rad, float32, of pixels that are smoothed along the stripes; mask, uint8; and the surface of
        each pixel, int32, 0 off the mask. Pixels are added to them, each with its own phase; the others stay as they
        are.

    Raises
    ------
    ShapeError
        A shape or dtype is another one, or an output cannot be written.
    """
    phase = checks.read_array("phase", phase, (None, None), np.float32)
    shape = (int(phase.shape[0]), int(phase.shape[1]))
    precision = checks.read_array("precision", precision, shape, np.float32)
    misfit = checks.read_array("misfit", misfit, shape, np.float32)
    brightness = checks.read_array("brightness", brightness, shape, np.float32)
    rates = checks.read_array("rates", rates, (None, 5), np.float32)
    unwrapped = checks.out_buffer("unwrapped", out[0], shape, np.float32)
    mask = checks.out_buffer("mask", out[1], shape, np.uint8)
    region = checks.out_buffer("region", out[2], shape, np.int32)
    rows, columns = cells_of(*shape)
    open_cells = runtime.empty((rows * columns,), np.int32)
    seen, surfaces = (phase, precision, misfit, brightness, rates), (unwrapped, mask, region)
    # A GPU gets all turns in one call. For the CPU they would be unrolled, and compiled six times.
    turns = 1 if runtime.started() == "cpu" else _TURNS
    for first in range(0, _TURNS, turns):
        grow_rims_kernel(*seen, *surfaces, open_cells, first, turns)


@kernel
def doubt_rims_kernel(
    brightness: F32Array2,  # (H, W) levels
    region: I32Array2,  # (H, W) from 1; 0: none
    variance: F32Array2,  # (H, W) rad^2
):
    for cell in range(cell_count(region.shape[0], region.shape[1])):
        top, left, bottom, right = cell_bounds(cell, region.shape[0], region.shape[1])
        if lies_at_rim(region, top, left, bottom, right):
            for y in range(top, bottom):
                for x in range(left, right):
                    if region[y, x] > 0:
                        leak = _LEAK * brightest_beyond(brightness, region, y, x) / ti.max(brightness[y, x], _LEAST)
                        variance[y, x] += leak * leak


def doubt_rims(brightness: F32, region: I32, out: F32) -> None:
    """Add to the variances of pixels at rims what the light beyond makes.

    Parameters
    ----------
    brightness : (H, W) float32
        Of the surface, without the fringe; up to a factor.
    region : (H, W) int32
        The surface of each pixel, 0 off the mask.
    out : (H, W) float32
        rad^2; changed.

    Raises
    ------
    ShapeError
        A shape or dtype is another one, or the output cannot be written.
    """
    brightness = checks.read_array("brightness", brightness, (None, None), np.float32)
    shape = (int(brightness.shape[0]), int(brightness.shape[1]))
    region = checks.read_array("region", region, shape, np.int32)
    variance = checks.out_buffer("variance", out, shape, np.float32)
    doubt_rims_kernel(brightness, region, variance)
