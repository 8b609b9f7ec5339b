"""Grow patches along reliable edges: cell by cell the part of one spanning forest that a cell decides alone.

Orders follow the spanning forest of the most reliable edges (`reliability.py`). Herraez et al. sort all edges; but an
edge belongs to the forest as soon as it is the best of all that leave one of its ends (O. Boruvka, 1926). So every cell
joins its pixels to patches for as long as the best edge of a patch stays inside the cell. Then every patch is joined
along its best edge to a patch of a neighbouring cell, and what is left, the best edge between every two such trees that
touch, are contacts like those of `patches.py`. Equal levels go by the edge's place, so there is but one forest.
"""

from tikernels._taichi import F32Array2, I32Array2, I32Array3, Static, i32, ti
from tikernels.unwrapping.edge_reliability import (
    BEST,
    COUNTED,
    DOWN,
    DOWNWARDS,
    LEFTWARDS,
    MISSING,
    NO_EDGE,
    NOWHERE,
    RIGHT,
    RIGHTWARDS,
    UPWARDS,
    counted,
    cycles_to,
)
from tikernels.unwrapping.patch_growing import (
    BETWEEN,
    CELL_HEIGHT,
    CELL_WIDTH,
    FIRST,
    FROM,
    HEAD,
    NOTHING,
    ORDER_BITS,
    ORDER_MASK,
    ORDER_ZERO,
    PIXELS,
    SHIFT,
    TO,
    TURN,
    VOTES,
    WEIGHT,
    brightness,
    cell_bounds,
    patch_number,
)

# What is known of patches: by which pixel and on which side their best edge leaves, the patch where it leads to with
# the cycles between their orders, and the same for the root of all.
_EXIT, _PARENT, _STEP, _ROOT, _OFFSET = range(5)
_CELL_PIXELS = CELL_WIDTH * CELL_HEIGHT
_ROW_BITS = CELL_WIDTH.bit_length() - 1
_LINK_BITS, _LINK_MASK = _CELL_PIXELS.bit_length() - 1, _CELL_PIXELS - 1
_KNOWN = 64  # contacts of a cell that are found again

cell_of_integers = ti.types.vector(_CELL_PIXELS, ti.i32)
edges_of_integers = ti.types.vector(2 * _CELL_PIXELS, ti.i32)
framed_row = ti.types.vector(CELL_WIDTH + 1, ti.i32)
row_of_edges = ti.types.vector(2 * CELL_WIDTH, ti.i32)
known_of_integers = ti.types.vector(_KNOWN, ti.i32)


@ti.func
def to_root(link: Static, p: i32) -> i32:
    """Follow the links from a pixel to its root and return the link that leads there at once."""
    cycles, root = 0, p
    while link[root] & _LINK_MASK != root:
        cycles += link[root] >> _LINK_BITS
        root = link[root] & _LINK_MASK
    return (cycles << _LINK_BITS) + root


@ti.func
def offer(e: i32, level: i32, a: i32, b: i32, away: Static, least: Static, choice: Static) -> i32:
    """Offer an edge to the patches at its ends, in the order of the edges' names; return 1 if it is undecided."""
    undecided = (a != b) & (level < ti.max(away[a], away[b]))
    level_here = ti.select(undecided, level, NO_EDGE)
    choice[a] = ti.select(level_here < least[a], e, choice[a])
    choice[b] = ti.select(level_here < least[b], e, choice[b])
    least[a], least[b] = ti.min(least[a], level_here), ti.min(least[b], level_here)
    return ti.cast(undecided, i32)


@ti.func
def leave(level: i32, best: i32, label: i32, way: i32, trees: I32Array2):
    """Take this edge as the way out of its patch if it is the first of the best ones."""
    if level == best and level < NO_EDGE:
        if trees[_EXIT, label >> ORDER_BITS] < 0:
            trees[_EXIT, label >> ORDER_BITS] = way


