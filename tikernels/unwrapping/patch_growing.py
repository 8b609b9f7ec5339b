"""Grow patches of row runs that surely belong together, cell by cell.

Along a stripe the phase changes least, so each row falls into unambiguous runs, and a run joins the run above by a vote
over their whole contact (sections 4.1 and 4.2 of Je, Lee and Park 2004). Every cell does so on its own; where two of
its patches touch, they note a contact with its votes (`patch_contacts.py`).
"""

from tikernels._taichi import F32Array2, I32Array2, Static, f32, i32, ivec2, ivec4, ti, vec3
from tikernels.launching import kernel
from tikernels.phase.wrapped_phase import LEAST_STEP_PHASE, has_phase
from tikernels.unwrapping.continuity import (
    cycles_and_departure,
    frame_rates,
    surely_across,
    surely_along,
    vote_above,
)
from tikernels.unwrapping.patch_contacts import note_outvoted, note_run_before
from tikernels.unwrapping.tables import (
    BETWEEN,
    CELL_WIDTH,
    CONTACT_BITS,
    NOTHING,
    ORDER_BITS,
    ORDER_ZERO,
    Cell,
    Patch,
    add_alone,
    cell_bounds,
    cell_count,
)

row_of_floats = ti.types.vector(CELL_WIDTH, ti.f32)
row_of_integers = ti.types.vector(CELL_WIDTH, ti.i32)


@ti.func
def continue_row(
    phase: F32Array2,
    quality: F32Array2,
    usual: vec3,
    y: i32,
    left: i32,
    out_labels: I32Array2,
    out_patches: I32Array2,
) -> i32:
    """Join a cell's whole row to the patch above if its every pixel agrees; return 1 where it is done.

    Nearly every row does. Eight pixels are worked on at once; `grow_run` would give the same, only slower.
    """
    here_phase, above_phase = row_of_floats(0.0), row_of_floats(0.0)
    here_quality, above_quality = row_of_floats(0.0), row_of_floats(0.0)
    labels = row_of_integers(0)
    for k in range(CELL_WIDTH):
        here_phase[k], here_quality[k] = phase[y, left + k], quality[y, left + k]
        above_phase[k], above_quality[k] = phase[y - 1, left + k], quality[y - 1, left + k]
        labels[k] = out_labels[y - 1, left + k]
    sure = 1
    for k in range(CELL_WIDTH):
        difference = here_phase[k] - above_phase[k]
        cycles, departs = cycles_and_departure(difference, usual[1])
        continues = (labels[k] >= 0) & surely_across(departs, here_quality[k], above_quality[k])
        labels[k] += cycles
        sure &= ti.cast(continues, ti.i32)
    for k in range(1, CELL_WIDTH):
        difference = here_phase[k] - here_phase[k - 1]
        cycles, departs = cycles_and_departure(difference, usual[0])
        agrees = labels[k] == labels[k - 1] + cycles
        agrees &= surely_along(departs, here_quality[k], here_quality[k - 1])
        sure &= ti.cast(agrees, ti.i32)
    if sure == 1:
        patch = labels[0] >> ORDER_BITS
        add_alone(out_patches[Patch.PIXELS, patch], CELL_WIDTH)
        for k in range(CELL_WIDTH):
            out_labels[y, left + k] = labels[k]
    return sure


@ti.func
def follow_run(
    phase: F32Array2,
    quality: F32Array2,
    usual: vec3,
    y: i32,
    start: i32,
    bounds: ivec4,
    out_labels: I32Array2,
):
    """Follow a run from its first pixel to where it no longer surely goes on, and let its pixels vote.

    Orders count from the run's first pixel. Each pixel votes for the label that the first one would get. Labels are
    written as the first sure vote has it, if that is the first pixel's.

    Returns the column past the run, what the first sure vote is for and what the labels count from, how many votes that
    has, and how many pixels have voted at all.
    """
    x, going = start, 1
    before, quality_before = phase[y, start], quality[y, start]
    order, chosen, written, votes, voters = 0, -1, 0, 0, 0
    while going == 1:
        if y > bounds[0]:
            vote = vote_above(phase, quality, out_labels, y, x, order, usual[1])
            if vote.x >= 0:
                voters += 1
                first_sure = (chosen < 0) & (vote.y == 1)
                chosen = ti.select(first_sure, vote.x, chosen)
                written = ti.select(first_sure & (x == start), vote.x, written)
                votes += ti.select(vote.x == chosen, vote.y, 0)
        out_labels[y, x] = written + order
        x += 1
        going = 0
        if x < bounds[3]:
            here = phase[y, x]
            cycles, departs = cycles_and_departure(here - before, usual[0])
            quality_here = quality[y, x]
            if surely_along(departs, quality_here, quality_before):
                order += cycles
                before, quality_before = here, quality_here
                going = 1
    return x, chosen, written, votes, voters


