"""Grow patches along reliable edges: cell by cell the part of one spanning forest that a cell decides alone.

A pixel is reliable where the phase bends little: its reliability is H^2 + V^2 + D1^2 + D2^2, with H the wrapped
difference to the left neighbour less that from the right one, V, D1 and D2 the same up, down and along the diagonals
(M. Arevallilo Herraez et al., Applied Optics 41, 7437, 2002, doi:10.1364/AO.41.007437). An edge between neighbours has
the sum of both as its level, the smaller the better, and orders follow the spanning forest of the smallest sum of
levels. Herraez sorts all edges; but an edge belongs to the forest as soon as it is the best that leaves either of its
two ends (O. Boruvka, 1926). So every cell joins its pixels to patches for as long as a patch's best edge stays inside
the cell, and what is left, the best edge between every two patches that touch, are contacts like those of `patches.py`.

Levels are integers, equal on every device, and equal levels go by the edge's place: there is but one forest.
"""

from tikernels._taichi import F32Array2, I32Array2, I32Array3, f32, i32, ti
from tikernels.patches import (
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
from tikernels.phase_vector import PI, STRIP
from tikernels.wrapped_phase import NO_PHASE

# Phases count in 2^15ths of a cycle, 0.2 mrad, whose squares fit an integer; levels in 2^28ths of a squared cycle.
_PHASE_BITS = 15
_UNIT = 2**_PHASE_BITS / (2.0 * PI)
_SPARE_BITS = 32 - _PHASE_BITS
_MISSING = int(0.5 * NO_PHASE * _UNIT)  # more than any phase, less than none
# Where a neighbour is missing nothing tells how reliable a pixel is: it comes after all others.
_UNKNOWN = 2**29
_NO_EDGE = 2**31 - 1
_CELL_PIXELS = CELL_WIDTH * CELL_HEIGHT
# Planes of what is known of pixels and edges, and rows of what is known of patches: by which pixel and on which side
# their best edge leaves, the patch it leads to with the cycles that their orders differ by, and the same for the root.
_COUNTED, _RIGHT, _DOWN = range(3)
_EXIT, _PARENT, _STEP, _ROOT, _OFFSET = range(5)
_LEFTWARDS, _RIGHTWARDS, _UPWARDS, _DOWNWARDS = range(4)
_FRAMED = CELL_WIDTH + 1
_DOWN_FROM = 256  # a power of two beyond the pixels of a framed cell
_KNOWN = 64  # contacts of a cell that are found again
_BAND = 8  # rows that one thread walks down

strip_of_integers = ti.types.vector(STRIP, ti.i32)
fringed_strip_of_integers = ti.types.vector(STRIP + 3, ti.i32)
cell_of_integers = ti.types.vector(_CELL_PIXELS, ti.i32)
edges_of_integers = ti.types.vector(2 * _CELL_PIXELS + CELL_HEIGHT, ti.i32)
framed_cell_of_integers = ti.types.vector((CELL_HEIGHT + 1) * _FRAMED, ti.i32)
known_of_integers = ti.types.vector(_KNOWN, ti.i32)


@ti.func
def counted(phase: f32) -> i32:
    """Return a phase (rad) in whole 2^15ths of a cycle."""
    return ti.cast(phase * _UNIT, i32)


@ti.func
def wrapped(difference: i32) -> i32:
    """Bring a difference of counted phases to half a cycle or less."""
    return (difference << _SPARE_BITS) >> _SPARE_BITS


@ti.func
def edge_level(phase: i32, phase2: i32, reliability: i32, reliability2: i32, rate: i32, most: i32) -> i32:
    """Return how unreliable the step from a pixel to the next is; _NO_EDGE across a step of the surface.

    Between two pixels of unknown reliability the more usual change is the better one.
    """
    departs = ti.abs(wrapped(phase2 - phase - rate))
    level = reliability + reliability2 + ti.select(reliability + reliability2 == 2 * _UNKNOWN, departs, 0)
    return ti.select((departs > most) | (ti.max(phase, phase2) > _MISSING), _NO_EDGE, level)


@ti.func
def cycles_to(phase: i32, phase2: i32, rate: i32) -> i32:
    """Whole cycles to add to a counted phase that it goes on from another one by the usual change."""
    difference = phase2 - phase
    return (wrapped(difference - rate) + rate - difference) >> _PHASE_BITS


@ti.kernel
def weigh_edges_kernel(
    phase: F32Array2,  # (H, W) rad; NO_PHASE outside the mask
    rates: F32Array2,  # last row: rate along, rate across (rad a px), mean quality
    max_departure: f32,  # rad
    out_edges: I32Array3,  # (3, whole cells + 1) from a row and a column before the image: counted phase, levels of the
    # edges to the right and downwards, the smaller the better; _NO_EDGE: none
):
    height, width, last = phase.shape[0], phase.shape[1], rates.shape[0] - 1
    padded_height, padded_width = out_edges.shape[1], out_edges.shape[2]
    strips = (padded_width + STRIP - 1) // STRIP
    for t in range((padded_height + _BAND - 1) // _BAND * strips):
        # Pixels of the padded image; one less is a pixel of the image.
        top, first = (t // strips) * _BAND, (t % strips) * STRIP
        along, across, most = counted(rates[last, 0]), counted(rates[last, 1]), counted(max_departure)
        above, here = fringed_strip_of_integers(0), fringed_strip_of_integers(0)
        below = fringed_strip_of_integers(2 * _MISSING)
        trust, trust_above = fringed_strip_of_integers(0), fringed_strip_of_integers(0)
        to_right, downwards = strip_of_integers(0), strip_of_integers(0)
        start, stop = ti.max(2 - first, 0), ti.min(STRIP + 3, width - first + 2)
        count = ti.min(STRIP, padded_width - first)
        for y in range(top - 2, ti.min(top + _BAND, padded_height) + 1):
            # The row below enters; reliabilities are known of this row, edges of the row above.
            for k in range(STRIP + 3):
                above[k], here[k], below[k] = here[k], below[k], 2 * _MISSING
                trust_above[k] = trust[k]
            if y >= 0 and y < height:
                for k in range(start, stop):
                    below[k] = counted(phase[y, first - 2 + k])
            for k in range(1, STRIP + 2):
                centre = here[k]
                h = wrapped(here[k - 1] - centre) + wrapped(here[k + 1] - centre)
                v = wrapped(above[k] - centre) + wrapped(below[k] - centre)
                d1 = wrapped(above[k - 1] - centre) + wrapped(below[k + 1] - centre)
                d2 = wrapped(above[k + 1] - centre) + wrapped(below[k - 1] - centre)
                value = (h * h >> 2) + (v * v >> 2) + (d1 * d1 >> 2) + (d2 * d2 >> 2)
                value = ti.min(value, _UNKNOWN - 1)
                most_above = ti.max(ti.max(above[k - 1], above[k]), above[k + 1])
                most_here = ti.max(ti.max(here[k - 1], centre), here[k + 1])
                most_below = ti.max(ti.max(below[k - 1], below[k]), below[k + 1])
                missing = ti.max(ti.max(most_above, most_here), most_below) > _MISSING
                trust[k] = ti.select(missing, _UNKNOWN, value)
            if y > top:
                for k in range(STRIP):
                    pixel, pixel2, reliability = above[k + 1], above[k + 2], trust_above[k + 1]
                    to_right[k] = edge_level(pixel, pixel2, reliability, trust_above[k + 2], along, most)
                    downwards[k] = edge_level(pixel, here[k + 1], reliability, trust[k + 1], across, most)
                for k in range(count):
                    out_edges[_COUNTED, y - 1, first + k] = above[k + 1]
                    out_edges[_RIGHT, y - 1, first + k] = to_right[k]
                    out_edges[_DOWN, y - 1, first + k] = downwards[k]


@ti.func
def leave(level: i32, best: i32, label: i32, way: i32, trees: I32Array2):
    """Take this edge as the way out of its patch if it is the first of the best ones."""
    if level == best and level < _NO_EDGE:
        if trees[_EXIT, label >> ORDER_BITS] < 0:
            trees[_EXIT, label >> ORDER_BITS] = way


@ti.kernel
def grow_trees_kernel(
    edges: I32Array3,  # (3, whole cells + 1) counted phase and levels
    quality: F32Array2,  # (H, W)
    rates: F32Array2,  # last row: rate along, rate across (rad a px), mean quality
    draft_bits: i32,  # a cell has places for 2^bits patches and four times as many contacts
    out_labels: I32Array2,  # (H, W) patch and order inside it; NOTHING, or BETWEEN two surfaces
    out_patches: I32Array2,  # (3, cells << bits)
    out_trees: I32Array2,  # (5, cells << bits) the first row is written
    out_counts: I32Array2,  # (3, cells + 1) patches of each cell, contacts so far: none; 1 where pixels lie between
):
    """Join the pixels of each cell while the best edge of a patch stays inside the cell."""
    height, width = quality.shape[0], quality.shape[1]
    cells = ((width + CELL_WIDTH - 1) // CELL_WIDTH) * ((height + CELL_HEIGHT - 1) // CELL_HEIGHT)
    last = rates.shape[0] - 1
    room = 1 << draft_bits
    for cell in range(cells):
        along, across = counted(rates[last, 0]), counted(rates[last, 1])
        top, left, bottom, right = cell_bounds(cell, height, width)
        counts = cell_of_integers(0)
        to_left, to_right = cell_of_integers(0), cell_of_integers(0)
        upwards, downwards = cell_of_integers(0), cell_of_integers(0)
        away, parent, step = cell_of_integers(0), cell_of_integers(0), cell_of_integers(0)
        for i in range(CELL_HEIGHT):
            for k in range(CELL_WIDTH):
                counts[i * CELL_WIDTH + k] = edges[_COUNTED, top + i + 1, left + k + 1]
                to_left[i * CELL_WIDTH + k] = edges[_RIGHT, top + i + 1, left + k]
                to_right[i * CELL_WIDTH + k] = edges[_RIGHT, top + i + 1, left + k + 1]
                upwards[i * CELL_WIDTH + k] = edges[_DOWN, top + i, left + k + 1]
                downwards[i * CELL_WIDTH + k] = edges[_DOWN, top + i + 1, left + k + 1]
        # Every pixel chooses its best edge.
        for p in range(_CELL_PIXELS):
            column = p & (CELL_WIDTH - 1)
            leaves_left, leaves_right = column == 0, column == CELL_WIDTH - 1
            leaves_up, leaves_down = p < CELL_WIDTH, p >= _CELL_PIXELS - CELL_WIDTH
            best = ti.min(ti.min(to_left[p], to_right[p]), ti.min(upwards[p], downwards[p]))
            chosen = ti.select(leaves_down, p, p + CELL_WIDTH)
            chosen = ti.select(upwards[p] == best, ti.select(leaves_up, p, p - CELL_WIDTH), chosen)
            chosen = ti.select(to_right[p] == best, ti.select(leaves_right, p, p + 1), chosen)
            chosen = ti.select(to_left[p] == best, ti.select(leaves_left, p, p - 1), chosen)
            parent[p] = ti.select(best == _NO_EDGE, p, chosen)
            away[p] = ti.min(
                ti.min(ti.select(leaves_left, to_left[p], _NO_EDGE), ti.select(leaves_right, to_right[p], _NO_EDGE)),
                ti.min(ti.select(leaves_up, upwards[p], _NO_EDGE), ti.select(leaves_down, downwards[p], _NO_EDGE)),
            )
        for p in range(_CELL_PIXELS):
            other = parent[p]
            rate = ti.select(other == p - 1, along, -along)
            rate = ti.select(other == p - CELL_WIDTH, across, ti.select(other == p + CELL_WIDTH, -across, rate))
            step[p] = ti.select(other == p, 0, cycles_to(counts[other], counts[p], rate))
        # Of two that chose the same edge the first becomes the root.
        for p in range(_CELL_PIXELS):
            stays = (parent[parent[p]] == p) & (p < parent[p])
            parent[p] = ti.select(stays, p, parent[p])
            step[p] = ti.select(stays, 0, step[p])
        component, order, size = cell_of_integers(0), cell_of_integers(0), cell_of_integers(0)
        roots = cell_of_integers(0)
        root_count = 0
        for p in range(_CELL_PIXELS):
            root, total = parent[p], step[p]
            while parent[root] != root:
                total += step[root]
                root = parent[root]
            component[p] = root
            order[p] = total
            away[root] = ti.min(away[root], away[p])
            size[root] += 1
            roots[root_count] = p
            root_count += ti.cast(root == p, i32)
        # Further rounds, on what is not decided yet.
        open_edges, levels = edges_of_integers(0), edges_of_integers(0)
        edge_count = 0
        for p in range(_CELL_PIXELS - 1):
            level = to_right[p]
            a, b = component[p], component[p + 1]
            open_edges[edge_count] = p
            levels[edge_count] = level
            inside = (p & (CELL_WIDTH - 1)) != CELL_WIDTH - 1
            edge_count += ti.cast(inside & (a != b) & (level < ti.max(away[a], away[b])), i32)
        for p in range(_CELL_PIXELS - CELL_WIDTH):
            level = downwards[p]
            a, b = component[p], component[p + CELL_WIDTH]
            open_edges[edge_count] = p + _CELL_PIXELS
            levels[edge_count] = level
            edge_count += ti.cast((a != b) & (level < ti.max(away[a], away[b])), i32)
        root_of, offset = cell_of_integers(0), cell_of_integers(0)
        best_of, choice = cell_of_integers(0), cell_of_integers(0)
        for j in range(root_count):
            root_of[roots[j]] = roots[j]
        while edge_count > 0:
            for j in range(root_count):
                c = roots[j]
                best_of[c] = away[c]
                choice[c] = -1
                parent[c] = c
                step[c] = 0
            kept = 0
            for j in range(edge_count):
                e, level = open_edges[j], levels[j]
                p = e & (_CELL_PIXELS - 1)
                q = ti.select(e >= _CELL_PIXELS, p + CELL_WIDTH, p + 1)
                a, b = root_of[component[p]], root_of[component[q]]
                open_edges[kept] = e
                levels[kept] = level
                counts_still = (a != b) & (level < ti.max(away[a], away[b]))
                kept += ti.cast(counts_still, i32)
                if counts_still:
                    if level < best_of[a]:
                        best_of[a] = level
                        choice[a] = e
                    if level < best_of[b]:
                        best_of[b] = level
                        choice[b] = e
            edge_count = kept
            for j in range(root_count):
                c = roots[j]
                e = choice[c]
                if e >= 0:
                    p = e & (_CELL_PIXELS - 1)
                    q, rate = p + 1, along
                    if e >= _CELL_PIXELS:
                        q, rate = p + CELL_WIDTH, across
                    a, b = root_of[component[p]], root_of[component[q]]
                    shift = order[p] + offset[component[p]] - order[q] - offset[component[q]]
                    shift += cycles_to(counts[p], counts[q], rate)
                    if a == c:
                        a, shift = b, -shift
                    if choice[a] != e or c > a:
                        parent[c] = a
                        step[c] = shift
            for j in range(root_count):
                c = roots[j]
                root, total = root_of[c], offset[c]
                before = root
                while parent[root] != root:
                    total += step[root]
                    root = parent[root]
                root_of[c] = root
                offset[c] = total
                away[root] = ti.min(away[root], away[before])
        # Number the patches; from here on the choice of a root is its patch's label.
        patch_start, patch_count, steps = cell << draft_bits, 0, 0
        mean_quality = rates[last, 2]
        for j in range(root_count):
            choice[roots[j]] = -1
        for j in range(root_count):
            c = roots[j]
            root = root_of[c]
            if counts[c] > _MISSING:
                choice[c] = NOTHING
                if counts[c] > 3 * _MISSING:
                    choice[c] = BETWEEN
                    steps = 1
            else:
                if choice[root] < 0:
                    patch = patch_start + ti.min(patch_count, room - 1)
                    patch_count += 1
                    y, x = top + c // CELL_WIDTH, left + c % CELL_WIDTH
                    choice[root] = (patch << ORDER_BITS) + ORDER_ZERO
                    out_patches[PIXELS, patch] = 0
                    out_patches[WEIGHT, patch] = brightness(quality[y, x], mean_quality)
                    out_patches[FIRST, patch] = y * width + x
                patch = choice[root] >> ORDER_BITS
                out_patches[PIXELS, patch] = out_patches[PIXELS, patch] + size[c]
        for k in range(ti.min(patch_count, room)):
            patch = patch_start + k
            out_patches[WEIGHT, patch] = out_patches[WEIGHT, patch] * out_patches[PIXELS, patch]
            out_trees[_EXIT, patch] = -1
        for p in range(_CELL_PIXELS):
            component[p], offset[p] = root_of[component[p]], offset[component[p]]
        for p in range(_CELL_PIXELS):
            order[p] += choice[component[p]] + offset[p]
        for y in range(top, bottom):
            for x in range(left, right):
                out_labels[y, x] = order[(y - top) * CELL_WIDTH + x - left]
        # A patch leaves the cell by its best edge, of equal ones by the first; those to the right come before those
        # downwards. Where the patches had no room, the cell is done again and no exit is worth knowing.
        if patch_count <= room:
            for i in range(CELL_HEIGHT):
                for side in ti.static((_LEFTWARDS, _RIGHTWARDS)):
                    p = i * CELL_WIDTH + ti.static(CELL_WIDTH - 1 if side == _RIGHTWARDS else 0)
                    level = to_right[p] if ti.static(side == _RIGHTWARDS) else to_left[p]
                    leave(level, away[component[p]], order[p], 4 * ((top + i) * width + left + p % CELL_WIDTH) + side, out_trees)
            for side in ti.static((_UPWARDS, _DOWNWARDS)):
                for k in range(CELL_WIDTH):
                    p = k + ti.static(_CELL_PIXELS - CELL_WIDTH if side == _DOWNWARDS else 0)
                    level = downwards[p] if ti.static(side == _DOWNWARDS) else upwards[p]
                    leave(level, away[component[p]], order[p], 4 * ((top + p // CELL_WIDTH) * width + left + k) + side, out_trees)
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
    width, last = labels.shape[1], rates.shape[0] - 1
    for cell in range(cells):
        along, across = counted(rates[last, 0]), counted(rates[last, 1])
        for k in range(ti.min(counts[0, cell], 1 << draft_bits)):
            patch = (cell << draft_bits) + k
            parent, step = patch, 0
            way = trees[_EXIT, patch]
            if way >= 0:
                side, y, x = way & 3, (way >> 2) // width, (way >> 2) % width
                y2 = y + ti.cast(side == _DOWNWARDS, i32) - ti.cast(side == _UPWARDS, i32)
                x2 = x + ti.cast(side == _RIGHTWARDS, i32) - ti.cast(side == _LEFTWARDS, i32)
                other = labels[y2, x2] >> ORDER_BITS
                # Of two that leave by the same edge the first stays a root.
                back = 4 * (y2 * width + x2) + (side ^ 1)
                if trees[_EXIT, other] != back or patch > other:
                    parent = other
                    rate = (x2 - x) * along + (y2 - y) * across
                    phase, phase2 = edges[_COUNTED, y + 1, x + 1], edges[_COUNTED, y2 + 1, x2 + 1]
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
    edges: I32Array3,  # (3, whole cells + 1) counted phase and levels
    rates: F32Array2,  # last row: rate along, rate across (rad a px), mean quality
    draft_bits: i32,
    labels: I32Array2,  # (H, W)
    trees: I32Array2,  # (5, cells << bits)
    out_contacts: I32Array2,  # (5, 4 cells << bits)
    out_counts: I32Array2,  # (3, cells + 1) the second row is written; 1 in the third where orders contradict each other
):
    """Note the best edge between the trees of a cell, and to those of the cells to the right and below."""
    height, width = labels.shape[0], labels.shape[1]
    cells = ((width + CELL_WIDTH - 1) // CELL_WIDTH) * ((height + CELL_HEIGHT - 1) // CELL_HEIGHT)
    last = rates.shape[0] - 1
    room = 4 << draft_bits
    for cell in range(cells):
        along, across = counted(rates[last, 0]), counted(rates[last, 1])
        top, left, _, _ = cell_bounds(cell, height, width)
        # The cell with a column more to the right and a row more below.
        root, order, counts = framed_cell_of_integers(-1), framed_cell_of_integers(0), framed_cell_of_integers(0)
        to_right, downwards = framed_cell_of_integers(_NO_EDGE), framed_cell_of_integers(_NO_EDGE)
        for i in range(ti.min(CELL_HEIGHT + 1, height - top)):
            for k in range(ti.min(CELL_WIDTH + 1, width - left)):
                label = labels[top + i, left + k]
                if label >= 0:
                    root[i * _FRAMED + k] = trees[_ROOT, label >> ORDER_BITS]
                    order[i * _FRAMED + k] = (label & ORDER_MASK) + trees[_OFFSET, label >> ORDER_BITS]
        for i in range(CELL_HEIGHT):
            for k in range(CELL_WIDTH):
                counts[i * _FRAMED + k] = edges[_COUNTED, top + i + 1, left + k + 1]
                to_right[i * _FRAMED + k] = edges[_RIGHT, top + i + 1, left + k + 1]
                downwards[i * _FRAMED + k] = edges[_DOWN, top + i + 1, left + k + 1]
        for i in range(ti.min(CELL_HEIGHT, height - top)):
            if left + CELL_WIDTH < width:
                counts[i * _FRAMED + CELL_WIDTH] = edges[_COUNTED, top + i + 1, left + CELL_WIDTH + 1]
        if top + CELL_HEIGHT < height:
            for k in range(CELL_WIDTH):
                counts[CELL_HEIGHT * _FRAMED + k] = edges[_COUNTED, top + CELL_HEIGHT + 1, left + k + 1]
        turn_right, turn_down = framed_cell_of_integers(0), framed_cell_of_integers(0)
        steps = 0
        for p in range(CELL_HEIGHT * _FRAMED):
            turn_right[p] = order[p] - order[p + 1] + cycles_to(counts[p], counts[p + 1], along)
            turn_down[p] = order[p] - order[p + _FRAMED] + cycles_to(counts[p], counts[p + _FRAMED], across)
            right_here, down_here = to_right[p] < _NO_EDGE, downwards[p] < _NO_EDGE
            steps |= ti.cast(right_here & (root[p] == root[p + 1]) & (turn_right[p] != 0), i32)
            steps |= ti.cast(down_here & (root[p] == root[p + _FRAMED]) & (turn_down[p] != 0), i32)
        # What lies between two trees, downwards after all that lies to the right.
        between = edges_of_integers(0)
        count = 0
        for p in range(CELL_HEIGHT * _FRAMED):
            between[count] = p
            count += ti.cast((to_right[p] < _NO_EDGE) & (root[p] != root[p + 1]), i32)
        for p in range(CELL_HEIGHT * _FRAMED):
            between[count] = p + _DOWN_FROM
            count += ti.cast((downwards[p] < _NO_EDGE) & (root[p] != root[p + _FRAMED]), i32)
        # Of edges between the same trees the best is kept; which it was when they last met, a small table tells.
        # Where the table forgets, a contact is noted twice, which costs time but no more.
        known = known_of_integers(-1)
        start, noted = cell << (draft_bits + 2), 0
        for j in range(count):
            p = between[j] & (_DOWN_FROM - 1)
            down = between[j] >= _DOWN_FROM
            a, b = root[p], root[p + ti.select(down, _FRAMED, 1)]
            votes = _NO_EDGE - ti.select(down, downwards[p], to_right[p])
            turn = ti.select(down, turn_down[p], turn_right[p])
            if a > b:
                a, b, turn = b, a, -turn
            slot = (a * 7 + b) & (_KNOWN - 1)
            place = known[slot]
            same = 0
            if place >= 0:
                same = ti.cast((out_contacts[FROM, place] == a) & (out_contacts[TO, place] == b), i32)
            if same == 0:
                place = start + ti.min(noted, room - 1)
                known[slot] = place
                noted += 1
                out_contacts[FROM, place] = a
                out_contacts[TO, place] = b
                out_contacts[SHIFT, place] = turn
                out_contacts[VOTES, place] = votes
            else:
                steps |= ti.cast(out_contacts[SHIFT, place] != turn, i32)
                if votes > out_contacts[VOTES, place]:
                    out_contacts[SHIFT, place] = turn
                    out_contacts[VOTES, place] = votes
        out_counts[1, cell] = noted
        out_counts[2, cell] |= steps


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
