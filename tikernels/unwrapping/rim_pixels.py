"""Leave out the pixels at a surface's rim that belong to the surface next to it, or see both.

Where two surfaces touch at a step of whole cycles the phase does not show which surface a pixel belongs to: a corner of
a shoulder may continue the wall behind it, 90 mm further away. Its brightness does. Seen from the corner, the wall lies
beyond an edge of brightness, or nothing of it is seen at all. So from every pixel near the light of another surface
eight rays go out over its own surface. What meets an edge of brightness, or the surface's end, on all of them is cut
off, and left out:

    |log(b(k) / b(k - 4))| > log(1.4)   k px along a ray, 4 to 24, b the brightness there.

Print and shading have such edges, too: they cost the pixels that lie behind them, within 12 px of another surface.
The last pixel of every surface is left out as well, whichever of eight directions it ends in: blur and its own area mix
the light of what lies beyond into it, and where that is in shadow nothing shows it. `rim_growing.py` takes back those
that go on as their surface does.

On coded frames of six drawn rigs (`scorecard.py --rigs`) 43 of 100,000 pixels of faces, 37 of hands, 121 of objects and
92 of parcels are whole cycles off with these last pixels, and 1, 2, 17 and 19 without (medians); they are 0.2 to 0.7 %.
"""

import numpy as np

from tikernels import checks, runtime
from tikernels._taichi import F32Array2, I32Array1, I32Array2, U8Array2, f32, i32, ti, u1
from tikernels.arrays import F32, I32, U8
from tikernels.launching import kernel
from tikernels.phase.wrapped_phase import has_phase
from tikernels.unwrapping.tables import CELL_WIDTH, cell_bounds, cells_of

# How far rays go; within how many px they must reach another surface's light, how far beyond the own one's end that is
# looked for, and within how many px the own one must not go on: a print's edge may be so wide.
_FAR, _NEAR, _GAP, _PRINT = 24, 12, 3, 4
# An edge of brightness: by this ratio from two px before to two px after. Another surface's light: this part of the
# pixel's modulation.
_EDGE, _LIGHT = 1.4, 0.5
# What a ray may meet: nothing, its surface's end, that and another surface's light behind it, an edge of brightness.
_NOTHING, _END, _OTHER, _BRIGHTNESS = range(4)
# A surface that goes on within this many pixels has a hole there, as between two paints, and no end.
_HOLE = 3
# Rows and columns of looks around a cell, ten pixels apart.
_LOOKS = 5, 4
# Brightness and surface of a row of a cell, whose pixels are looked at together: see `strips.py`.
_row_of_light = ti.types.vector(CELL_WIDTH, ti.f32)
_row_of_regions = ti.types.vector(CELL_WIDTH, ti.i32)


@ti.func
def room_along(place: i32, step: i32, length: i32) -> i32:
    """Return how many pixels the image goes on from a place, by this step."""
    return ti.select(step > 0, length - 1 - place, ti.select(step < 0, place, length))


@ti.func
def other_light(
    phase: F32Array2, modulation: F32Array2, region: I32Array2, y: i32, x: i32, dy: i32, dx: i32, own: i32, least: f32
) -> u1:
    """Return whether a ray that leaves its surface meets another one's light, not its own surface again behind it."""
    found, goes_on = False, False
    room = ti.min(room_along(y, dy, region.shape[0]), room_along(x, dx, region.shape[1]))
    for gap in range(ti.min(room, _PRINT) + 1):
        y2, x2 = y + gap * dy, x + gap * dx
        others = region[y2, x2] != own
        found |= others & (gap <= _GAP) & has_phase(phase[y2, x2]) & (modulation[y2, x2] > least)
        goes_on |= (gap > 0) & ~others
    return found & ~goes_on


@ti.func
def follow_ray(
    brightness: F32Array2,
    modulation: F32Array2,
    phase: F32Array2,
    region: I32Array2,
    y: i32,
    x: i32,
    dy: i32,
    dx: i32,
) -> i32:
    """Return what a ray meets first: `_NOTHING`, `_END`, `_OTHER` or `_BRIGHTNESS`."""
    own, far, meets = region[y, x], 2, _NOTHING
    before, here = brightness[y, x], brightness[y, x]
    room = ti.min(room_along(y, dy, region.shape[0]), room_along(x, dx, region.shape[1]))
    while far <= ti.min(room, _FAR) and meets == _NOTHING:
        y2, x2 = y + far * dy, x + far * dx
        if region[y2, x2] != own:
            meets = _END
            if far <= _NEAR:
                # It ended here, or a pixel earlier.
                least = _LIGHT * modulation[y, x]
                if other_light(phase, modulation, region, y2 - dy, x2 - dx, dy, dx, own, least):
                    meets = _OTHER
        else:
            after = brightness[y2, x2]
            # Across four pixels; an edge within the first two is the own one of the pixel that the ray comes from.
            if far > 2 and ti.max(before, after) > _EDGE * ti.min(before, after):
                meets = _BRIGHTNESS
            before, here = here, after
        far += 2
    if meets == _NOTHING and room < _FAR:
        meets = _END
    return meets


