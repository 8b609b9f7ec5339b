"""Join patches to regions in rounds: every region joins along its best supported contact (O. Boruvka, 1926)."""

from tikernels._taichi import I32Array1, I32Array2, Static, i32, ti
from tikernels.unwrapping.patch_growing import (
    CHOICE,
    FROM,
    GOLDEN,
    HEAD,
    KEY,
    N_CONTACTS,
    N_MERGED,
    NAME,
    OFFSET,
    PARENT,
    ROOT,
    SHIFT,
    STEP,
    SUPPORT,
    TO,
    TURN,
    VOTES,
)

# Rows of the table that contacts are summed in.
_OWNER, _CONTACT, _SUM = range(3)


@ti.func
def table_place(contacts: I32Array2, e: i32, size: i32) -> i32:
    """Scatter what a contact joins, and the shift, over a table whose size is a power of two."""
    mixed = (contacts[FROM, e] * GOLDEN) ^ (contacts[TO, e] * 73244475) ^ (contacts[SHIFT, e] * 1540483477)
    mixed = (mixed ^ ((mixed >> 15) & 0x1FFFF)) * GOLDEN
    return (mixed ^ ((mixed >> 13) & 0x7FFFF)) & (size - 1)


@ti.kernel
def merge_patches_kernel(
    serial: Static,  # whether one thread does it
    sums: Static,  # whether contacts that agree on the shift have their votes added up
    contact_count: i32,
    patches: I32Array2,  # (12, capacity): whom the root of a region hangs under is written, the rest is scratch
    contacts: I32Array2,  # (5, capacity); the votes of spent contacts become 0
    table: I32Array2,  # (3, power of two) scratch
    counters: I32Array1,
):
    """One Boruvka round: every region joins along its best supported contact."""
    counters[N_MERGED] = 0
    if ti.static(sums):
        # Two regions may touch in many places: contacts that agree on the shift become one, with all their votes. Each
        # asks for a place in the table by what it joins; the smallest name gets it and takes the votes of its like.
        ti.loop_config(serialize=serial)
        for place in range(table.shape[1]):
            table[_OWNER, place] = 2147483647
            table[_SUM, place] = 0
    # A contact joins the roots of its regions, the smaller first.
    ti.loop_config(serialize=serial)
    for e in range(contact_count):
        votes = contacts[VOTES, e]
        if votes > 0:
            a, b, turn = contacts[FROM, e], contacts[TO, e], contacts[SHIFT, e]
            for end in ti.static((FROM, TO)):
                head, offset = contacts[end, e], 0
                while patches[PARENT, head] != head:
                    offset += patches[STEP, head]
                    head = patches[PARENT, head]
                patches[HEAD, contacts[end, e]] = head
                patches[TURN, contacts[end, e]] = offset
                if ti.static(end == FROM):
                    a, turn = head, turn + offset
                else:
                    b, turn = head, turn - offset
            if a > b:
                a, b, turn = b, a, -turn
            contacts[FROM, e], contacts[TO, e], contacts[SHIFT, e] = a, b, turn
            if a == b:
                contacts[VOTES, e] = 0
            else:
                for root in ti.static((a, b)):
                    patches[KEY, root] = 2147483647
                    patches[CHOICE, root] = 2147483647
                    if ti.static(not sums):
                        ti.atomic_max(patches[SUPPORT, root], votes)
                if ti.static(sums):
                    ti.atomic_min(table[_OWNER, table_place(contacts, e, table.shape[1])], contacts[NAME, e])
    if ti.static(sums):
        ti.loop_config(serialize=serial)
        for e in range(contact_count):
            if contacts[VOTES, e] > 0:
                place = table_place(contacts, e, table.shape[1])
                if table[_OWNER, place] == contacts[NAME, e]:
                    table[_CONTACT, place] = e
        ti.loop_config(serialize=serial)
        for e in range(contact_count):
            votes = contacts[VOTES, e]
            if votes > 0:
                place = table_place(contacts, e, table.shape[1])
                owner = table[_CONTACT, place]
                same = contacts[FROM, owner] == contacts[FROM, e] and contacts[TO, owner] == contacts[TO, e]
                if owner != e and same and contacts[SHIFT, owner] == contacts[SHIFT, e]:
                    ti.atomic_add(table[_SUM, place], votes)
                    contacts[VOTES, e] = 0
        ti.loop_config(serialize=serial)
        for e in range(contact_count):
            votes = contacts[VOTES, e]
            if votes > 0:
                place = table_place(contacts, e, table.shape[1])
                if table[_CONTACT, place] == e:
                    votes += table[_SUM, place]
                    contacts[VOTES, e] = votes
                ti.atomic_max(patches[SUPPORT, contacts[FROM, e]], votes)
                ti.atomic_max(patches[SUPPORT, contacts[TO, e]], votes)
        ti.loop_config(serialize=serial)
        for e in range(contact_count):
            votes = contacts[VOTES, e]
            if votes > 0:
                for end in ti.static((FROM, TO)):
                    if votes == patches[SUPPORT, contacts[end, e]]:
                        ti.atomic_min(patches[KEY, contacts[end, e]], contacts[NAME, e])
    # The best supported contact of each region; among equals the smallest name, or the first one.
    ti.loop_config(serialize=serial)
    for e in range(contact_count):
        votes = contacts[VOTES, e]
        if votes > 0:
            for end in ti.static((FROM, TO)):
                root = contacts[end, e]
                if votes == patches[SUPPORT, root]:
                    if ti.static(not sums):
                        ti.atomic_min(patches[CHOICE, root], e)
                    elif contacts[NAME, e] == patches[KEY, root]:
                        patches[CHOICE, root] = e
    # Hang each region under the one it chose; of two that chose the same contact the smaller stays a root.
    ti.loop_config(serialize=serial)
    for e in range(contact_count):
        if contacts[VOTES, e] > 0:
            a, b = contacts[FROM, e], contacts[TO, e]
            if patches[CHOICE, b] == e:
                patches[PARENT, b] = a
                patches[STEP, b] = contacts[SHIFT, e]
                counters[N_MERGED] = 1
            elif patches[CHOICE, a] == e:
                patches[PARENT, a] = b
                patches[STEP, a] = -contacts[SHIFT, e]
                counters[N_MERGED] = 1
            patches[SUPPORT, a] = 0
            patches[SUPPORT, b] = 0


@ti.kernel
def settle_patches_kernel(
    serial: Static,
    count: i32,
    patches: I32Array2,  # root and offset of every patch's region are written
):
    ti.loop_config(serialize=serial)
    for i in range(count):
        root, offset = patches[HEAD, i], patches[TURN, i]
        while patches[HEAD, root] != root:
            offset += patches[TURN, root]
            root = patches[HEAD, root]
        patches[ROOT, i] = root
        patches[OFFSET, i] = offset


@ti.kernel
def close_gaps_kernel(
    contact_count: i32,
    contacts: I32Array2,  # (5, capacity); those with votes move to the front, in order
    out_counters: I32Array1,
):
    ti.loop_config(serialize=True)
    for _ in range(1):
        kept = 0
        for e in range(contact_count):
            if contacts[VOTES, e] > 0:
                for row in ti.static(range(5)):
                    contacts[row, kept] = contacts[row, e]
                kept += 1
        out_counters[N_CONTACTS] = kept
