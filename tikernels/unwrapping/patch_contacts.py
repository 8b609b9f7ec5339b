"""Note where patches touch: inside a cell what a run's other pixels say, and across the borders of cells.

A contact joins two patches by what pixels on either side say of their orders, with the weight of these pixels' votes.
"""

from tikernels._taichi import F32Array2, I32Array2, Static, i32, ivec2, ivec4, ti, vec3
from tikernels.launching import kernel
from tikernels.phase.smoothing import MAX_DEPARTURE
from tikernels.unwrapping.continuity import cycles_and_departure, frame_rates, vote_above, vote_weight
from tikernels.unwrapping.tables import (
    CELL_HEIGHT,
    CELL_WIDTH,
    CONTACT_BITS,
    GOLDEN,
    ORDER_BITS,
    ORDER_MASK,
    Cell,
    Contact,
    cell_bounds,
    cell_count,
)

# A pixel on the shorter side of a cell counts double, so that both sides are worth the same.
_LOWER_SIDE = CELL_HEIGHT // CELL_WIDTH

side_of_floats = ti.types.vector(CELL_HEIGHT, ti.f32)
side_of_integers = ti.types.vector(CELL_HEIGHT, ti.i32)


@ti.func
def add_contact(
    contacts: I32Array2, places: ivec2, count: Static, a: i32, b: i32, shift: i32, votes: i32, place_name: i32
):
    """Note that OFFSET[b] = OFFSET[a] + shift, and count the contact.

    `places` is where the cell's contacts begin, and how many there may be; the name must be the contact's own.
    """
    place = places[0] + ti.min(count, places[1] - 1)
    contacts[Contact.FROM, place] = a
    contacts[Contact.TO, place] = b
    contacts[Contact.SHIFT, place] = shift
    contacts[Contact.VOTES, place] = votes
    contacts[Contact.NAME, place] = place_name * GOLDEN
    count += 1


@ti.func
def note_outvoted(
    phase: F32Array2,
    quality: F32Array2,
    usual: vec3,
    run: ivec4,  # row, first column, column past it, and the label that its orders count from
    labels: I32Array2,
    places: ivec2,
    contacts: I32Array2,
    count: Static,
):
    """Make contacts of the votes that a run has not followed, one for all that say the same."""
    y, start, stop, chosen = run[0], run[1], run[2], run[3]
    for candidate in range(start, stop):
        choice = vote_above(phase, quality, labels, y, candidate, labels[y, candidate] - chosen, usual[1])
        tally, noted = 0, 0
        for voter in range(start, stop):
            vote = vote_above(phase, quality, labels, y, voter, labels[y, voter] - chosen, usual[1])
            if vote.x == choice.x:
                difference = phase[y, voter] - phase[y - 1, voter]
                _, departs = cycles_and_departure(difference, usual[1])
                tally += _LOWER_SIDE * vote_weight(departs, quality[y, voter], quality[y - 1, voter], usual[2])
                if voter < candidate:
                    noted = 1
        other, patch = choice.x >> ORDER_BITS, chosen >> ORDER_BITS
        if choice.x >= 0 and other != patch and noted == 0:
            shift = (choice.x & ORDER_MASK) - (chosen & ORDER_MASK)
            add_contact(contacts, places, count, other, patch, shift, tally, 3 * (y * phase.shape[1] + candidate))


@ti.func
def note_run_before(
    phase: F32Array2,
    quality: F32Array2,
    usual: vec3,
    run: ivec4,  # row, first column, column past it, and the label that its orders count from
    labels: I32Array2,
    places: ivec2,
    contacts: I32Array2,
    count: Static,
):
    """Note a contact with the run before in the row, where it ended without a step."""
    y, start, chosen = run[0], run[1], run[3]
    label = labels[y, start - 1]
    if label >= 0:
        difference = phase[y, start] - phase[y, start - 1]
        cycles, departs = cycles_and_departure(difference, usual[0])
        other, patch = label >> ORDER_BITS, chosen >> ORDER_BITS
        if departs <= MAX_DEPARTURE and other != patch:
            shift = (label & ORDER_MASK) + cycles - (chosen & ORDER_MASK)
            tally = vote_weight(departs, quality[y, start], quality[y, start - 1], usual[2])
            add_contact(contacts, places, count, other, patch, shift, tally, 3 * (y * phase.shape[1] + start - 1) + 1)