@ti.func
def place_of_ray(ray: i32):
    """Return by how many rows and columns each step of one of the eight rays goes on."""
    place = ray + ti.cast(ray > 3, i32)  # of the nine, without the middle one
    return place // 3 - 1, place % 3 - 1


@ti.func
def rays_go_on(brightness: F32Array2, region: I32Array2, y: i32, left: i32, dy: i32, dx: i32):
    """Return which pixels of a cell's row have a ray that meets nothing, as `follow_ray` says; none at the image's end.

    They are looked at together, which takes a fifth of the time.
    """
    goes_on = _row_of_regions(0)
    y2, first, last = y + _FAR * dy, left + _FAR * dx, left + _FAR * dx + CELL_WIDTH
    if ti.min(y2, first) >= 0 and y2 < region.shape[0] and ti.max(last, left + CELL_WIDTH) <= region.shape[1]:
        own, before, here = _row_of_regions(0), _row_of_light(0.0), _row_of_light(0.0)
        for k in range(CELL_WIDTH):
            own[k], before[k] = region[y, left + k], brightness[y, left + k]
            here[k] = brightness[y + 2 * dy, left + k + 2 * dx]
            goes_on[k] = ti.cast(region[y + 2 * dy, left + k + 2 * dx] == own[k], i32)
        far, left_over = 4, 1
        while far <= _FAR and left_over > 0:
            left_over = 0
            for k in range(CELL_WIDTH):
                after = brightness[y + far * dy, left + k + far * dx]
                edge = ti.max(before[k], after) > _EDGE * ti.min(before[k], after)
                stays = (region[y + far * dy, left + k + far * dx] == own[k]) & ~edge
                goes_on[k] = goes_on[k] & ti.cast(stays, i32)
                before[k], here[k] = here[k], after
                left_over += goes_on[k]
            far += 2
    return goes_on


@ti.func
def stopped_pixels(brightness: F32Array2, region: I32Array2, y: i32, left: i32, right: i32, first: i32):
    """Return which pixels of a cell's row have no ray that `rays_go_on` reports, and the ray that was checked last.

    The next row begins with that one.
    """
    stopped, tried, ray = _row_of_regions(0), 0, first
    for x in range(left, right):
        stopped[x - left] = ti.cast(region[y, x] > 0, i32)
    while tried < 8 and stopped.sum() > 0:
        ray = (first + tried) % 8
        dy, dx = place_of_ray(ray)
        stopped &= 1 - rays_go_on(brightness, region, y, left, dy, dx)
        tried += 1
    return stopped, ray


@ti.func
def is_cut_off(brightness: F32Array2, modulation: F32Array2, phase: F32Array2, region: I32Array2, y: i32, x: i32) -> u1:
    """Return whether all rays from a pixel are stopped, some by an edge and some by another's light."""
    tried, goes_on, edges, others = 0, False, False, False
    while tried < 8 and not goes_on:
        dy, dx = place_of_ray(tried)
        meets = follow_ray(brightness, modulation, phase, region, y, x, dy, dx)
        edges |= meets == _BRIGHTNESS
        others |= meets == _OTHER
        goes_on = meets == _NOTHING
        tried += 1
    return not goes_on and edges and others


@ti.func
def lies_at_rim(region: I32Array2, top: i32, left: i32, bottom: i32, right: i32) -> u1:
    """Return whether a surface, or the image, ends in a cell or next to it."""
    ends = top == 0 or left == 0 or bottom == region.shape[0] or right == region.shape[1]
    if not ends:
        differs = 0
        for y in range(top - 1, bottom + 1):
            for k in range(-1, CELL_WIDTH + 1):
                differs |= region[y, left + k] ^ region[top, left]
        ends = differs != 0
    return ends


@ti.func
def lies_beside_others(phase: F32Array2, region: I32Array2, top: i32, left: i32, bottom: i32, right: i32) -> u1:
    """Return whether two surfaces' light is seen around a cell, in every tenth pixel: at most cells it is not."""
    lowest, highest = 1 << 30, -1
    for look in range(_LOOKS[0] * _LOOKS[1]):
        row, column = look // _LOOKS[1], look % _LOOKS[1]
        y = top - _NEAR + row * (bottom - top + 2 * _NEAR) // (_LOOKS[0] - 1)
        x = left - _NEAR + column * (right - left + 2 * _NEAR) // (_LOOKS[1] - 1)
        y, x = ti.min(ti.max(y, 0), region.shape[0] - 1), ti.min(ti.max(x, 0), region.shape[1] - 1)
        if has_phase(phase[y, x]):
            lowest, highest = ti.min(lowest, region[y, x]), ti.max(highest, region[y, x])
    return highest > lowest


@ti.func
def take_off(region: I32Array2, unwrapped: F32Array2, mask: U8Array2, cell: i32):
    """Take the pixels of a cell that were marked on the mask out of their surfaces."""
    top, left, bottom, right = cell_bounds(cell, region.shape[0], region.shape[1])
    for y in range(top, bottom):
        for x in range(left, right):
            if mask[y, x] == 0 and region[y, x] > 0:
                region[y, x] = 0
                unwrapped[y, x] += ti.math.nan


