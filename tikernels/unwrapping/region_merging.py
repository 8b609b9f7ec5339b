"""Join patches to regions in rounds: every region joins along its best supported contact.

That is O. Boruvka's way to a spanning forest (O jistem problemu minimalnim, Prace moravske prirodovedecke spolecnosti
3, 37, 1926): the best contact that leaves a region belongs to the forest, so all regions may join at once. Between
equal ones the contacts' names decide, which are the same on every device.
"""

from tikernels._taichi import I32Array1, I32Array2, Static, i32, ti
from tikernels.launching import kernel
from tikernels.unwrapping.tables import GOLDEN, MOST, Contact, Counter, Match, Patch


@ti.func
def table_place(contacts: I32Array2, e: i32, size: i32) -> i32:
    """Scatter what a contact joins, and the shift, over a table whose size is a power of two."""
    mixed = contacts[Contact.FROM, e] * GOLDEN
    mixed = mixed ^ (contacts[Contact.TO, e] * 73244475) ^ (contacts[Contact.SHIFT, e] * 1540483477)
    mixed = (mixed ^ ((mixed >> 15) & 0x1FFFF)) * GOLDEN
    return (mixed ^ ((mixed >> 13) & 0x7FFFF)) & (size - 1)


@ti.func
def same_claim(contacts: I32Array2, e: i32, e2: i32) -> i32:
    """Return whether two contacts join the same regions by the same shift."""
    same = 1
    for row in ti.static((Contact.FROM, Contact.TO, Contact.SHIFT)):
        same &= ti.cast(contacts[row, e] == contacts[row, e2], i32)
    return same


@ti.func
def find_root(patches: I32Array2, patch: i32):
    """Follow a patch to the root of its region; return it and the cycles between their orders."""
    root, cycles = patch, 0
    while patches[Patch.PARENT, root] != root:
        cycles += patches[Patch.PARENT_SHIFT, root]
        root = patches[Patch.PARENT, root]
    return root, cycles


@ti.func
def lift_contact(patches: I32Array2, contacts: I32Array2, e: i32) -> i32:
    """Let a contact join the roots of its regions, the smaller first; return its votes, 0 inside a region."""
    votes = contacts[Contact.VOTES, e]
    if votes > 0:
        a, b, shift = contacts[Contact.FROM, e], contacts[Contact.TO, e], contacts[Contact.SHIFT, e]
        root_a, cycles_a = find_root(patches, a)
        patches[Patch.HEAD, a] = root_a
        patches[Patch.HEAD_SHIFT, a] = cycles_a
        root_b, cycles_b = find_root(patches, b)
        patches[Patch.HEAD, b] = root_b
        patches[Patch.HEAD_SHIFT, b] = cycles_b
        shift += cycles_a - cycles_b
        if root_a > root_b:
            root_a, root_b, shift = root_b, root_a, -shift
        contacts[Contact.FROM, e], contacts[Contact.TO, e], contacts[Contact.SHIFT, e] = root_a, root_b, shift
        if root_a == root_b:
            votes = 0
            contacts[Contact.VOTES, e] = 0
        else:
            for row in ti.static((Patch.KEY, Patch.CHOICE)):
                patches[row, root_a] = MOST
                patches[row, root_b] = MOST
    return votes


@ti.func
def hand_votes_over(contacts: I32Array2, e: i32, table: I32Array2):
    """Give a contact's votes to the one that stands for all that claim the same, unless it does so itself."""
    votes = contacts[Contact.VOTES, e]
    if votes > 0:
        place = table_place(contacts, e, table.shape[1])
        owner = table[Match.CONTACT, place]
        if owner != e and same_claim(contacts, e, owner):
            ti.atomic_add(table[Match.VOTES, place], votes)
            contacts[Contact.VOTES, e] = 0


@ti.func
def take_votes(contacts: I32Array2, e: i32, table: I32Array2) -> i32:
    """Return a contact's votes, with those that were passed to it."""
    votes = contacts[Contact.VOTES, e]
    if votes > 0:
        place = table_place(contacts, e, table.shape[1])
        if table[Match.CONTACT, place] == e:
            votes += table[Match.VOTES, place]
            contacts[Contact.VOTES, e] = votes
    return votes


@ti.func
def offer_name(patches: I32Array2, contacts: I32Array2, e: i32):
    """Offer a contact's name to the regions whose best it is: the smallest is taken."""
    votes = contacts[Contact.VOTES, e]
    if votes > 0:
        for end in ti.static((Contact.FROM, Contact.TO)):
            if votes == patches[Patch.SUPPORT, contacts[end, e]]:
                ti.atomic_min(patches[Patch.KEY, contacts[end, e]], contacts[Contact.NAME, e])


@ti.func
def support(patches: I32Array2, contacts: I32Array2, e: i32, votes: i32):
    """Offer a contact's votes to both its regions: the most are kept."""
    for end in ti.static((Contact.FROM, Contact.TO)):
        ti.atomic_max(patches[Patch.SUPPORT, contacts[end, e]], votes)


