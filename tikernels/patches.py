"""Grow patches: row runs that surely belong together, cell by cell, and the contacts between them.

Along a stripe the phase changes least, so each row falls into runs without a doubt inside, and a run joins the run
above by a vote over their whole contact (sections 4.1 and 4.2 of Je, Lee and Park 2004). Every cell of 8 x 16 pixels
does so on its own; where patches of one cell or of neighbouring cells touch, they note a contact with its votes.
"""

from tikernels._taichi import F32Array2, I32Array1, I32Array2, f32, i32, ivec3, ti
from tikernels.filtering import MAX_DEPARTURE
from tikernels.phase_vector import PI
from tikernels.wrapped_phase import NO_PHASE

# Short along the stripe: where a hidden step of whole cycles slips into a run, at most half a cell is wrong.
CELL_WIDTH, CELL_HEIGHT = 8, 16
# A label holds a patch and, in its lowest six bits, an order inside it, which stays within the cell's +-24 pixels.
# Shifts, because Taichi's integer division rounds down and branches to do so.
ORDER_BITS, ORDER_MASK, ORDER_ZERO = 6, 63, 32
# Labels of pixels without a phase, and of those that saw two surfaces.
NOTHING, BETWEEN = -1, -2
# Inside a patch neighbours depart by less than this (rad) and differ in modulation by less than this factor, along and
# across the stripes. A step that hides behind whole cycles seldom does both, and only patches are never cut again.
# Across, slopes change the phase more, and a response that is not linear lets the modulation swing three times a cycle.
_SURE_ALONG, _ALIKE_ALONG = 0.25, 0.75
_SURE_ACROSS, _ALIKE_ACROSS = 0.5, 0.5
GOLDEN = -1640531527  # 2^32 / golden ratio, odd: multiplying by it shuffles the 32-bit numbers one to one
# Rows of the patch and contact tables, and the counters; the last is the most patches, or a quarter of the most
# contacts, that any cell has.
PIXELS, WEIGHT, FIRST, ROOT, OFFSET, PARENT, STEP, SUPPORT, KEY, CHOICE = range(10)
FROM, TO, SHIFT, VOTES, NAME = range(5)
N_PATCHES, N_CONTACTS, N_MERGED, N_CROWDED = range(4)


@ti.func
def cycles_between(difference: f32, rate: f32) -> i32:
    """Whole cycles to add to a difference of two wrapped phases to bring it nearest to the usual change."""
    excess = difference - rate
    return ti.cast(excess < -PI, ti.i32) - ti.cast(excess > PI, ti.i32)


@ti.func
def departure(difference: f32, rate: f32, cycles: i32) -> f32:
    """How far a difference with its cycles is from the usual change."""
    return ti.abs(difference - rate + 2.0 * PI * ti.cast(cycles, ti.f32))


@ti.func
def add_contact(
    contacts: I32Array2, start: i32, count: i32, room: i32, a: i32, b: i32, shift: i32, votes: i32, name: i32
) -> i32:
    """Note that offset[b] = offset[a] + shift, by so many votes, and return how many contacts there are now.

    The contacts of a cell begin at its start; the name is the contact's own.
    """
    place = start + ti.min(count, room - 1)
    contacts[FROM, place] = a
    contacts[TO, place] = b
    contacts[SHIFT, place] = shift
    contacts[VOTES, place] = votes
    contacts[NAME, place] = name * GOLDEN
    return count + 1


@ti.func
def brightness(quality: f32, mean_quality: f32) -> i32:
    """One to sixteen, four for an ordinary pixel."""
    return ti.min(ti.max(ti.cast(4.0 * quality / mean_quality, ti.i32), 1), 16)


@ti.func
def vote_weight(departs: f32, quality: f32, quality2: f32, mean_quality: f32) -> i32:
    """Weight of one pixel's vote, 1 to 64: the phase goes on, and so does the brightness, which is not low.

    A step that hides behind whole cycles departs by anything at its every pixel and seldom joins two equally bright
    surfaces.
    """
    low, high = ti.min(quality, quality2), ti.max(quality, quality2)
    going_on = 1.0 - departs / MAX_DEPARTURE
    alike = low / ti.max(high, 1e-12)
    return 1 + ti.cast(63.0 * going_on * going_on * alike * alike * ti.min(4.0 * low / mean_quality, 1.0), ti.i32)