@ti.func
def mark_strangers(
    brightness: F32Array2, modulation: F32Array2, phase: F32Array2, region: I32Array2, mask: U8Array2, cell: i32
) -> i32:
    """Mark a cell's pixels that are cut off from their surface on the mask, and return whether there are any."""
    marks, ray = 0, 0
    top, left, bottom, right = cell_bounds(cell, region.shape[0], region.shape[1])
    if lies_beside_others(phase, region, top, left, bottom, right):
        for y in range(top, bottom):
            stopped, ray = stopped_pixels(brightness, region, y, left, right, ray)
            for x in range(left, right):
                if stopped[x - left] == 1:
                    if is_cut_off(brightness, modulation, phase, region, y, x):
                        mask[y, x] = ti.cast(0, ti.u8)
                        marks = 1
    return marks


@ti.func
def ends_at(region: I32Array2, y: i32, x: i32) -> u1:
    """Return whether a surface ends at a pixel, in any of eight directions: behind a hole it continues."""
    ends, ray = False, 0
    while ray < 8 and not ends:
        dy, dx = place_of_ray(ray)
        room = ti.min(room_along(y, dy, region.shape[0]), room_along(x, dx, region.shape[1]))
        far, most = 1, ti.min(room, _HOLE)
        while far <= most and region[y + far * dy, x + far * dx] != region[y, x]:
            far += 1
        ends = room > 0 and far > most
        ray += 1
    return ends


@ti.func
def mark_rim(region: I32Array2, mask: U8Array2, cell: i32) -> i32:
    """Mark a cell's pixels at the ends of surfaces on the mask, and return whether there are any."""
    marks = 0
    top, left, bottom, right = cell_bounds(cell, region.shape[0], region.shape[1])
    if lies_at_rim(region, top, left, bottom, right):
        for y in range(top, bottom):
            for x in range(left, right):
                if region[y, x] > 0 and ends_at(region, y, x):
                    mask[y, x] = ti.cast(0, ti.u8)
                    marks = 1
    return marks


@kernel
def leave_out_strangers_kernel(
    brightness: F32Array2,  # (H, W) up to a factor
    modulation: F32Array2,  # (H, W) levels
    phase: F32Array2,  # (H, W) rad; NO_PHASE where there is none
    region: I32Array2,  # (H, W) from 1; 0: none
    unwrapped: F32Array2,  # (H, W) rad
    mask: U8Array2,  # (H, W)
    marked: I32Array1,  # (cells,) scratch: which cells hold pixels to take off
):
    """Mark what is cut off, and only then take it off: neighbours look at what is left out as it was."""
    for cell in range(marked.shape[0]):
        marked[cell] = mark_strangers(brightness, modulation, phase, region, mask, cell)
    for cell in range(marked.shape[0]):
        if marked[cell] == 1:
            take_off(region, unwrapped, mask, cell)


@kernel
def trim_rims_kernel(
    region: I32Array2,  # (H, W) from 1; 0: none
    unwrapped: F32Array2,  # (H, W) rad
    mask: U8Array2,  # (H, W)
    marked: I32Array1,  # (cells,) scratch: which cells hold pixels to take off
):
    """Mark the last pixels of surfaces, and only then take them off."""
    for cell in range(marked.shape[0]):
        marked[cell] = mark_rim(region, mask, cell)
    for cell in range(marked.shape[0]):
        if marked[cell] == 1:
            take_off(region, unwrapped, mask, cell)


def leave_out_strangers(brightness: F32, modulation: F32, phase: F32, out: tuple[F32, U8, I32]) -> None:
    """Take the pixels at surfaces' rims off the mask that belong to another surface, or see what lies beyond.

    Parameters
    ----------
    brightness : (H, W) float32
        Of the surface, without the fringe; up to a factor.
    modulation : (H, W) float32
        Amplitude of the fringe, levels.
    phase : (H, W) float32
        rad; NO_PHASE where no fringe is seen.
    out : three (H, W)
        Unwrapped phase, rad, float32; mask, uint8; and the surface of each pixel, int32, 0 off the mask. They are
        changed: NaN, 0 and 0.

    Raises
    ------
    ShapeError
        A shape or dtype is another one, or an output cannot be written.
    """
    brightness = checks.read_array("brightness", brightness, (None, None), np.float32)
    shape = (int(brightness.shape[0]), int(brightness.shape[1]))
    modulation = checks.read_array("modulation", modulation, shape, np.float32)
    phase = checks.read_array("phase", phase, shape, np.float32)
    unwrapped = checks.out_buffer("unwrapped", out[0], shape, np.float32)
    mask = checks.out_buffer("mask", out[1], shape, np.uint8)
    region = checks.out_buffer("region", out[2], shape, np.int32)
    rows, columns = cells_of(*shape)
    marked = runtime.empty((rows * columns,), np.int32)
    leave_out_strangers_kernel(brightness, modulation, phase, region, unwrapped, mask, marked)
    trim_rims_kernel(region, unwrapped, mask, marked)
