"""Join the patches of reliable edges to trees, and note the best edge between every two trees that touch."""

from tikernels._taichi import F32Array2, I32Array2, I32Array3, Static, i32, ivec2, ivec4, ti
from tikernels.launching import kernel
from tikernels.unwrapping.continuity import frame_rates
from tikernels.unwrapping.edge_reliability import (
    DOWNWARDS,
    LEFTWARDS,
    NO_EDGE,
    RIGHTWARDS,
    UPWARDS,
    counted,
    cycles_to,
)
from tikernels.unwrapping.spanning_forest import ROW_BITS
from tikernels.unwrapping.tables import (
    CELL_HEIGHT,
    CELL_WIDTH,
    CONTACT_BITS,
    ORDER_BITS,
    ORDER_MASK,
    Cell,
    Contact,
    Edge,
    Patch,
    Tree,
    cell_bounds,
    cell_count,
    patch_number,
)

_KNOWN = 64  # contacts of a cell that are found again

framed_row = ti.types.vector(CELL_WIDTH + 1, ti.i32)
row_of_edges = ti.types.vector(2 * CELL_WIDTH, ti.i32)
known_of_integers = ti.types.vector(_KNOWN, ti.i32)


@ti.func
def tree_link(
    edges: I32Array3, rates: ivec2, labels: I32Array2, trees: I32Array2, patch: i32, top: i32, left: i32
) -> ivec2:
    """Return the patch where a patch's exit leads, and the cycles between their orders; itself if it is a root."""
    link = ivec2(patch, 0)
    way = trees[Tree.EXIT, patch]
    if way >= 0:
        side, p = way & 3, way >> 2
        y, x = top + (p >> ROW_BITS), left + (p & (CELL_WIDTH - 1))
        y2 = y + ti.cast(side == DOWNWARDS, i32) - ti.cast(side == UPWARDS, i32)
        x2 = x + ti.cast(side == RIGHTWARDS, i32) - ti.cast(side == LEFTWARDS, i32)
        other = labels[y2, x2] >> ORDER_BITS
        # Of two that leave by the same edge the first stays a root.
        back = ((((y2 & (CELL_HEIGHT - 1)) << ROW_BITS) + (x2 & (CELL_WIDTH - 1))) << 2) + (side ^ 1)
        if trees[Tree.EXIT, other] != back or patch > other:
            rate = (x2 - x) * rates[0] + (y2 - y) * rates[1]
            phase, phase2 = edges[Edge.COUNTED, y + 1, x + 1], edges[Edge.COUNTED, y2 + 1, x2 + 1]
            difference = (labels[y2, x2] & ORDER_MASK) - (labels[y, x] & ORDER_MASK)
            link = ivec2(other, difference - cycles_to(phase, phase2, rate))
    return link


@kernel
def join_trees_kernel(
    cell_total: i32,
    edges: I32Array3,  # (4, whole cells + 1) see `Edge`
    rates: F32Array2,  # see `frame_rates`
    draft_bits: i32,
    labels: I32Array2,  # (H, W)
    cells: I32Array2,  # (3, cells + 1) see `Cell`; counts of patches
    trees: I32Array2,  # (5, cells << bits) see `Tree`
):
    """Join every patch along its exit, and follow it to the root of its tree."""
    height, width = labels.shape[0], labels.shape[1]
    for cell in range(cell_total):
        along, across, _ = frame_rates(rates)
        counted_rates = ivec2(counted(along), counted(across))
        top, left, _, _ = cell_bounds(cell, height, width)
        for k in range(ti.min(cells[Cell.PATCHES, cell], 1 << draft_bits)):
            patch = (cell << draft_bits) + k
            link = tree_link(edges, counted_rates, labels, trees, patch, top, left)
            trees[Tree.PARENT, patch] = link[0]
            trees[Tree.PARENT_SHIFT, patch] = link[1]
    for cell in range(cell_total):
        for k in range(ti.min(cells[Cell.PATCHES, cell], 1 << draft_bits)):
            patch = (cell << draft_bits) + k
            root, offset = trees[Tree.PARENT, patch], trees[Tree.PARENT_SHIFT, patch]
            while trees[Tree.PARENT, root] != root:
                offset += trees[Tree.PARENT_SHIFT, root]
                root = trees[Tree.PARENT, root]
            trees[Tree.ROOT, patch] = root
            trees[Tree.ROOT_SHIFT, patch] = offset