@ti.func
def vote_above(phase: F32Array2, quality: F32Array2, labels: I32Array2, y: i32, x: i32, rate: f32) -> ivec3:
    """Patch of the pixel above, the shift that makes this run continue it, and whether that is sure.

    Patch -1: no vote across a step. The row above holds patches and orders already, this one its runs' own orders.
    """
    vote = ti.Vector([-1, 0, 0])
    above = labels[y - 1, x]
    if above >= 0:
        difference = phase[y, x] - phase[y - 1, x]
        cycles = cycles_between(difference, rate)
        departs = departure(difference, rate, cycles)
        if departs <= MAX_DEPARTURE:
            order = (above & ORDER_MASK) - ORDER_ZERO + cycles
            here, there = quality[y, x], quality[y - 1, x]
            sure = departs <= _SURE_ACROSS and ti.min(here, there) > _ALIKE_ACROSS * ti.max(here, there)
            vote = ti.Vector([above >> ORDER_BITS, order - labels[y, x], ti.cast(sure, ti.i32)])
    return vote


@ti.kernel
def grow_patches_kernel(
    phase: F32Array2,  # (H, W) rad; NO_PHASE outside the mask
    quality: F32Array2,  # (H, W)
    rates: F32Array2,  # last row: rate along, rate across (rad a px), mean quality
    draft_bits: i32,  # a cell has places for 2^bits patches and four times as many contacts
    out_labels: I32Array2,  # (H, W) patch and order inside it; NOTHING, or BETWEEN two surfaces
    out_patches: I32Array2,  # (3, cells << bits)
    out_contacts: I32Array2,  # (5, 4 cells << bits)
    out_counts: I32Array2,  # (3, cells + 1) patches and contacts of each cell; 1 where it has a pixel between surfaces
):
    height, width = phase.shape[0], phase.shape[1]
    cell_columns = (width + CELL_WIDTH - 1) // CELL_WIDTH
    cells = cell_columns * ((height + CELL_HEIGHT - 1) // CELL_HEIGHT)
    last = rates.shape[0] - 1
    room = 1 << draft_bits
    for cell in range(cells):
        rate_along, rate_across, mean_quality = rates[last, 0], rates[last, 1], rates[last, 2]
        patch_start, contact_start = cell << draft_bits, cell << (draft_bits + 2)
        patch_count, contact_count, steps = 0, 0, 0
        top, left = (cell // cell_columns) * CELL_HEIGHT, (cell % cell_columns) * CELL_WIDTH
        bottom, right = ti.min(top + CELL_HEIGHT, height), ti.min(left + CELL_WIDTH, width)
        for y in range(top, bottom):
            x = left
            while x < right:
                start = x
                before = phase[y, x]
                if before > 0.5 * NO_PHASE:
                    out_labels[y, x] = NOTHING
                    if before > 1.5 * NO_PHASE:
                        out_labels[y, x] = BETWEEN
                        steps = 1
                    x += 1
                else:
                    # The run: its orders count from its first pixel.
                    order, quality_before = 0, quality[y, x]
                    out_labels[y, x] = 0
                    x += 1
                    going = 1
                    while going == 1 and x < right:
                        here = phase[y, x]
                        cycles = cycles_between(here - before, rate_along)
                        # What is no phase departs by far more.
                        departs = departure(here - before, rate_along, cycles)
                        quality_here = quality[y, x]
                        low, high = ti.min(quality_here, quality_before), ti.max(quality_here, quality_before)
                        if departs > _SURE_ALONG or low < _ALIKE_ALONG * high:
                            going = 0
                        else:
                            order += cycles
                            out_labels[y, x] = order
                            before, quality_before = here, quality_here
                            x += 1
                    # Its contact with the runs above: each pixel votes for a patch and a shift.
                    patch, shift, votes, voters = -1, 0, 0, 0
                    if y > top:
                        for voter in range(start, x):
                            vote = vote_above(phase, quality, out_labels, y, voter, rate_across)
                            if vote.x >= 0:
                                voters += 1
                                if patch < 0 and vote.z == 1:
                                    patch, shift = vote.x, vote.y
                                if vote.x == patch and vote.y == shift:
                                    votes += vote.z
                        if votes < voters:  # seldom: they disagree, or are not sure
                            for candidate in range(start + 1, x):
                                choice = vote_above(phase, quality, out_labels, y, candidate, rate_across)
                                tally = 0
                                for voter in range(candidate, x):
                                    vote = vote_above(phase, quality, out_labels, y, voter, rate_across)
                                    if vote.x == choice.x and vote.y == choice.y:
                                        tally += vote.z
                                if choice.x >= 0 and tally > votes:
                                    patch, shift, votes = choice.x, choice.y, tally
                    # One pixel's word is too little for a run of several.
                    joins = votes > 0 and 2 * votes >= voters and (votes > 1 or x - start <= 2)
                    if not joins:
                        patch, shift = patch_start + ti.min(patch_count, room - 1), 0
                        patch_count += 1
                        out_patches[PIXELS, patch] = 0
                        out_patches[WEIGHT, patch] = 0
                        out_patches[FIRST, patch] = y * width + start
                    # Not "+=": that is atomic, and nobody else writes here.
                    weight = (x - start) * brightness(quality[y, (start + x) >> 1], mean_quality)
                    out_patches[PIXELS, patch] = out_patches[PIXELS, patch] + (x - start)
                    out_patches[WEIGHT, patch] = out_patches[WEIGHT, patch] + weight
                    # What the others voted for becomes contacts between patches.
                    if votes < voters or (voters > 0 and not joins):
                        for candidate in range(start, x):
                            choice = vote_above(phase, quality, out_labels, y, candidate, rate_across)
                            tally, noted = 0, 0
                            for voter in range(start, x):
                                vote = vote_above(phase, quality, out_labels, y, voter, rate_across)
                                if vote.x == choice.x and vote.y == choice.y:
                                    difference = phase[y, voter] - phase[y - 1, voter]
                                    departs = departure(
                                        difference, rate_across, cycles_between(difference, rate_across)
                                    )
                                    above = quality[y - 1, voter]
                                    tally += 2 * vote_weight(departs, quality[y, voter], above, mean_quality)
                                    if voter < candidate:
                                        noted = 1
                            if choice.x >= 0 and choice.x != patch and noted == 0:
                                name = 3 * (y * width + candidate)
                                turn = choice.y - shift
                                contact_count = add_contact(
                                    out_contacts,
                                    contact_start,
                                    contact_count,
                                    4 * room,
                                    choice.x,
                                    patch,
                                    turn,
                                    tally,
                                    name,
                                )
                    # The run before, where it ended without a step.
                    if start > left:
                        label = out_labels[y, start - 1]
                        if label >= 0:
                            difference = phase[y, start] - phase[y, start - 1]
                            cycles = cycles_between(difference, rate_along)
                            departs = departure(difference, rate_along, cycles)
                            if departs <= MAX_DEPARTURE and label >> ORDER_BITS != patch:
                                turn = (label & ORDER_MASK) - ORDER_ZERO + cycles - shift
                                before = quality[y, start - 1]
                                tally = vote_weight(departs, quality[y, start], before, mean_quality)
                                name = 3 * (y * width + start - 1) + 1
                                other = label >> ORDER_BITS
                                contact_count = add_contact(
                                    out_contacts,
                                    contact_start,
                                    contact_count,
                                    4 * room,
                                    other,
                                    patch,
                                    turn,
                                    tally,
                                    name,
                                )
                    for column in range(start, x):
                        out_labels[y, column] = (patch << ORDER_BITS) + out_labels[y, column] + shift + ORDER_ZERO
        out_counts[0, cell] = patch_count
        out_counts[1, cell] = contact_count
        out_counts[2, cell] = steps
    # The cells' borders, right and bottom.
    for cell in range(cells):
        rate_along, rate_across, mean_quality = rates[last, 0], rates[last, 1], rates[last, 2]
        contact_start, contact_count = cell << (draft_bits + 2), out_counts[1, cell]
        top, left = (cell // cell_columns) * CELL_HEIGHT, (cell % cell_columns) * CELL_WIDTH
        bottom, right = ti.min(top + CELL_HEIGHT, height), ti.min(left + CELL_WIDTH, width)
        for side in ti.static(range(2)):
            length, rate = bottom - top, rate_along
            if ti.static(side == 1):
                length, rate = right - left, rate_across
            if (side == 0 and right == width) or (side == 1 and bottom == height):
                length = 0
            # A pixel counts double on the shorter side, so that both are worth the same.
            scale = ti.static((1, CELL_HEIGHT // CELL_WIDTH)[side])
            a, b, shift, votes, pixel = -1, -1, 0, 0, 0
            for step in range(length + 1):
                next_a, next_b, next_shift, weight = -1, -1, 0, 0
                y, x = top + step, right - 1
                if ti.static(side == 1):
                    y, x = bottom - 1, left + step
                if step < length:
                    y2, x2 = y + side, x + 1 - side
                    label, label2 = out_labels[y, x], out_labels[y2, x2]
                    if (label | label2) >= 0:
                        difference = phase[y2, x2] - phase[y, x]
                        cycles = cycles_between(difference, rate)
                        departs = departure(difference, rate, cycles)
                        if departs <= MAX_DEPARTURE:
                            next_a, next_b = label >> ORDER_BITS, label2 >> ORDER_BITS
                            next_shift = (label & ORDER_MASK) - (label2 & ORDER_MASK) + cycles
                            weight = scale * vote_weight(departs, quality[y, x], quality[y2, x2], mean_quality)
                if next_a == a and next_b == b and next_shift == shift:
                    votes += weight
                else:
                    if a >= 0:
                        name = 3 * pixel + 1 + side
                        contact_count = add_contact(
                            out_contacts, contact_start, contact_count, 4 * room, a, b, shift, votes, name
                        )
                    a, b, shift, votes, pixel = next_a, next_b, next_shift, weight, y * width + x
            if a >= 0:
                name = 3 * pixel + 1 + side
                contact_count = add_contact(
                    out_contacts, contact_start, contact_count, 4 * room, a, b, shift, votes, name
                )
        out_counts[1, cell] = contact_count


@ti.kernel
def number_patches_kernel(
    cells: i32,
    firsts: I32Array2,  # (3, cells + 1) patches and contacts of each cell; becomes the number of each cell's first ones
    out_counters: I32Array1,
):
    for _ in range(1):
        patches, contacts, crowded = 0, 0, 0
        for cell in range(cells):
            patch_count, contact_count = firsts[0, cell], firsts[1, cell]
            crowded = ti.max(crowded, ti.max(patch_count, (contact_count + 3) // 4))
            firsts[0, cell] = patches
            firsts[1, cell] = contacts
            patches += patch_count
            contacts += contact_count
        firsts[0, cells] = patches
        firsts[1, cells] = contacts
        out_counters[N_PATCHES] = patches
        out_counters[N_CONTACTS] = contacts
        out_counters[N_CROWDED] = crowded


@ti.func
def patch_number(draft: i32, firsts: I32Array2, draft_bits: i32) -> i32:
    """Return the final number of a drafted patch."""
    return firsts[0, draft >> draft_bits] + (draft & ((1 << draft_bits) - 1))


@ti.kernel
def collect_patches_kernel(
    cells: i32,
    draft_bits: i32,
    draft_patches: I32Array2,  # (3, cells << bits)
    draft_contacts: I32Array2,  # (5, 4 cells << bits)
    firsts: I32Array2,  # (3, cells + 1)
    out_patches: I32Array2,  # (10, capacity) each a region of its own
    out_contacts: I32Array2,  # (5, capacity)
):
    for cell in range(cells):
        for k in range(firsts[0, cell + 1] - firsts[0, cell]):
            draft, patch = (cell << draft_bits) + k, firsts[0, cell] + k
            out_patches[PIXELS, patch] = draft_patches[PIXELS, draft]
            out_patches[WEIGHT, patch] = draft_patches[WEIGHT, draft]
            out_patches[FIRST, patch] = draft_patches[FIRST, draft]
            out_patches[ROOT, patch] = patch
            out_patches[OFFSET, patch] = 0
        for k in range(firsts[1, cell + 1] - firsts[1, cell]):
            draft, contact = (cell << (draft_bits + 2)) + k, firsts[1, cell] + k
            out_contacts[FROM, contact] = patch_number(draft_contacts[FROM, draft], firsts, draft_bits)
            out_contacts[TO, contact] = patch_number(draft_contacts[TO, draft], firsts, draft_bits)
            out_contacts[SHIFT, contact] = draft_contacts[SHIFT, draft]
            out_contacts[VOTES, contact] = draft_contacts[VOTES, draft]
            out_contacts[NAME, contact] = draft_contacts[NAME, draft]