@ti.func
def choose_contact(patches: I32Array2, contacts: I32Array2, e: i32):
    """Let both regions choose a contact if it is their best; among equals the smallest name."""
    votes = contacts[Contact.VOTES, e]
    if votes > 0:
        for end in ti.static((Contact.FROM, Contact.TO)):
            root = contacts[end, e]
            if votes == patches[Patch.SUPPORT, root] and contacts[Contact.NAME, e] == patches[Patch.KEY, root]:
                ti.atomic_min(patches[Patch.CHOICE, root], e)


@ti.func
def join_regions(patches: I32Array2, contacts: I32Array2, e: i32, counters: I32Array1):
    """Hang a region under the other one of the contact that it chose; if both chose it, the smaller stays a root."""
    if contacts[Contact.VOTES, e] > 0:
        a, b = contacts[Contact.FROM, e], contacts[Contact.TO, e]
        if patches[Patch.CHOICE, b] == e:
            patches[Patch.PARENT, b] = a
            patches[Patch.PARENT_SHIFT, b] = contacts[Contact.SHIFT, e]
            counters[Counter.MERGED] = 1
        elif patches[Patch.CHOICE, a] == e:
            patches[Patch.PARENT, a] = b
            patches[Patch.PARENT_SHIFT, a] = -contacts[Contact.SHIFT, e]
            counters[Counter.MERGED] = 1
        patches[Patch.SUPPORT, a] = 0
        patches[Patch.SUPPORT, b] = 0


@kernel
def merge_patches_kernel(
    serial: Static,  # whether one thread does it
    contact_count: i32,
    patches: I32Array2,  # (11, capacity) see `Patch`: parents of roots are written, the rest is scratch
    contacts: I32Array2,  # (5, capacity) see `Contact`; the votes of spent contacts become 0
    table: I32Array2,  # (3, power of two) see `Match`; scratch
    counters: I32Array1,  # (4,) see `Counter`
):
    """One Boruvka round: every region joins along its best supported contact.

    Two regions may touch in many places, and contacts that claim the same have their votes added up: each requests a
    place in the table by what it claims; the smallest name gets the place, and the votes of all others that claim the
    same.
    """
    counters[Counter.MERGED] = 0
    ti.loop_config(serialize=serial)
    for place in range(table.shape[1]):
        table[Match.NAME, place] = MOST
        table[Match.VOTES, place] = 0
    ti.loop_config(serialize=serial)
    for e in range(contact_count):
        if lift_contact(patches, contacts, e) > 0:
            place = table_place(contacts, e, table.shape[1])
            ti.atomic_min(table[Match.NAME, place], contacts[Contact.NAME, e])
    ti.loop_config(serialize=serial)
    for e in range(contact_count):
        if contacts[Contact.VOTES, e] > 0:
            place = table_place(contacts, e, table.shape[1])
            if table[Match.NAME, place] == contacts[Contact.NAME, e]:
                table[Match.CONTACT, place] = e
    ti.loop_config(serialize=serial)
    for e in range(contact_count):
        hand_votes_over(contacts, e, table)
    ti.loop_config(serialize=serial)
    for e in range(contact_count):
        votes = take_votes(contacts, e, table)
        if votes > 0:
            support(patches, contacts, e, votes)
    ti.loop_config(serialize=serial)
    for e in range(contact_count):
        offer_name(patches, contacts, e)
    ti.loop_config(serialize=serial)
    for e in range(contact_count):
        choose_contact(patches, contacts, e)
    ti.loop_config(serialize=serial)
    for e in range(contact_count):
        join_regions(patches, contacts, e, counters)


@kernel
def settle_patches_kernel(
    serial: Static,  # whether one thread does it
    count: i32,
    patches: I32Array2,  # (11, capacity) see `Patch`: root and offset are written
):
    """Follow every patch to the root of its region."""
    ti.loop_config(serialize=serial)
    for i in range(count):
        root, offset = patches[Patch.HEAD, i], patches[Patch.HEAD_SHIFT, i]
        while patches[Patch.HEAD, root] != root:
            offset += patches[Patch.HEAD_SHIFT, root]
            root = patches[Patch.HEAD, root]
        patches[Patch.ROOT, i] = root
        patches[Patch.OFFSET, i] = offset


@kernel
def close_gaps_kernel(
    contact_count: i32,
    contacts: I32Array2,  # (5, capacity) see `Contact`; those with votes move to the front, in order
    out_counters: I32Array1,  # (4,) their number is written
):
    """Drop spent contacts."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        kept = 0
        for e in range(contact_count):
            if contacts[Contact.VOTES, e] > 0:
                for row in ti.static(range(5)):
                    contacts[row, kept] = contacts[row, e]
                kept += 1
        out_counters[Counter.CONTACTS] = kept
