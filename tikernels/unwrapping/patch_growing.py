"""Grow patches: row runs that surely belong together, cell by cell, and the contacts between them.

Along a stripe the phase changes least, so each row falls into runs without a doubt inside, and a run joins the run
above by a vote over their whole contact (sections 4.1 and 4.2 of Je, Lee and Park 2004). Every cell of 8 x 16 pixels
does so on its own; where patches of one cell or of neighbouring cells touch, they note a contact with its votes.
"""

from tikernels._taichi import F32Array2, I32Array1, I32Array2, Static, f32, i32, ivec2, ti, u1
from tikernels.phase.phase_vector import PI
from tikernels.phase.smoothing import MAX_DEPARTURE
from tikernels.phase.wrapped_phase import NO_PHASE

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
PIXELS, WEIGHT, FIRST, ROOT, OFFSET, PARENT, STEP, HEAD, TURN, SUPPORT, KEY, CHOICE = range(12)
FROM, TO, SHIFT, VOTES, NAME = range(5)
N_PATCHES, N_CONTACTS, N_MERGED, N_CROWDED = range(4)


row_of_floats = ti.types.vector(CELL_WIDTH, ti.f32)
row_of_integers = ti.types.vector(CELL_WIDTH, ti.i32)
side_of_floats = ti.types.vector(CELL_HEIGHT, ti.f32)
side_of_integers = ti.types.vector(CELL_HEIGHT, ti.i32)