@ti.func
def note_best_edge(edge: ivec4, places: ivec2, known: Static, noted: Static, contacts: I32Array2) -> i32:
    """Note an edge between two trees, or let it replace a worse one; return 1 if the two claim different orders.

    The edge is a tree, another one, the cycles between their orders, and votes. Which contact two trees had when they
    last met, a small table tells; where it forgets, a contact is noted twice, which costs time but changes nothing.
    """
    a, b, shift, votes, steps = edge[0], edge[1], edge[2], edge[3], 0
    if a > b:
        a, b, shift = b, a, -shift
    slot = (a * 7 + b) & (_KNOWN - 1)
    place = known[slot]
    same = 0
    if place >= 0:
        same = ti.cast((contacts[Contact.FROM, place] == a) & (contacts[Contact.TO, place] == b), i32)
    if same == 0:
        place = places[0] + ti.min(noted, places[1] - 1)
        known[slot] = place
        noted += 1
        contacts[Contact.FROM, place], contacts[Contact.TO, place] = a, b
        contacts[Contact.SHIFT, place], contacts[Contact.VOTES, place] = shift, votes
    else:
        steps |= ti.cast(contacts[Contact.SHIFT, place] != shift, i32)
        if votes > contacts[Contact.VOTES, place]:
            contacts[Contact.SHIFT, place], contacts[Contact.VOTES, place] = shift, votes
    return steps


@kernel
def note_contacts_kernel(
    edges: I32Array3,  # (4, whole cells + 1) see `Edge`
    rates: F32Array2,  # see `frame_rates`
    draft_bits: i32,
    labels: I32Array2,  # (H, W)
    trees: I32Array2,  # (5, cells << bits) see `Tree`
    out_contacts: I32Array2,  # (5, 4 cells << bits) see `Contact`; without names
    out_cells: I32Array2,  # (3, cells + 1) see `Cell`; the contacts are counted, and steps where orders contradict
):
    """Note the best edge between the trees of a cell, and to those of the cells to the right and below."""
    height, width = labels.shape[0], labels.shape[1]
    for cell in range(cell_count(height, width)):
        rate_along, rate_across, _ = frame_rates(rates)
        along, across = counted(rate_along), counted(rate_across)
        top, left, bottom, _ = cell_bounds(cell, height, width)
        # Two rows of the cell with a column more to the right.
        root, order, phase = framed_row(0), framed_row(0), framed_row(0)
        root_below, order_below, phase_below = framed_row(-1), framed_row(0), framed_row(0)
        cost, shift, other, between = row_of_edges(0), row_of_edges(0), row_of_edges(0), row_of_edges(0)
        known = known_of_integers(-1)
        places = ivec2(cell << draft_bits, 1 << draft_bits) << CONTACT_BITS
        noted, steps = 0, 0
        for y in range(top - 1, bottom):
            for k in range(CELL_WIDTH + 1):
                root[k], order[k], phase[k] = root_below[k], order_below[k], phase_below[k]
                root_below[k] = -1
            if y + 1 < height:
                for k in range(ti.min(CELL_WIDTH + 1, width - left)):
                    label = labels[y + 1, left + k]
                    patch = ti.max(label, 0) >> ORDER_BITS
                    root_below[k] = trees[Tree.ROOT, patch]
                    order_below[k] = (label & ORDER_MASK) + trees[Tree.ROOT_SHIFT, patch]
                    phase_below[k] = edges[Edge.COUNTED, y + 2, left + k + 1]
            if y >= top:
                for k in range(CELL_WIDTH):
                    cost[k] = edges[Edge.RIGHT, y + 1, left + k + 1]
                    shift[k] = order[k] - order[k + 1] + cycles_to(phase[k], phase[k + 1], along)
                    other[k] = root[k + 1]
                    cost[CELL_WIDTH + k] = edges[Edge.DOWN, y + 1, left + k + 1]
                    shift[CELL_WIDTH + k] = order[k] - order_below[k] + cycles_to(phase[k], phase_below[k], across)
                    other[CELL_WIDTH + k] = root_below[k]
                count = 0
                for k in range(2 * CELL_WIDTH):
                    exists, alike = cost[k] < NO_EDGE, other[k] == root[k & (CELL_WIDTH - 1)]
                    steps |= ti.cast(exists & alike & (shift[k] != 0), i32)
                    between[count] = k
                    count += ti.cast(exists & (not alike), i32)
                for j in range(count):
                    k = between[j]
                    edge = ivec4(root[k & (CELL_WIDTH - 1)], other[k], shift[k], NO_EDGE - cost[k])
                    steps |= note_best_edge(edge, places, known, noted, out_contacts)
        out_cells[Cell.CONTACTS, cell] = noted
        out_cells[Cell.STEPS, cell] = out_cells[Cell.STEPS, cell] | steps


@kernel
def root_trees_kernel(
    cell_total: i32,
    draft_bits: i32,
    trees: I32Array2,  # (5, cells << bits) see `Tree`
    cells: I32Array2,  # (3, cells + 1) see `Cell`; numbered
    patches: I32Array2,  # (12, capacity) see `Patch`; each a region of its own, becomes part of its tree's region
):
    """Hang every patch under the root of its tree."""
    for cell in range(cell_total):
        for k in range(cells[Cell.PATCHES, cell + 1] - cells[Cell.PATCHES, cell]):
            draft, patch = (cell << draft_bits) + k, cells[Cell.PATCHES, cell] + k
            patches[Patch.HEAD, patch] = patch_number(trees[Tree.ROOT, draft], cells, draft_bits)
            patches[Patch.HEAD_SHIFT, patch] = trees[Tree.ROOT_SHIFT, draft]
