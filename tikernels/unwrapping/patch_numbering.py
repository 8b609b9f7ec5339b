"""Number the patches and contacts of all cells without gaps, in the order of the cells."""

from tikernels._taichi import I32Array1, I32Array2, Static, i32, ti
from tikernels.launching import kernel
from tikernels.unwrapping.tables import CONTACT_BITS, Cell, Contact, Counter, Patch, patch_number


@kernel
def number_patches_kernel(
    first: i32,  # cell to begin with,
    stop: i32,  # and the one to stop before
    cells: I32Array2,  # (3, cells + 1) counts of patches and contacts; become the numbers of each cell's first ones
    counters: I32Array1,  # (4,) see `Counter`; of the cells before the first one, if any
):
    """Add the counts of cells up, cell after cell."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        patches, contacts, crowded = 0, 0, 0
        if first > 0:
            patches, contacts = counters[Counter.PATCHES], counters[Counter.CONTACTS]
            crowded = counters[Counter.CROWDED]
        for cell in range(first, stop):
            patch_count, contact_count = cells[Cell.PATCHES, cell], cells[Cell.CONTACTS, cell]
            most = (1 << CONTACT_BITS) - 1
            crowded = ti.max(crowded, ti.max(patch_count, (contact_count + most) >> CONTACT_BITS))
            cells[Cell.PATCHES, cell] = patches
            cells[Cell.CONTACTS, cell] = contacts
            patches += patch_count
            contacts += contact_count
        if stop == cells.shape[1] - 1:
            cells[Cell.PATCHES, stop] = patches
            cells[Cell.CONTACTS, stop] = contacts
        counters[Counter.PATCHES] = patches
        counters[Counter.CONTACTS] = contacts
        counters[Counter.CROWDED] = crowded


@kernel
def collect_patches_kernel(
    serial: Static,  # whether one thread does it
    cell_total: i32,
    draft_bits: i32,
    draft_patches: I32Array2,  # (2, cells << bits)
    draft_contacts: I32Array2,  # (5, 4 cells << bits)
    cells: I32Array2,  # (3, cells + 1) see `Cell`; numbered
    out_patches: I32Array2,  # (11, capacity) see `Patch`; each a region of its own
    out_contacts: I32Array2,  # (5, capacity) see `Contact`
):
    """Copy the drafts of patches and contacts to the places that their numbers name."""
    ti.loop_config(serialize=serial)
    for cell in range(cell_total):
        for k in range(cells[Cell.PATCHES, cell + 1] - cells[Cell.PATCHES, cell]):
            draft, patch = (cell << draft_bits) + k, cells[Cell.PATCHES, cell] + k
            for row in ti.static((Patch.PIXELS, Patch.FIRST)):
                out_patches[row, patch] = draft_patches[row, draft]
            out_patches[Patch.PARENT, patch] = patch
            out_patches[Patch.PARENT_SHIFT, patch] = 0
            out_patches[Patch.HEAD, patch] = patch
            out_patches[Patch.HEAD_SHIFT, patch] = 0
            out_patches[Patch.SUPPORT, patch] = 0
        for k in range(cells[Cell.CONTACTS, cell + 1] - cells[Cell.CONTACTS, cell]):
            draft, contact = (cell << (draft_bits + CONTACT_BITS)) + k, cells[Cell.CONTACTS, cell] + k
            for row in ti.static((Contact.FROM, Contact.TO)):
                out_contacts[row, contact] = patch_number(draft_contacts[row, draft], cells, draft_bits)
            for row in ti.static((Contact.SHIFT, Contact.VOTES, Contact.NAME)):
                out_contacts[row, contact] = draft_contacts[row, draft]
