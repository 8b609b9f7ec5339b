"""Read a pattern's code: the contrast of every cycle in every patch, and what it does to the phase.

The contrast of a cycle is its mean modulation over its mean background. Neither the surface's reflectance nor its
shading is in it; what changes it otherwise (ambient light, blur) changes slowly. Pixels weigh (1 - (phase / pi)^2)^2:
most in the middle of the cycle, where the symbol is its own, and in such a way that the ripple which a response that is
not linear gives the modulation, three times a cycle, sums up to nothing however few pixels there are.
"""

from functools import cache
from typing import Any

from tikernels._taichi import (
    AnyArray3,
    F32Array1,
    F32Array2,
    F32Array3,
    I32Array1,
    I32Array2,
    U8Array2,
    f32,
    i32,
    ti,
    vec3,
)
from tikernels.balance import gain_at
from tikernels.patches import CELL_HEIGHT, CELL_WIDTH, ORDER_BITS, ORDER_MASK, ORDER_ZERO, cell_bounds, patch_number
from tikernels.phase_vector import PI, STRIP, matrix_of, wrap
from tikernels.seams import TORN
from tikernels.wrapped_phase import NO_PHASE

#: Cycles to either side between which the modulation's slope is taken: blur rounds the tips of the code off.
SLOPE_REACH = 0.2
#: Orders that a patch may hold, its first pixel's in the middle: a cell of 16 rows holds at most four cycles of 4 px,
#: and slopes may double them.
SLOTS = 17
# A pixel at a step is taken for a surface beside it that it continues to so many rad, and as brightly, if it departs by
# so much more from every other one within reach (px, in eight directions); so many pixels deep. What sees two surfaces
# at once has any phase, and less modulation. Where there is no other one, a steep facet may continue less smoothly.
_MAX_ADOPTED, _ALIKE, _MIN_RIVAL = 0.25, 0.85, 0.5
_MAX_ALONE, _ALIKE_ALONE = 1.2, 0.5
_AROUND = ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1))
_REACH, _PASSES = 3, 2
#: What is summed of a cycle.
TOTAL, MODULATION, BACKGROUND, PHASE = range(4)