@ti.func
def count_again(
    phase: F32Array2,
    quality: F32Array2,
    rate: f32,
    y: i32,
    start: i32,
    stop: i32,
    written: i32,
    labels: I32Array2,
    first_choice: i32,
    first_votes: i32,
):
    """Choose what most pixels of a run surely vote for, and count: seldom needed, where they disagree or are unsure."""
    chosen, votes = first_choice, first_votes
    for candidate in range(start + 1, stop):
        choice = vote_above(phase, quality, labels, y, candidate, labels[y, candidate] - written, rate)
        tally = 0
        for voter in range(candidate, stop):
            vote = vote_above(phase, quality, labels, y, voter, labels[y, voter] - written, rate)
            if vote.x == choice.x:
                tally += vote.y
        if choice.x >= 0 and tally > votes:
            chosen, votes = choice.x, tally
    return chosen, votes


@ti.func
def grow_run(
    phase: F32Array2,
    quality: F32Array2,
    usual: vec3,
    bounds: ivec4,
    y: i32,
    start: i32,
    patch_places: ivec2,
    contact_places: ivec2,
    out_labels: I32Array2,
    out_patches: I32Array2,
    out_contacts: I32Array2,
    patch_count: Static,
    contact_count: Static,
) -> i32:
    """Join the run that begins here to the patch above, or begin a patch; return the column past it.

    What its other pixels say, and where it touches the run before, is noted as contacts.
    """
    stop, chosen, written, votes, voters = follow_run(phase, quality, usual, y, start, bounds, out_labels)
    if votes < voters:
        chosen, votes = count_again(phase, quality, usual[1], y, start, stop, written, out_labels, chosen, votes)
    # One pixel's vote is too little for a run of several.
    joins = votes > 0 and 2 * votes >= voters and (votes > 1 or stop - start <= 2)
    if not joins:
        patch = patch_places[0] + ti.min(patch_count, patch_places[1] - 1)
        chosen = (patch << ORDER_BITS) + ORDER_ZERO
        patch_count += 1
        out_patches[Patch.PIXELS, patch] = 0
        out_patches[Patch.FIRST, patch] = y * phase.shape[1] + start
    patch = chosen >> ORDER_BITS
    add_alone(out_patches[Patch.PIXELS, patch], stop - start)
    if chosen != written:
        for x in range(start, stop):
            add_alone(out_labels[y, x], chosen - written)
    run = ivec4(y, start, stop, chosen)
    if votes < voters or (voters > 0 and not joins):
        note_outvoted(phase, quality, usual, run, out_labels, contact_places, out_contacts, contact_count)
    if start > bounds[1]:
        note_run_before(phase, quality, usual, run, out_labels, contact_places, out_contacts, contact_count)
    return stop


@kernel
def grow_patches_kernel(
    phase: F32Array2,  # (H, W) rad; NO_PHASE outside the mask
    quality: F32Array2,  # (H, W)
    rates: F32Array2,  # see `frame_rates`
    draft_bits: i32,  # a cell has places for 2^bits patches and four times as many contacts
    out_labels: I32Array2,  # (H, W) patch and order inside it; NOTHING, or BETWEEN two surfaces
    out_patches: I32Array2,  # (2, cells << bits) see `Patch`
    out_contacts: I32Array2,  # (5, 4 cells << bits) see `Contact`
    out_cells: I32Array2,  # (3, cells + 1) see `Cell`
):
    """Grow the patches of each cell and note where two of them touch inside it."""
    height, width = phase.shape[0], phase.shape[1]
    for cell in range(cell_count(height, width)):
        along, across, mean_quality = frame_rates(rates)
        usual = vec3(along, across, mean_quality)
        top, left, bottom, right = cell_bounds(cell, height, width)
        bounds = ivec4(top, left, bottom, right)
        # Where they begin, and how many there may be.
        patch_places = ivec2(cell << draft_bits, 1 << draft_bits)
        contact_places = patch_places << CONTACT_BITS
        patch_count, contact_count, steps = 0, 0, 0
        for y in range(top, bottom):
            x = left
            if y > top and right - left == CELL_WIDTH:
                if continue_row(phase, quality, usual, y, left, out_labels, out_patches) == 1:
                    x = right
            while x < right:
                if has_phase(phase[y, x]):
                    x = grow_run(
                        phase, quality, usual, bounds, y, x, patch_places, contact_places,
                        out_labels, out_patches, out_contacts, patch_count, contact_count,
                    )  # fmt: skip
                else:
                    between = phase[y, x] > LEAST_STEP_PHASE
                    out_labels[y, x] = ti.select(between, BETWEEN, NOTHING)
                    steps |= ti.cast(between, i32)
                    x += 1
        out_cells[Cell.PATCHES, cell] = patch_count
        out_cells[Cell.CONTACTS, cell] = contact_count
        out_cells[Cell.STEPS, cell] = steps