@ti.func
def border_pixel(bounds: ivec4, side: i32, k: i32):
    """Return row and column of a pixel on a cell's right (0) or lower (1) side."""
    return ti.select(side == 1, bounds[2] - 1, bounds[0] + k), ti.select(side == 1, bounds[1] + k, bounds[3] - 1)


@ti.func
def note_side(
    phase: F32Array2,
    quality: F32Array2,
    usual: vec3,
    bounds: ivec4,
    side: i32,  # 0: the right one, 1: the lower one
    length: i32,
    labels: I32Array2,
    places: ivec2,
    contacts: I32Array2,
    count: Static,
):
    """Note the contacts across one side of a cell; neighbours that say the same make one."""
    label, label2 = side_of_integers(0), side_of_integers(0)
    shift, weight = side_of_integers(0), side_of_integers(0)
    difference, low, high = side_of_floats(0.0), side_of_floats(0.0), side_of_floats(0.0)
    for k in range(length):
        y, x = border_pixel(bounds, side, k)
        y2, x2 = y + side, x + 1 - side
        label[k], label2[k] = labels[y, x], labels[y2, x2]
        difference[k] = phase[y2, x2] - phase[y, x]
        low[k], high[k] = quality[y, x], quality[y2, x2]
    rate, worth = ti.select(side == 1, usual[1], usual[0]), ti.select(side == 1, _LOWER_SIDE, 1)
    for k in range(CELL_HEIGHT):
        cycles, departs = cycles_and_departure(difference[k], rate)
        weight[k] = worth * vote_weight(departs, low[k], high[k], usual[2])
        touches = ((label[k] | label2[k]) >= 0) & (departs <= MAX_DEPARTURE) & (k < length)
        shift[k] = (label[k] & ORDER_MASK) - (label2[k] & ORDER_MASK) + cycles
        label[k] = ti.select(touches, label[k] >> ORDER_BITS, -1)
        label2[k] = label2[k] >> ORDER_BITS
    start, votes = 0, 0
    for k in range(length):
        votes += weight[k]
        following = ti.min(k + 1, length - 1)
        alike = (label[k] == label[following]) & (label2[k] == label2[following])
        if k == length - 1 or not (alike & (shift[k] == shift[following])):
            if label[k] >= 0:
                y, x = border_pixel(bounds, side, start)
                name = 3 * (y * phase.shape[1] + x) + 1 + side
                add_contact(contacts, places, count, label[k], label2[k], shift[k], votes, name)
            start, votes = k + 1, 0


@kernel
def note_borders_kernel(
    phase: F32Array2,  # (H, W) rad; NO_PHASE outside the mask
    quality: F32Array2,  # (H, W)
    rates: F32Array2,  # see `frame_rates`
    draft_bits: i32,
    labels: I32Array2,  # (H, W)
    out_contacts: I32Array2,  # (5, 4 cells << bits) see `Contact`
    out_cells: I32Array2,  # (3, cells + 1) see `Cell`; the contacts are counted on
):
    """Note where patches touch across the cells' right and lower sides."""
    height, width = phase.shape[0], phase.shape[1]
    for cell in range(cell_count(height, width)):
        along, across, mean_quality = frame_rates(rates)
        usual = vec3(along, across, mean_quality)
        top, left, bottom, right = cell_bounds(cell, height, width)
        bounds = ivec4(top, left, bottom, right)
        places, count = ivec2(cell << draft_bits, 1 << draft_bits) << CONTACT_BITS, out_cells[Cell.CONTACTS, cell]
        for side in range(2):
            # Beyond the image's border there is nothing.
            length = ti.select(right < width, bottom - top, 0)
            if side == 1:
                length = ti.select(bottom < height, right - left, 0)
            note_side(phase, quality, usual, bounds, side, length, labels, places, out_contacts, count)
        out_cells[Cell.CONTACTS, cell] = count