@ti.kernel
def grow_trees_kernel(
    edges: I32Array3,  # (4, whole cells + 1)
    quality: F32Array2,  # (H, W)
    rates: F32Array2,  # last row: rate along, rate across (rad a px), mean quality
    draft_bits: i32,  # a cell has places for 2^bits patches and four times as many contacts
    out_labels: I32Array2,  # (H, W) patch and order inside it; NOTHING, or BETWEEN two surfaces
    out_patches: I32Array2,  # (3, cells << bits)
    out_trees: I32Array2,  # (5, cells << bits) the first row is written
    out_counts: I32Array2,  # (3, cells + 1) patches of each cell; nothing; 1 where it has a pixel between surfaces
):
    """Join the pixels of each cell while the best edge of a patch stays inside the cell."""
    height, width = quality.shape[0], quality.shape[1]
    cells = ((width + CELL_WIDTH - 1) // CELL_WIDTH) * ((height + CELL_HEIGHT - 1) // CELL_HEIGHT)
    last = rates.shape[0] - 1
    room = 1 << draft_bits
    for cell in range(cells):
        along, across = counted(rates[last, 0]), counted(rates[last, 1])
        top, left, bottom, right = cell_bounds(cell, height, width)
        # Every pixel hangs under the one to which its best edge leads, unless that lies in another cell. A link holds
        # the pixel in its lower bits and the cycles from there above them: adding links adds cycles. Compiling takes
        # time as the square of what such arrays hold together, so there are few.
        link = cell_of_integers(0)
        for i in range(CELL_HEIGHT):
            for k in range(CELL_WIDTH):
                p, best = i * CELL_WIDTH + k, edges[BEST, top + i + 1, left + k + 1]
                side = best & 7
                out = ti.select(side == LEFTWARDS, k == 0, (side == RIGHTWARDS) & (k == CELL_WIDTH - 1))
                out |= ti.select(side == UPWARDS, i == 0, (side == DOWNWARDS) & (i == CELL_HEIGHT - 1))
                to = ti.select(side == LEFTWARDS, p - 1, p + 1)
                to = ti.select(side == UPWARDS, p - CELL_WIDTH, ti.select(side == DOWNWARDS, p + CELL_WIDTH, to))
                link[p] = ti.select(out | (side == NOWHERE), p, ((best >> 3) << _LINK_BITS) + to)
        # Of two that chose the same edge the first becomes the root.
        for p in range(_CELL_PIXELS):
            other = link[p] & _LINK_MASK
            link[p] = ti.select((p < other) & (link[other] & _LINK_MASK == p), p, link[p])
        # Most are there after two jumps, which need no branches.
        for _ in range(2):
            for p in range(_CELL_PIXELS):
                onward = link[link[p] & _LINK_MASK]
                link[p] = (link[p] & ~_LINK_MASK) + onward
        for p in range(_CELL_PIXELS):
            link[p] = to_root(link, p)
        # The best edge of a patch that leaves the cell.
        away = cell_of_integers(NO_EDGE)
        for i in range(CELL_HEIGHT):
            a, b = link[i * CELL_WIDTH] & _LINK_MASK, link[i * CELL_WIDTH + CELL_WIDTH - 1] & _LINK_MASK
            away[a] = ti.min(away[a], edges[RIGHT, top + i + 1, left])
            away[b] = ti.min(away[b], edges[RIGHT, top + i + 1, left + CELL_WIDTH])
        for k in range(CELL_WIDTH):
            a, b = link[k] & _LINK_MASK, link[_CELL_PIXELS - CELL_WIDTH + k] & _LINK_MASK
            away[a] = ti.min(away[a], edges[DOWN, top, left + k + 1])
            away[b] = ti.min(away[b], edges[DOWN, top + CELL_HEIGHT, left + k + 1])
        # Further rounds, over the edges that are not decided yet. A patch whose best edge leaves the cell is done.
        undecided = edges_of_integers(0)
        least, choice = cell_of_integers(0), cell_of_integers(0)
        for p in range(_CELL_PIXELS):
            least[p], choice[p] = away[p], -1
        count = 0
        for i in range(CELL_HEIGHT):
            for k in range(CELL_WIDTH - 1):
                p, level = i * CELL_WIDTH + k, edges[RIGHT, top + i + 1, left + k + 1]
                undecided[count] = p
                count += offer(p, level, link[p] & _LINK_MASK, link[p + 1] & _LINK_MASK, away, least, choice)
        for i in range(CELL_HEIGHT - 1):
            for k in range(CELL_WIDTH):
                p, level = i * CELL_WIDTH + k, edges[DOWN, top + i + 1, left + k + 1]
                e = p + _CELL_PIXELS
                undecided[count] = e
                count += offer(e, level, link[p] & _LINK_MASK, link[p + CELL_WIDTH] & _LINK_MASK, away, least, choice)
        while count > 0:
            for c in range(_CELL_PIXELS):
                e = choice[c]
                if e >= 0:
                    p, down = e & _LINK_MASK, e >> _LINK_BITS
                    a, b = to_root(link, p), to_root(link, p + ti.select(down == 1, CELL_WIDTH, 1))
                    # The edge may be the choice of both ends.
                    if a & _LINK_MASK != b & _LINK_MASK:
                        y, x = top + (p >> _ROW_BITS) + 1, left + (p & (CELL_WIDTH - 1)) + 1
                        phase, phase2 = edges[COUNTED, y, x], edges[COUNTED, y + down, x + 1 - down]
                        cycles = cycles_to(phase, phase2, ti.select(down == 1, across, along))
                        cycles += (a >> _LINK_BITS) - (b >> _LINK_BITS)
                        a, b = a & _LINK_MASK, b & _LINK_MASK
                        link[b] = (cycles << _LINK_BITS) + a
                        away[a] = ti.min(away[a], away[b])
            for p in range(_CELL_PIXELS):
                link[p] = to_root(link, p)
            for p in range(_CELL_PIXELS):
                least[p], choice[p] = away[p], -1
            kept = 0
            for j in range(count):
                e = undecided[j]
                p, down = e & _LINK_MASK, e >> _LINK_BITS
                level = edges[RIGHT + down, top + (p >> _ROW_BITS) + 1, left + (p & (CELL_WIDTH - 1)) + 1]
                a, b = link[p] & _LINK_MASK, link[p + ti.select(down == 1, CELL_WIDTH, 1)] & _LINK_MASK
                undecided[kept] = e
                kept += offer(e, level, a, b, away, least, choice)
            count = kept
        # Number the patches in the order of their roots; from here on the choice of a root is its patch's label.
        patch_start, patch_count, steps = cell << draft_bits, 0, 0
        mean_quality = rates[last, 2]
        for p in range(_CELL_PIXELS):
            least[p] = 0
        for p in range(_CELL_PIXELS):
            root = link[p] & _LINK_MASK
            least[root] = least[root] + 1  # not "+=", which is atomic
        for p in range(_CELL_PIXELS):
            if link[p] == p:
                y, x = top + (p >> _ROW_BITS), left + (p & (CELL_WIDTH - 1))
                content = edges[COUNTED, y + 1, x + 1]
                choice[p] = ti.select(content > 3 * MISSING, BETWEEN, NOTHING)
                if content < MISSING:
                    patch = patch_start + ti.min(patch_count, room - 1)
                    patch_count += 1
                    choice[p] = (patch << ORDER_BITS) + ORDER_ZERO
                    out_patches[PIXELS, patch] = least[p]
                    out_patches[WEIGHT, patch] = least[p] * brightness(quality[y, x], mean_quality)
                    out_patches[FIRST, patch] = y * width + x
                    out_trees[_EXIT, patch] = -1
                elif content > 3 * MISSING:
                    steps = 1
        for p in range(_CELL_PIXELS):
            least[p] = away[link[p] & _LINK_MASK]
            link[p] = choice[link[p] & _LINK_MASK] + (link[p] >> _LINK_BITS)
        for y in range(top, bottom):
            for x in range(left, right):
                out_labels[y, x] = link[(y - top) * CELL_WIDTH + x - left]
        # A patch leaves the cell by its best edge, of equal ones by the first; those to the right come before those
        # downwards. Where the patches had no room, the cell is done again and no exit is worth knowing.
        if patch_count <= room:
            for i in range(CELL_HEIGHT):
                for side in ti.static((LEFTWARDS, RIGHTWARDS)):
                    k = ti.static(0 if side == LEFTWARDS else CELL_WIDTH - 1)
                    level = edges[RIGHT, top + i + 1, left + ti.static(0 if side == LEFTWARDS else CELL_WIDTH)]
                    p = i * CELL_WIDTH + k
                    leave(level, least[p], link[p], (p << 2) + side, out_trees)
            for side in ti.static((UPWARDS, DOWNWARDS)):
                i = ti.static(0 if side == UPWARDS else CELL_HEIGHT - 1)
                for k in range(CELL_WIDTH):
                    level = edges[DOWN, top + ti.static(0 if side == UPWARDS else CELL_HEIGHT), left + k + 1]
                    p = i * CELL_WIDTH + k
                    leave(level, least[p], link[p], (p << 2) + side, out_trees)
        out_counts[0, cell] = patch_count
        out_counts[1, cell] = 0
        out_counts[2, cell] = steps


@ti.kernel
def join_trees_kernel(
    cells: i32,
    edges: I32Array3,  # (3, whole cells + 1) counted phase and levels
    rates: F32Array2,  # last row: rate along, rate across (rad a px), mean quality
    draft_bits: i32,
    labels: I32Array2,  # (H, W)
    counts: I32Array2,  # (3, cells + 1) patches of each cell
    trees: I32Array2,  # (5, cells << bits)
):
    """Join every patch along its exit."""
    height, width, last = labels.shape[0], labels.shape[1], rates.shape[0] - 1
    for cell in range(cells):
        along, across = counted(rates[last, 0]), counted(rates[last, 1])
        top, left, _, _ = cell_bounds(cell, height, width)
        for k in range(ti.min(counts[0, cell], 1 << draft_bits)):
            patch = (cell << draft_bits) + k
            parent, step = patch, 0
            way = trees[_EXIT, patch]
            if way >= 0:
                side, p = way & 3, way >> 2
                y, x = top + (p >> _ROW_BITS), left + (p & (CELL_WIDTH - 1))
                y2 = y + ti.cast(side == DOWNWARDS, i32) - ti.cast(side == UPWARDS, i32)
                x2 = x + ti.cast(side == RIGHTWARDS, i32) - ti.cast(side == LEFTWARDS, i32)
                other = labels[y2, x2] >> ORDER_BITS
                # Of two that leave by the same edge the first stays a root.
                back = ((((y2 & (CELL_HEIGHT - 1)) << _ROW_BITS) + (x2 & (CELL_WIDTH - 1))) << 2) + (side ^ 1)
                if trees[_EXIT, other] != back or patch > other:
                    parent = other
                    rate = (x2 - x) * along + (y2 - y) * across
                    phase, phase2 = edges[COUNTED, y + 1, x + 1], edges[COUNTED, y2 + 1, x2 + 1]
                    step = (labels[y2, x2] & ORDER_MASK) - (labels[y, x] & ORDER_MASK) - cycles_to(phase, phase2, rate)
            trees[_PARENT, patch] = parent
            trees[_STEP, patch] = step
    for cell in range(cells):
        for k in range(ti.min(counts[0, cell], 1 << draft_bits)):
            patch = (cell << draft_bits) + k
            root, offset = trees[_PARENT, patch], trees[_STEP, patch]
            while trees[_PARENT, root] != root:
                offset += trees[_STEP, root]
                root = trees[_PARENT, root]
            trees[_ROOT, patch] = root
            trees[_OFFSET, patch] = offset


@ti.kernel
def note_contacts_kernel(
    edges: I32Array3,  # (4, whole cells + 1)
    rates: F32Array2,  # last row: rate along, rate across (rad a px), mean quality
    draft_bits: i32,
    labels: I32Array2,  # (H, W)
    trees: I32Array2,  # (5, cells << bits)
    out_contacts: I32Array2,  # (5, 4 cells << bits)
    out_counts: I32Array2,  # (3, cells + 1) second row written; 1 in the third where orders contradict each other
):
    """Note the best edge between the trees of a cell, and to those of the cells to the right and below."""
    height, width = labels.shape[0], labels.shape[1]
    cells = ((width + CELL_WIDTH - 1) // CELL_WIDTH) * ((height + CELL_HEIGHT - 1) // CELL_HEIGHT)
    last = rates.shape[0] - 1
    room = 4 << draft_bits
    for cell in range(cells):
        along, across = counted(rates[last, 0]), counted(rates[last, 1])
        top, left, bottom, _ = cell_bounds(cell, height, width)
        # Two rows of the cell with a column more to the right.
        root, order, phase = framed_row(0), framed_row(0), framed_row(0)
        root_below, order_below, phase_below = framed_row(-1), framed_row(0), framed_row(0)
        level, turn, other, between = row_of_edges(0), row_of_edges(0), row_of_edges(0), row_of_edges(0)
        # Of edges between the same trees the best is kept; which it was when they last met, a small table tells.
        # Where the table forgets, a contact is noted twice, which costs time but no more.
        known = known_of_integers(-1)
        start, noted, steps = cell << (draft_bits + 2), 0, 0
        for y in range(top - 1, bottom):
            for k in range(CELL_WIDTH + 1):
                root[k], order[k], phase[k] = root_below[k], order_below[k], phase_below[k]
                root_below[k] = -1
            if y + 1 < height:
                for k in range(ti.min(CELL_WIDTH + 1, width - left)):
                    label = labels[y + 1, left + k]
                    patch = ti.max(label, 0) >> ORDER_BITS
                    root_below[k] = trees[_ROOT, patch]
                    order_below[k] = (label & ORDER_MASK) + trees[_OFFSET, patch]
                    phase_below[k] = edges[COUNTED, y + 2, left + k + 1]
            if y >= top:
                for k in range(CELL_WIDTH):
                    level[k] = edges[RIGHT, y + 1, left + k + 1]
                    turn[k] = order[k] - order[k + 1] + cycles_to(phase[k], phase[k + 1], along)
                    other[k] = root[k + 1]
                    level[CELL_WIDTH + k] = edges[DOWN, y + 1, left + k + 1]
                    turn[CELL_WIDTH + k] = order[k] - order_below[k] + cycles_to(phase[k], phase_below[k], across)
                    other[CELL_WIDTH + k] = root_below[k]
                count = 0
                for k in range(2 * CELL_WIDTH):
                    exists, alike = level[k] < NO_EDGE, other[k] == root[k & (CELL_WIDTH - 1)]
                    steps |= ti.cast(exists & alike & (turn[k] != 0), i32)
                    between[count] = k
                    count += ti.cast(exists & (not alike), i32)
                for j in range(count):
                    k = between[j]
                    a, b, shift, votes = root[k & (CELL_WIDTH - 1)], other[k], turn[k], NO_EDGE - level[k]
                    if a > b:
                        a, b, shift = b, a, -shift
                    slot = (a * 7 + b) & (_KNOWN - 1)
                    place = known[slot]
                    same = 0
                    if place >= 0:
                        same = ti.cast((out_contacts[FROM, place] == a) & (out_contacts[TO, place] == b), i32)
                    if same == 0:
                        place = start + ti.min(noted, room - 1)
                        known[slot] = place
                        noted += 1
                        out_contacts[FROM, place], out_contacts[TO, place] = a, b
                        out_contacts[SHIFT, place], out_contacts[VOTES, place] = shift, votes
                    else:
                        steps |= ti.cast(out_contacts[SHIFT, place] != shift, i32)
                        if votes > out_contacts[VOTES, place]:
                            out_contacts[SHIFT, place], out_contacts[VOTES, place] = shift, votes
        out_counts[1, cell] = noted
        out_counts[2, cell] = out_counts[2, cell] | steps


@ti.kernel
def root_trees_kernel(
    cells: i32,
    draft_bits: i32,
    trees: I32Array2,  # (5, cells << bits)
    firsts: I32Array2,  # (3, cells + 1)
    patches: I32Array2,  # (12, capacity) each a region of its own; becomes part of its tree's region
):
    for cell in range(cells):
        for k in range(firsts[0, cell + 1] - firsts[0, cell]):
            draft, patch = (cell << draft_bits) + k, firsts[0, cell] + k
            patches[HEAD, patch] = patch_number(trees[_ROOT, draft], firsts, draft_bits)
            patches[TURN, patch] = trees[_OFFSET, draft]
