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
    u1,
    vec2,
    vec3,
    vec4,
)
from tikernels.phase.color_balance import gain_at
from tikernels.phase.phase_vector import PI, matrix_of, wrap
from tikernels.phase.wrapped_phase import NO_PHASE
from tikernels.strips import STRIP
from tikernels.unwrapping.hidden_steps import TORN
from tikernels.unwrapping.patch_growing import (
    CELL_HEIGHT,
    CELL_WIDTH,
    NOTHING,
    ORDER_BITS,
    ORDER_MASK,
    ORDER_ZERO,
    cell_bounds,
    patch_number,
)

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
_REACH, _PASSES = 3, 3
# Of a cell's columns, those that are looked at: one of each colour of a Bayer sensor.
_COLUMNS = (1, 6)
#: What is summed of a cycle.
TOTAL, MODULATION, BACKGROUND, PHASE = range(4)


@ti.func
def add_cycle(label: i32, sums: vec4, firsts: I32Array2, draft_bits: i32, out_sums: F32Array3):
    """Add what one column shows of a cycle to the sums of its patch and order."""
    slot = (label & ORDER_MASK) - ORDER_ZERO + SLOTS // 2
    if label >= 0 and slot >= 0 and slot < SLOTS:
        patch = patch_number(label >> ORDER_BITS, firsts, draft_bits)
        for k in ti.static(range(4)):
            # Not "+=": that is atomic, and nobody else writes here.
            out_sums[patch, slot, k] = out_sums[patch, slot, k] + sums[k]


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
            # Two columns tell enough; down a column a cycle's pixels follow each other.
            for column in ti.static(_COLUMNS):
                x = ti.min(left + column, right - 1)
                label, sums, background = NOTHING, vec4(0.0), vec3(0.0)
                for y in range(top, bottom):
                    if y & 3 == 0:  # one gain serves four rows of a cell
                        gain = gain_at(gains, gain_cell, y + 2, (left + right) // 2)
                        if ti.static(balance_first):
                            background = inverse.transpose() @ vec3(1.0 / 3.0) * gain
                        else:
                            background = inverse.transpose() @ gain / 3.0
                    if labels[y, x] != label:
                        add_cycle(label, sums, firsts, draft_bits, out_sums)
                        label, sums = labels[y, x], vec4(0.0)
                    if label >= 0:
                        light = vec3(
                            ti.cast(image[y, x, 0], ti.f32),
                            ti.cast(image[y, x, 1], ti.f32),
                            ti.cast(image[y, x, 2], ti.f32),
                        )
                        inside = 1.0 - phase[y, x] * phase[y, x] / (PI * PI)
                        weight = inside * inside
                        sums += weight * vec4(1.0, modulation[y, x], background.dot(light), phase[y, x])
                add_cycle(label, sums, firsts, draft_bits, out_sums)

    return measure_contrast


@ti.kernel
def match_stretches_kernel(
    stretches: F32Array2,  # (N, n) steps of the contrast's logarithm
    windows: F32Array2,  # (W, n) the code's
    out_matches: F32Array2,  # (N, 3) best window, its sum of squared differences, the next best one's
):
    """Find the windows that each stretch departs least from."""
    for i in range(stretches.shape[0]):
        best, least, second = 0, 1e9, 1e9
        for w in range(windows.shape[0]):
            departure = 0.0
            for k in range(stretches.shape[1]):
                difference = stretches[i, k] - windows[w, k]
                departure = departure + difference * difference
            if departure < least:
                best, least, second = w, departure, least
            elif departure < second:
                second = departure
        out_matches[i, 0] = ti.cast(best, ti.f32)
        out_matches[i, 1] = least
        out_matches[i, 2] = second


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


#: Places a cycle at which the correction is tabled: the slope's reach is a whole number of them, so its bends are met.
TABLED = 120


@ti.kernel
def correct_by_modulation_kernel(
    region: I32Array2,  # (H, W) region's number from 1; 0 outside
    absolute: I32Array1,  # (regions + 1,) 1 where the orders are absolute
    corrections: F32Array1,  # (N,) rad to add at an absolute phase, TABLED a cycle, from the first cycle's middle on
    phase: F32Array2,  # (H, W) rad in [-pi, pi], to be corrected
    unwrapped: F32Array2,  # (H, W) rad, to be corrected
):
    """Correct what response and blur do to cycles whose modulation is not the usual one, or changes."""
    height, width = phase.shape[0], phase.shape[1]
    strips = (width + STRIP - 1) // STRIP
    last = corrections.shape[0] - 1
    for t in range(height * strips):
        y, first = t // strips, (t % strips) * STRIP
        for x in range(first, ti.min(first + STRIP, width)):
            if absolute[region[y, x]] == 1:
                place = ti.min(ti.max(unwrapped[y, x] * (0.5 * TABLED / PI), 0.0), ti.cast(last, ti.f32))
                below = ti.min(ti.cast(place, ti.i32), last - 1)
                share = place - ti.cast(below, ti.f32)
                correction = corrections[below] + share * (corrections[below + 1] - corrections[below])
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


@ti.func
def adopter(
    phase: F32Array2,
    raw_phase: F32Array2,
    modulation: F32Array2,
    rates: F32Array2,
    absolute: I32Array1,
    unwrapped: F32Array2,
    region: I32Array2,
    torn: u1,
    y: i32,
    x: i32,
) -> vec2:
    """Return a pixel's phase in the one absolute surface that it continues, and that region's number, 0 if none.

    In a torn cell other surfaces may go on as well: there it must look like its neighbour, too, even if that is alone.
    """
    result = vec2(0.0)
    here = phase[y, x]
    if here > 0.5 * NO_PHASE:
        here = raw_phase[y, x]
    if here < 0.5 * NO_PHASE:
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
            for direction in range(9):
                dy, dx = direction // 3 - 1, direction % 3 - 1
                for far in range(1, ti.select(direction == 4, 1, _REACH + 1)):
                    other = continued(here, unwrapped, region, rates, y, x, dy, dx, far)
                    if other.z > 0.0:
                        if ti.abs(other.x - best.x) > PI:
                            rival = ti.min(rival, other.y)
                            alone = 0
                        elif other.z != best.z:
                            alone = 0
            belongs = best.y < _MAX_ADOPTED and alike > _ALIKE and rival > best.y + _MIN_RIVAL
            if torn:
                belongs = alone == 1 and best.y < _MAX_ADOPTED and alike > _ALIKE
            elif alone == 1:
                belongs |= alike > _ALIKE_ALONE
            if belongs:
                result = vec2(best.x, best.z)
    return result


@ti.kernel
def adopt_pixels_kernel(
    cell_steps: I32Array2,  # (3, cells or more) in the third row 1 where a cell has steps, TORN where they are hidden
    phase: F32Array2,  # (H, W) rad; STEP_PHASE at steps
    raw_phase: F32Array2,  # (H, W) rad, before smoothing; NO_PHASE where there is none
    modulation: F32Array2,  # (H, W)
    rates: F32Array2,  # last row: usual change along and across the stripes, rad a px
    absolute: I32Array1,  # (regions + 1,) 1 where the orders are absolute
    adopted: F32Array3,  # (H, W, 2) scratch
    unwrapped: F32Array2,  # (H, W) rad
    mask: U8Array2,  # (H, W)
    region: I32Array2,  # (H, W)
):
    """Give pixels at steps, which belong to nobody, to the one absolute surface that they continue."""
    height, width = phase.shape[0], phase.shape[1]
    cells = ((width + CELL_WIDTH - 1) // CELL_WIDTH) * ((height + CELL_HEIGHT - 1) // CELL_HEIGHT)
    for _ in ti.static(range(_PASSES)):
        for cell in range(cells):
            if cell_steps[2, cell] > 0:
                top, left, bottom, right = cell_bounds(cell, height, width)
                for y in range(top, bottom):
                    for x in range(left, right):
                        if mask[y, x] == 0:
                            torn = cell_steps[2, cell] == TORN
                            found = adopter(
                                phase, raw_phase, modulation, rates, absolute, unwrapped, region, torn, y, x
                            )
                            adopted[y, x, 0], adopted[y, x, 1] = found.x, found.y
        for cell in range(cells):
            if cell_steps[2, cell] > 0:
                top, left, bottom, right = cell_bounds(cell, height, width)
                for y in range(top, bottom):
                    for x in range(left, right):
                        if mask[y, x] == 0 and adopted[y, x, 1] > 0.0:
                            value = adopted[y, x, 0]
                            unwrapped[y, x] = value
                            phase[y, x] = wrap(value - 2.0 * PI * ti.round(value * (0.5 / PI)))
                            region[y, x] = ti.cast(adopted[y, x, 1], ti.i32)
                            mask[y, x] = ti.cast(1, ti.u8)