@ti.func
def cell_bounds(cell: i32, height: i32, width: i32):
    """Return a cell's first row and column, and those past its last."""
    columns = (width + CELL_WIDTH - 1) // CELL_WIDTH
    top, left = (cell // columns) * CELL_HEIGHT, (cell % columns) * CELL_WIDTH
    return top, left, ti.min(top + CELL_HEIGHT, height), ti.min(left + CELL_WIDTH, width)


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
def surely_along(departs: f32, quality: f32, quality2: f32) -> u1:
    """Whether a pixel surely goes on where the one before it in the row ends."""
    low, high = ti.min(quality, quality2), ti.max(quality, quality2)
    differ = low < _ALIKE_ALONG * high  # false where the quality is missing
    return (departs <= _SURE_ALONG) & (not differ)


@ti.func
def surely_across(departs: f32, quality: f32, quality2: f32) -> u1:
    """Whether a pixel surely goes on where the one above it ends."""
    low, high = ti.min(quality, quality2), ti.max(quality, quality2)
    return (departs <= _SURE_ACROSS) & (low > _ALIKE_ACROSS * high)


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
def vote_above(phase: F32Array2, quality: F32Array2, labels: I32Array2, y: i32, x: i32, order: i32, rate: f32) -> ivec2:
    """Vote for what turns this run's orders into labels, so that the pixel continues the one above; then 1 if sure.

    -1: no vote across a step. The row above holds labels already.
    """
    vote = ti.Vector([-1, 0])
    above = labels[y - 1, x]
    if above >= 0:
        difference = phase[y, x] - phase[y - 1, x]
        cycles = cycles_between(difference, rate)
        departs = departure(difference, rate, cycles)
        if departs <= MAX_DEPARTURE:
            sure = surely_across(departs, quality[y, x], quality[y - 1, x])
            vote = ti.Vector([above + cycles - order, ti.cast(sure, ti.i32)])
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
    """Grow the patches of each cell and note where two of them touch inside it."""
    height, width = phase.shape[0], phase.shape[1]
    cells = ((width + CELL_WIDTH - 1) // CELL_WIDTH) * ((height + CELL_HEIGHT - 1) // CELL_HEIGHT)
    last = rates.shape[0] - 1
    room = 1 << draft_bits
    for cell in range(cells):
        rate_along, rate_across, mean_quality = rates[last, 0], rates[last, 1], rates[last, 2]
        patch_start, contact_start = cell << draft_bits, cell << (draft_bits + 2)
        patch_count, contact_count, steps = 0, 0, 0
        top, left, bottom, right = cell_bounds(cell, height, width)
        here_phase, above_phase = row_of_floats(0.0), row_of_floats(0.0)
        here_quality, above_quality = row_of_floats(0.0), row_of_floats(0.0)
        labels_here = row_of_integers(0)
        for y in range(top, bottom):
            x = left
            # Nearly every row is one run that joins the patch above by the voice of its every pixel. Those are done
            # here, eight pixels at once; the rest goes the long way, which would come to the same for them, too.
            if y > top and right - left == CELL_WIDTH:
                for k in range(CELL_WIDTH):
                    here_phase[k], here_quality[k] = phase[y, left + k], quality[y, left + k]
                    above_phase[k], above_quality[k] = phase[y - 1, left + k], quality[y - 1, left + k]
                    labels_here[k] = out_labels[y - 1, left + k]
                sure = 1
                for k in range(CELL_WIDTH):
                    difference = here_phase[k] - above_phase[k]
                    cycles = cycles_between(difference, rate_across)
                    departs = departure(difference, rate_across, cycles)
                    continues = (labels_here[k] >= 0) & surely_across(departs, here_quality[k], above_quality[k])
                    labels_here[k] += cycles
                    sure &= ti.cast(continues, ti.i32)
                for k in range(1, CELL_WIDTH):
                    difference = here_phase[k] - here_phase[k - 1]
                    cycles = cycles_between(difference, rate_along)
                    departs = departure(difference, rate_along, cycles)
                    agrees = labels_here[k] == labels_here[k - 1] + cycles
                    agrees &= surely_along(departs, here_quality[k], here_quality[k - 1])
                    sure &= ti.cast(agrees, ti.i32)
                if sure == 1:
                    patch = labels_here[0] >> ORDER_BITS
                    weight = CELL_WIDTH * brightness(here_quality[CELL_WIDTH // 2], mean_quality)
                    out_patches[PIXELS, patch] = out_patches[PIXELS, patch] + CELL_WIDTH
                    out_patches[WEIGHT, patch] = out_patches[WEIGHT, patch] + weight
                    for k in range(CELL_WIDTH):
                        out_labels[y, left + k] = labels_here[k]
                    x = right
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
                    # The run, whose orders count from its first pixel, and its contact with the runs above: each of
                    # its pixels votes for the label that the first one would get. Labels are written as the first
                    # sure vote has it, if the first pixel's is.
                    order, quality_before = 0, quality[y, x]
                    chosen, written, votes, voters = -1, 0, 0, 0
                    going = 1
                    while going == 1:
                        if y > top:
                            vote = vote_above(phase, quality, out_labels, y, x, order, rate_across)
                            if vote.x >= 0:
                                voters += 1
                                if chosen < 0 and vote.y == 1:
                                    chosen = vote.x
                                    if x == start:
                                        written = chosen
                                if vote.x == chosen:
                                    votes += vote.y
                        out_labels[y, x] = written + order
                        x += 1
                        going = 0
                        if x < right:
                            here = phase[y, x]
                            cycles = cycles_between(here - before, rate_along)
                            quality_here = quality[y, x]
                            # What is no phase departs by far more.
                            departs = departure(here - before, rate_along, cycles)
                            if surely_along(departs, quality_here, quality_before):
                                order += cycles
                                before, quality_before = here, quality_here
                                going = 1
                    if votes < voters:  # seldom: they disagree, or are not sure
                        for candidate in range(start + 1, x):
                            order = out_labels[y, candidate] - written
                            choice = vote_above(phase, quality, out_labels, y, candidate, order, rate_across)
                            tally = 0
                            for voter in range(candidate, x):
                                order = out_labels[y, voter] - written
                                vote = vote_above(phase, quality, out_labels, y, voter, order, rate_across)
                                if vote.x == choice.x:
                                    tally += vote.y
                            if choice.x >= 0 and tally > votes:
                                chosen, votes = choice.x, tally
                    # One pixel's word is too little for a run of several.
                    joins = votes > 0 and 2 * votes >= voters and (votes > 1 or x - start <= 2)
                    if not joins:
                        patch = patch_start + ti.min(patch_count, room - 1)
                        chosen = (patch << ORDER_BITS) + ORDER_ZERO
                        patch_count += 1
                        out_patches[PIXELS, patch] = 0
                        out_patches[WEIGHT, patch] = 0
                        out_patches[FIRST, patch] = y * width + start
                    patch = chosen >> ORDER_BITS
                    # Not "+=": that is atomic, and nobody else writes here.
                    weight = (x - start) * brightness(quality[y, (start + x) >> 1], mean_quality)
                    out_patches[PIXELS, patch] = out_patches[PIXELS, patch] + (x - start)
                    out_patches[WEIGHT, patch] = out_patches[WEIGHT, patch] + weight
                    if chosen != written:
                        for column in range(start, x):
                            out_labels[y, column] = out_labels[y, column] - written + chosen
                    # What the others voted for becomes contacts between patches.
                    if votes < voters or (voters > 0 and not joins):
                        for candidate in range(start, x):
                            order = out_labels[y, candidate] - chosen
                            choice = vote_above(phase, quality, out_labels, y, candidate, order, rate_across)
                            tally, noted = 0, 0
                            for voter in range(start, x):
                                order = out_labels[y, voter] - chosen
                                vote = vote_above(phase, quality, out_labels, y, voter, order, rate_across)
                                if vote.x == choice.x:
                                    difference = phase[y, voter] - phase[y - 1, voter]
                                    departs = departure(
                                        difference, rate_across, cycles_between(difference, rate_across)
                                    )
                                    above = quality[y - 1, voter]
                                    tally += 2 * vote_weight(departs, quality[y, voter], above, mean_quality)
                                    if voter < candidate:
                                        noted = 1
                            if choice.x >= 0 and choice.x >> ORDER_BITS != patch and noted == 0:
                                name = 3 * (y * width + candidate)
                                turn = (choice.x & ORDER_MASK) - (chosen & ORDER_MASK)
                                contact_count = add_contact(
                                    out_contacts,
                                    contact_start,
                                    contact_count,
                                    4 * room,
                                    choice.x >> ORDER_BITS,
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
                                turn = (label & ORDER_MASK) + cycles - (chosen & ORDER_MASK)
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
        out_counts[0, cell] = patch_count
        out_counts[1, cell] = contact_count
        out_counts[2, cell] = steps


@ti.kernel
def note_borders_kernel(
    phase: F32Array2,  # (H, W) rad; NO_PHASE outside the mask
    quality: F32Array2,  # (H, W)
    rates: F32Array2,  # last row: rate along, rate across (rad a px), mean quality
    draft_bits: i32,
    labels: I32Array2,  # (H, W)
    out_contacts: I32Array2,  # (5, 4 cells << bits)
    out_counts: I32Array2,  # (3, cells + 1); the second row counts on
):
    """Note where patches touch across the cells' right and bottom borders."""
    height, width = phase.shape[0], phase.shape[1]
    cells = ((width + CELL_WIDTH - 1) // CELL_WIDTH) * ((height + CELL_HEIGHT - 1) // CELL_HEIGHT)
    last = rates.shape[0] - 1
    room = 1 << draft_bits
    for cell in range(cells):
        rate_along, rate_across, mean_quality = rates[last, 0], rates[last, 1], rates[last, 2]
        contact_start, contact_count = cell << (draft_bits + 2), out_counts[1, cell]
        top, left, bottom, right = cell_bounds(cell, height, width)
        label, label2, shift, weight = (
            side_of_integers(0),
            side_of_integers(0),
            side_of_integers(0),
            side_of_integers(0),
        )
        difference, low, high = side_of_floats(0.0), side_of_floats(0.0), side_of_floats(0.0)
        for side in ti.static(range(2)):
            length, rate = bottom - top, rate_along
            if ti.static(side == 1):
                length, rate = right - left, rate_across
            if (side == 0 and right == width) or (side == 1 and bottom == height):
                length = 0
            # A pixel counts double on the shorter side, so that both are worth the same.
            scale = ti.static((1, CELL_HEIGHT // CELL_WIDTH)[side])
            for k in range(length):
                y, x = top + k, right - 1
                if ti.static(side == 1):
                    y, x = bottom - 1, left + k
                y2, x2 = y + side, x + 1 - side
                label[k], label2[k] = labels[y, x], labels[y2, x2]
                difference[k] = phase[y2, x2] - phase[y, x]
                low[k], high[k] = quality[y, x], quality[y2, x2]
            for k in range(CELL_HEIGHT):
                cycles = cycles_between(difference[k], rate)
                departs = departure(difference[k], rate, cycles)
                weight[k] = scale * vote_weight(departs, low[k], high[k], mean_quality)
                touches = ((label[k] | label2[k]) >= 0) & (departs <= MAX_DEPARTURE) & (k < length)
                shift[k] = (label[k] & ORDER_MASK) - (label2[k] & ORDER_MASK) + cycles
                label[k] = ti.select(touches, label[k] >> ORDER_BITS, -1)
                label2[k] = label2[k] >> ORDER_BITS
            # Neighbours that say the same make one contact.
            start, votes = 0, 0
            for k in range(length):
                votes += weight[k]
                following = ti.min(k + 1, length - 1)
                alike = (label[k] == label[following]) & (label2[k] == label2[following])
                if k == length - 1 or not (alike & (shift[k] == shift[following])):
                    if label[k] >= 0:
                        pixel = (top + start) * width + right - 1
                        if ti.static(side == 1):
                            pixel = (bottom - 1) * width + left + start
                        contact_count = add_contact(
                            out_contacts,
                            contact_start,
                            contact_count,
                            4 * room,
                            label[k],
                            label2[k],
                            shift[k],
                            votes,
                            3 * pixel + 1 + side,
                        )
                    start, votes = k + 1, 0
        out_counts[1, cell] = contact_count


@ti.kernel
def number_patches_kernel(
    cells: i32,
    firsts: I32Array2,  # (3, cells + 1) patches and contacts of each cell; becomes the number of each cell's first ones
    out_counters: I32Array1,
):
    ti.loop_config(serialize=True)
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
    serial: Static,  # whether one thread does it
    cells: i32,
    draft_bits: i32,
    draft_patches: I32Array2,  # (3, cells << bits)
    draft_contacts: I32Array2,  # (5, 4 cells << bits)
    firsts: I32Array2,  # (3, cells + 1)
    out_patches: I32Array2,  # (12, capacity) each a region of its own
    out_contacts: I32Array2,  # (5, capacity)
):
    ti.loop_config(serialize=serial)
    for cell in range(cells):
        for k in range(firsts[0, cell + 1] - firsts[0, cell]):
            draft, patch = (cell << draft_bits) + k, firsts[0, cell] + k
            out_patches[PIXELS, patch] = draft_patches[PIXELS, draft]
            out_patches[WEIGHT, patch] = draft_patches[WEIGHT, draft]
            out_patches[FIRST, patch] = draft_patches[FIRST, draft]
            out_patches[PARENT, patch] = patch
            out_patches[STEP, patch] = 0
            out_patches[HEAD, patch] = patch
            out_patches[TURN, patch] = 0
            out_patches[SUPPORT, patch] = 0
        for k in range(firsts[1, cell + 1] - firsts[1, cell]):
            draft, contact = (cell << (draft_bits + 2)) + k, firsts[1, cell] + k
            out_contacts[FROM, contact] = patch_number(draft_contacts[FROM, draft], firsts, draft_bits)
            out_contacts[TO, contact] = patch_number(draft_contacts[TO, draft], firsts, draft_bits)
            out_contacts[SHIFT, contact] = draft_contacts[SHIFT, draft]
            out_contacts[VOTES, contact] = draft_contacts[VOTES, draft]
            out_contacts[NAME, contact] = draft_contacts[NAME, draft]