@cache
def measure_contrast_kernel(balance_first: bool) -> Any:
    """Return the kernel that sums every patch's modulation and background, order by order."""

    @ti.kernel
    def measure_contrast(
        image: AnyArray3,  # (H, W, 3) levels
        inverse_matrix: F32Array2,  # (3, 3) undoes the crosstalk
        gains: F32Array3,  # (Hg, Wg, 3)
        gain_cell: i32,  # px between two nodes of the gains
        phase: F32Array2,  # (H, W) rad
        modulation: F32Array2,  # (H, W) levels
        labels: I32Array2,  # (H, W) patch and order inside it
        firsts: I32Array2,  # (3, cells + 1)
        draft_bits: i32,
        out_sums: F32Array3,  # (patches, SLOTS, 4) weight, and weighted modulation, background (levels), phase (rad)
    ):
        height, width = phase.shape[0], phase.shape[1]
        for cell in range(firsts.shape[1] - 1):
            top, left, bottom, right = cell_bounds(cell, height, width)
            inverse = matrix_of(inverse_matrix)
            for patch in range(firsts[0, cell], firsts[0, cell + 1]):
                for slot in range(SLOTS):
                    for k in ti.static(range(4)):
                        out_sums[patch, slot, k] = 0.0
            for y in range(top, bottom):
                # One gain serves the row of a cell, and every fourth pixel, others from row to row, tells enough.
                gain = gain_at(gains, gain_cell, y, (left + right) // 2)
                x = left + 2 * (y & 1) + ((y >> 1) & 1)
                while x < right:
                    label = labels[y, x]
                    if label >= 0:
                        light = vec3(
                            ti.cast(image[y, x, 0], ti.f32),
                            ti.cast(image[y, x, 1], ti.f32),
                            ti.cast(image[y, x, 2], ti.f32),
                        )
                        channels = vec3(0.0)
                        if ti.static(balance_first):
                            channels = inverse @ (light * gain)
                        else:
                            channels = (inverse @ light) * gain
                        slot = (label & ORDER_MASK) - ORDER_ZERO + SLOTS // 2
                        if slot >= 0 and slot < SLOTS:
                            patch = patch_number(label >> ORDER_BITS, firsts, draft_bits)
                            inside = 1.0 - phase[y, x] * phase[y, x] / (PI * PI)
                            weight = inside * inside
                            terms = vec3(modulation[y, x], channels.sum() / 3.0, phase[y, x])
                            # Not "+=": that is atomic, and nobody else writes here.
                            out_sums[patch, slot, TOTAL] = out_sums[patch, slot, TOTAL] + weight
                            for k in ti.static(range(3)):
                                out_sums[patch, slot, k + 1] = out_sums[patch, slot, k + 1] + weight * terms[k]
                    x += 4

    return measure_contrast


#: Offsets that the evidence of a region is weighed for.
CANDIDATES = 8


@ti.func
def part_of(parents: I32Array1, patch: i32) -> i32:
    """Return the patch that stands for a patch's part, and shorten the way to it."""
    part = patch
    while parents[part] != part:
        parents[part] = parents[parents[part]]
        part = parents[part]
    return part


@ti.func
def likeliest(evidence: F32Array2, part: i32) -> i32:
    """Return the offset that the part's contrast departs least from."""
    best = 0
    for k in ti.static(range(1, CANDIDATES)):
        if evidence[part, k] < evidence[part, best]:
            best = k
    return best


@ti.kernel
def join_parts_kernel(
    ends: I32Array2,  # (2, C) the patches of each contact, the best supported ones first
    span: i32,  # orders that a part must show before its word counts
    min_margin: f32,  # by how much a part must prefer its offset to another part's,
    margin_a_pair: f32,  # and by how much for each pair of cycles it has
    orders: I32Array2,  # (P, 2) first and last order of each patch, then of each part
    evidence: F32Array2,  # (P, CANDIDATES + 1) departure from each offset, and pairs of cycles; then of each part
    out_parents: I32Array1,  # (P,) a patch of the same part, in the end the one that stands for it
):
    """Join patches along their contacts, but not two parts whose cycles tell that they lie whole cycles apart."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        for patch in range(out_parents.shape[0]):
            out_parents[patch] = patch
        for contact in range(ends.shape[1]):
            a, b = part_of(out_parents, ends[0, contact]), part_of(out_parents, ends[1, contact])
            if a != b:
                best_a, best_b = likeliest(evidence, a), likeliest(evidence, b)
                need_a = ti.max(min_margin, margin_a_pair * evidence[a, CANDIDATES])
                need_b = ti.max(min_margin, margin_a_pair * evidence[b, CANDIDATES])
                apart = ti.min(orders[a, 1] - orders[a, 0], orders[b, 1] - orders[b, 0]) >= span
                apart &= evidence[a, best_b] - evidence[a, best_a] >= need_a
                apart &= evidence[b, best_a] - evidence[b, best_b] >= need_b
                if not apart:
                    low, high = ti.min(a, b), ti.max(a, b)
                    out_parents[high] = low
                    for k in range(CANDIDATES + 1):
                        evidence[low, k] = evidence[low, k] + evidence[high, k]
                    orders[low, 0] = ti.min(orders[low, 0], orders[high, 0])
                    orders[low, 1] = ti.max(orders[low, 1], orders[high, 1])
        for patch in range(out_parents.shape[0]):
            out_parents[patch] = part_of(out_parents, patch)


@ti.func
def departure_at(departures: F32Array1, cycles: f32) -> f32:
    """Return the code's modulation at a phase, less the usual one, as a fraction of it."""
    inside = ti.min(ti.max(cycles, 0.0), ti.cast(departures.shape[0] - 1, ti.f32))
    below = ti.min(ti.cast(inside, ti.i32), departures.shape[0] - 2)
    part = inside - ti.cast(below, ti.f32)
    return departures[below] + part * (departures[below + 1] - departures[below])


@ti.kernel
def correct_by_modulation_kernel(
    region: I32Array2,  # (H, W) region's number from 1; 0 outside
    absolute: I32Array1,  # (regions + 1,) 1 where the orders are absolute
    departures: F32Array1,  # (cycles,) modulation in the middle of each cycle, less the usual one, as a fraction of it
    table: F32Array2,  # (2, bins + 1) rad: part of the response's correction that goes with the modulation, its square
    shift: f32,  # rad that blur shifts the phase by where the modulation rises e-fold a cycle
    phase: F32Array2,  # (H, W) rad in [-pi, pi], to be corrected
    unwrapped: F32Array2,  # (H, W) rad, to be corrected
):
    """Correct what response and blur do to cycles whose modulation is not the usual one, or changes."""
    height, width = phase.shape[0], phase.shape[1]
    strips = (width + STRIP - 1) // STRIP
    bins = table.shape[1] - 1
    for t in range(height * strips):
        y, first = t // strips, (t % strips) * STRIP
        for x in range(first, ti.min(first + STRIP, width)):
            if absolute[region[y, x]] == 1:
                cycles = unwrapped[y, x] * (0.5 / PI)
                departs = departure_at(departures, cycles)
                rise = departure_at(departures, cycles + SLOPE_REACH) - departure_at(departures, cycles - SLOPE_REACH)
                # The table runs from -pi to pi.
                place = (cycles + 0.5 - ti.floor(cycles + 0.5)) * ti.cast(bins, ti.f32)
                bin_below = ti.min(ti.cast(place, ti.i32), bins - 1)
                share = place - ti.cast(bin_below, ti.f32)
                linear = table[0, bin_below] + share * (table[0, bin_below + 1] - table[0, bin_below])
                square = table[1, bin_below] + share * (table[1, bin_below + 1] - table[1, bin_below])
                correction = departs * (linear + (2.0 + departs) * square)
                correction -= shift * rise / (2.0 * SLOPE_REACH * (1.0 + departs))
                phase[y, x] = phase[y, x] + correction
                unwrapped[y, x] = unwrapped[y, x] + correction


@ti.func
def continued(
    phase: f32, unwrapped: F32Array2, region: I32Array2, rates: F32Array2, y: i32, x: i32, dy: i32, dx: i32, far: i32
) -> vec3:
    """Return a phase with the orders of the surface so far away, how far it departs from it, and its region.

    The surface is continued by the slope of its last two pixels; a region of 0 means that there is none.
    """
    height, width, last = region.shape[0], region.shape[1], rates.shape[0] - 1
    result = vec3(0.0, NO_PHASE, 0.0)
    y1, x1 = y + far * dy, x + far * dx
    y2, x2 = y1 + dy, x1 + dx
    if y1 >= 0 and y1 < height and x1 >= 0 and x1 < width:
        number = region[y1, x1]
        if number > 0:
            slope = -(dx * rates[last, 0] + dy * rates[last, 1])
            if y2 >= 0 and y2 < height and x2 >= 0 and x2 < width:
                if region[y2, x2] == number:
                    slope = unwrapped[y1, x1] - unwrapped[y2, x2]
            expected = unwrapped[y1, x1] + far * slope
            value = phase + 2.0 * PI * ti.round((expected - phase) * (0.5 / PI))
            result = vec3(value, ti.abs(value - expected), ti.cast(number, ti.f32))
    return result


@ti.kernel
def adopt_pixels_kernel(
    phase: F32Array2,  # (H, W) rad; STEP_PHASE at steps
    raw_phase: F32Array2,  # (H, W) rad, before smoothing; NO_PHASE where there is none
    modulation: F32Array2,  # (H, W)
    rates: F32Array2,  # last row: usual change along and across the stripes, rad a px
    absolute: I32Array1,  # (regions + 1,) 1 where the orders are absolute
    final: I32Array2,  # the last row says which cells are torn: nobody knows what their pixels continue
    adopted: F32Array3,  # (H, W, 2) scratch
    unwrapped: F32Array2,  # (H, W) rad
    mask: U8Array2,  # (H, W)
    region: I32Array2,  # (H, W)
):
    """Give pixels at steps, which belong to nobody, to the one absolute surface that they continue."""
    height, width = phase.shape[0], phase.shape[1]
    columns = (width + CELL_WIDTH - 1) // CELL_WIDTH
    for _ in ti.static(range(_PASSES)):
        for y, x in ti.ndrange(height, width):
            if mask[y, x] == 0:
                adopted[y, x, 1] = 0.0
            torn = final[2, (y // CELL_HEIGHT) * columns + x // CELL_WIDTH] == TORN
            if mask[y, x] == 0 and raw_phase[y, x] < 0.5 * NO_PHASE and not torn:
                here = phase[y, x]
                if here > 0.5 * NO_PHASE:
                    here = raw_phase[y, x]
                best, alike = vec3(0.0, NO_PHASE, 0.0), 0.0
                for side in ti.static(range(4)):
                    dy, dx = ti.static((-1, 1, 0, 0)[side]), ti.static((0, 0, -1, 1)[side])
                    other = continued(here, unwrapped, region, rates, y, x, dy, dx, 1)
                    if other.y < best.y:
                        best = other
                        low = ti.min(modulation[y, x], modulation[y + dy, x + dx])
                        alike = low / ti.max(ti.max(modulation[y, x], modulation[y + dy, x + dx]), 1e-12)
                number = ti.cast(best.z, ti.i32)
                if best.y < _MAX_ALONE and absolute[number] == 1:
                    rival, alone = NO_PHASE, 1
                    for dy, dx in ti.static(_AROUND):
                        for far in range(1, _REACH + 1):
                            other = continued(here, unwrapped, region, rates, y, x, dy, dx, far)
                            if other.z > 0.0:
                                if ti.abs(other.x - best.x) > PI:
                                    rival = ti.min(rival, other.y)
                                    alone = 0
                                elif other.z != best.z:
                                    alone = 0
                    belongs = best.y < _MAX_ADOPTED and alike > _ALIKE and rival > best.y + _MIN_RIVAL
                    if belongs or (alone == 1 and alike > _ALIKE_ALONE):
                        adopted[y, x, 0] = best.x
                        adopted[y, x, 1] = best.z
        for y, x in ti.ndrange(height, width):
            if mask[y, x] == 0 and adopted[y, x, 1] > 0.0:
                unwrapped[y, x] = adopted[y, x, 0]
                phase[y, x] = wrap(adopted[y, x, 0] - 2.0 * PI * ti.round(adopted[y, x, 0] * (0.5 / PI)))
                region[y, x] = ti.cast(adopted[y, x, 1], ti.i32)
                mask[y, x] = ti.cast(1, ti.u8)
