"""Grow patches along reliable edges: cell by cell the part of one spanning forest that a cell decides alone.

Orders follow the spanning forest of the most reliable edges (`edge_reliability.py`). M. Arevallilo Herraez et al.
(Applied Optics 41, 7437, 2002, doi:10.1364/AO.41.007437) sort all edges; but an edge belongs to the forest as soon as
it is the best of all that leave one of its ends (O. Boruvka, 1926, see `region_merging.py`). So every cell joins its
pixels to patches for as long as the best edge of a patch stays inside the cell. Then every patch is joined along its
best edge to a patch of a neighbouring cell, and what is left, the best edge between every two such trees that touch,
makes contacts (`tree_contacts.py`). Between equal costs the edge's place decides, so there is only one forest.

A cell's pixels count row by row. Every pixel has a link: in its lower bits the pixel that it hangs under, itself if it
is a root, and above them the cycles from there; so adding links adds cycles. An edge counts as the pixel to its left or
above it, plus the number of pixels in a cell if it leads downwards.
"""

from tikernels._taichi import F32Array2, I32Array2, I32Array3, Static, f32, i32, ivec2, ti
from tikernels.launching import kernel
from tikernels.unwrapping.continuity import brightness_weight, frame_rates
from tikernels.unwrapping.edge_reliability import (
    DOWNWARDS,
    LEFTWARDS,
    MISSING,
    NO_EDGE,
    NOWHERE,
    RIGHTWARDS,
    TWO_SURFACES,
    UPWARDS,
    counted,
    cycles_to,
)
from tikernels.unwrapping.tables import (
    BETWEEN,
    CELL_HEIGHT,
    CELL_WIDTH,
    NOTHING,
    ORDER_BITS,
    ORDER_ZERO,
    Cell,
    Edge,
    Patch,
    Tree,
    add_alone,
    cell_bounds,
    cell_count,
)

CELL_PIXELS = CELL_WIDTH * CELL_HEIGHT
ROW_BITS = CELL_WIDTH.bit_length() - 1
_LINK_BITS, _LINK_MASK = CELL_PIXELS.bit_length() - 1, CELL_PIXELS - 1

# Compiling takes time as the square of what such arrays hold together, so there are few.
cell_of_integers = ti.types.vector(CELL_PIXELS, ti.i32)
edges_of_integers = ti.types.vector(2 * CELL_PIXELS, ti.i32)


@ti.func
def to_root(link: Static, p: i32) -> i32:
    """Follow the links from a pixel to its root and return the link that leads there at once."""
    cycles, root = 0, p
    while link[root] & _LINK_MASK != root:
        cycles += link[root] >> _LINK_BITS
        root = link[root] & _LINK_MASK
    return (cycles << _LINK_BITS) + root


@ti.func
def root_of(link: Static, p: i32) -> i32:
    """Return the pixel that a pixel hangs under."""
    return link[p] & _LINK_MASK


@ti.func
def hang_by_best_edges(edges: I32Array3, top: i32, left: i32, link: Static):
    """Hang every pixel under the one to which its best edge leads, unless that lies in another cell."""
    for i in range(CELL_HEIGHT):
        for k in range(CELL_WIDTH):
            p, best = i * CELL_WIDTH + k, edges[Edge.BEST, top + i + 1, left + k + 1]
            side = best & 7
            out = ti.select(side == LEFTWARDS, k == 0, (side == RIGHTWARDS) & (k == CELL_WIDTH - 1))
            out |= ti.select(side == UPWARDS, i == 0, (side == DOWNWARDS) & (i == CELL_HEIGHT - 1))
            to = ti.select(side == LEFTWARDS, p - 1, p + 1)
            to = ti.select(side == UPWARDS, p - CELL_WIDTH, ti.select(side == DOWNWARDS, p + CELL_WIDTH, to))
            link[p] = ti.select(out | (side == NOWHERE), p, ((best >> 3) << _LINK_BITS) + to)
    # Of two that chose the same edge the first becomes the root.
    for p in range(CELL_PIXELS):
        other = root_of(link, p)
        link[p] = ti.select((p < other) & (root_of(link, other) == p), p, link[p])
    # Most are there after two jumps, which need no branches.
    for _ in range(2):
        for p in range(CELL_PIXELS):
            onward = link[root_of(link, p)]
            link[p] = (link[p] & ~_LINK_MASK) + onward
    for p in range(CELL_PIXELS):
        link[p] = to_root(link, p)


@ti.func
def find_ways_out(edges: I32Array3, top: i32, left: i32, link: Static, away: Static):
    """Find the cost of the best edge of every patch that leaves the cell."""
    for i in range(CELL_HEIGHT):
        a, b = root_of(link, i * CELL_WIDTH), root_of(link, i * CELL_WIDTH + CELL_WIDTH - 1)
        away[a] = ti.min(away[a], edges[Edge.RIGHT, top + i + 1, left])
        away[b] = ti.min(away[b], edges[Edge.RIGHT, top + i + 1, left + CELL_WIDTH])
    for k in range(CELL_WIDTH):
        a, b = root_of(link, k), root_of(link, CELL_PIXELS - CELL_WIDTH + k)
        away[a] = ti.min(away[a], edges[Edge.DOWN, top, left + k + 1])
        away[b] = ti.min(away[b], edges[Edge.DOWN, top + CELL_HEIGHT, left + k + 1])


@ti.func
def offer(e: i32, cost: i32, a: i32, b: i32, away: Static, least: Static, choice: Static) -> i32:
    """Offer an edge to the patches at its ends, in the order of the edges' names; return 1 if it is undecided."""
    undecided = (a != b) & (cost < ti.max(away[a], away[b]))
    cost_here = ti.select(undecided, cost, NO_EDGE)
    choice[a] = ti.select(cost_here < least[a], e, choice[a])
    choice[b] = ti.select(cost_here < least[b], e, choice[b])
    least[a], least[b] = ti.min(least[a], cost_here), ti.min(least[b], cost_here)
    return ti.cast(undecided, i32)


@ti.func
def offer_all(
    edges: I32Array3,
    top: i32,
    left: i32,
    link: Static,
    away: Static,
    least: Static,
    choice: Static,
    undecided: Static,
) -> i32:
    """Offer every edge inside the cell; collect those that are undecided, and return how many there are."""
    count = 0
    for i in range(CELL_HEIGHT):
        for k in range(CELL_WIDTH - 1):
            p, cost = i * CELL_WIDTH + k, edges[Edge.RIGHT, top + i + 1, left + k + 1]
            undecided[count] = p
            count += offer(p, cost, root_of(link, p), root_of(link, p + 1), away, least, choice)
    for i in range(CELL_HEIGHT - 1):
        for k in range(CELL_WIDTH):
            p, cost = i * CELL_WIDTH + k, edges[Edge.DOWN, top + i + 1, left + k + 1]
            e = p + CELL_PIXELS
            undecided[count] = e
            count += offer(e, cost, root_of(link, p), root_of(link, p + CELL_WIDTH), away, least, choice)
    return count


@ti.func
def offer_undecided(
    edges: I32Array3,
    top: i32,
    left: i32,
    link: Static,
    away: Static,
    least: Static,
    choice: Static,
    undecided: Static,
    count: i32,
) -> i32:
    """Offer the edges that were undecided; keep those that still are, and return how many there are."""
    kept = 0
    for j in range(count):
        e = undecided[j]
        p, down = e & _LINK_MASK, e >> _LINK_BITS
        cost = edges[Edge.RIGHT + down, top + (p >> ROW_BITS) + 1, left + (p & (CELL_WIDTH - 1)) + 1]
        a, b = root_of(link, p), root_of(link, p + ti.select(down == 1, CELL_WIDTH, 1))
        undecided[kept] = e
        kept += offer(e, cost, a, b, away, least, choice)
    return kept


@ti.func
def join_chosen(edges: I32Array3, rates: ivec2, top: i32, left: i32, link: Static, away: Static, choice: Static):
    """Join patches along the edges that they have chosen."""
    for c in range(CELL_PIXELS):
        e = choice[c]
        if e >= 0:
            p, down = e & _LINK_MASK, e >> _LINK_BITS
            a, b = to_root(link, p), to_root(link, p + ti.select(down == 1, CELL_WIDTH, 1))
            # The edge may be the choice of both ends.
            if a & _LINK_MASK != b & _LINK_MASK:
                y, x = top + (p >> ROW_BITS) + 1, left + (p & (CELL_WIDTH - 1)) + 1
                phase, phase2 = edges[Edge.COUNTED, y, x], edges[Edge.COUNTED, y + down, x + 1 - down]
                cycles = cycles_to(phase, phase2, ti.select(down == 1, rates[1], rates[0]))
                cycles += (a >> _LINK_BITS) - (b >> _LINK_BITS)
                a, b = a & _LINK_MASK, b & _LINK_MASK
                link[b] = (cycles << _LINK_BITS) + a
                away[a] = ti.min(away[a], away[b])
    for p in range(CELL_PIXELS):
        link[p] = to_root(link, p)


@ti.func
def draft_patches(
    edges: I32Array3,
    quality: F32Array2,
    mean_quality: f32,
    top: i32,
    left: i32,
    places: ivec2,  # where the cell's patches begin, and how many there may be
    link: Static,
    pixels: Static,  # scratch
    label: Static,  # of a root its patch's label is written
    out_patches: I32Array2,
    out_trees: I32Array2,
):
    """Make patches of the roots, in their order; return how many, and 1 if a pixel lies between surfaces."""
    patch_count, steps = 0, 0
    for p in range(CELL_PIXELS):
        pixels[p] = 0
    for p in range(CELL_PIXELS):
        add_alone(pixels[root_of(link, p)], 1)
    for p in range(CELL_PIXELS):
        if link[p] == p:
            y, x = top + (p >> ROW_BITS), left + (p & (CELL_WIDTH - 1))
            content = edges[Edge.COUNTED, y + 1, x + 1]
            label[p] = ti.select(content > TWO_SURFACES, BETWEEN, NOTHING)
            if content < MISSING:
                patch = places[0] + ti.min(patch_count, places[1] - 1)
                patch_count += 1
                label[p] = (patch << ORDER_BITS) + ORDER_ZERO
                out_patches[Patch.PIXELS, patch] = pixels[p]
                out_patches[Patch.WEIGHT, patch] = pixels[p] * brightness_weight(quality[y, x], mean_quality)
                out_patches[Patch.FIRST, patch] = y * quality.shape[1] + x
                out_trees[Tree.EXIT, patch] = -1
            elif content > TWO_SURFACES:
                steps = 1
    return patch_count, steps


@ti.func
def leave(cost: i32, best: i32, label: i32, way: i32, trees: I32Array2):
    """Take this edge as the way out of its patch if it is the first of the best ones."""
    if cost == best and cost < NO_EDGE:
        if trees[Tree.EXIT, label >> ORDER_BITS] < 0:
            trees[Tree.EXIT, label >> ORDER_BITS] = way


@ti.func
def note_exits(edges: I32Array3, top: i32, left: i32, away: Static, label: Static, out_trees: I32Array2):
    """Note where each patch leaves the cell: by its best edge, of equal ones the first, downward ones last."""
    for i in range(CELL_HEIGHT):
        for side in ti.static((LEFTWARDS, RIGHTWARDS)):
            k = ti.static(0 if side == LEFTWARDS else CELL_WIDTH - 1)
            cost = edges[Edge.RIGHT, top + i + 1, left + ti.static(0 if side == LEFTWARDS else CELL_WIDTH)]
            p = i * CELL_WIDTH + k
            leave(cost, away[p], label[p], (p << 2) + side, out_trees)
    for side in ti.static((UPWARDS, DOWNWARDS)):
        i = ti.static(0 if side == UPWARDS else CELL_HEIGHT - 1)
        for k in range(CELL_WIDTH):
            cost = edges[Edge.DOWN, top + ti.static(0 if side == UPWARDS else CELL_HEIGHT), left + k + 1]
            p = i * CELL_WIDTH + k
            leave(cost, away[p], label[p], (p << 2) + side, out_trees)


@kernel
def grow_trees_kernel(
    edges: I32Array3,  # (4, whole cells + 1) see `Edge`
    quality: F32Array2,  # (H, W)
    rates: F32Array2,  # see `frame_rates`
    draft_bits: i32,  # a cell has places for 2^bits patches and four times as many contacts
    out_labels: I32Array2,  # (H, W) patch and order inside it; NOTHING, or BETWEEN two surfaces
    out_patches: I32Array2,  # (3, cells << bits) see `Patch`
    out_trees: I32Array2,  # (5, cells << bits) see `Tree`; the exits are written
    out_cells: I32Array2,  # (3, cells + 1) see `Cell`; no contacts yet
):
    """Join the pixels of each cell while the best edge of a patch stays inside the cell."""
    height, width = quality.shape[0], quality.shape[1]
    for cell in range(cell_count(height, width)):
        along, across, mean_quality = frame_rates(rates)
        counted_rates = ivec2(counted(along), counted(across))
        top, left, bottom, right = cell_bounds(cell, height, width)
        link, away = cell_of_integers(0), cell_of_integers(NO_EDGE)
        hang_by_best_edges(edges, top, left, link)
        find_ways_out(edges, top, left, link, away)
        # Further rounds, over the edges that are not decided yet. A patch whose best edge leaves the cell is done.
        undecided = edges_of_integers(0)
        least, choice = cell_of_integers(0), cell_of_integers(0)
        for p in range(CELL_PIXELS):
            least[p], choice[p] = away[p], -1
        count = offer_all(edges, top, left, link, away, least, choice, undecided)
        while count > 0:
            join_chosen(edges, counted_rates, top, left, link, away, choice)
            for p in range(CELL_PIXELS):
                least[p], choice[p] = away[p], -1
            count = offer_undecided(edges, top, left, link, away, least, choice, undecided, count)
        # From here on the choice of a root is its patch's label, and `least` the cost at which a patch leaves.
        places = ivec2(cell << draft_bits, 1 << draft_bits)
        patch_count, steps = draft_patches(
            edges, quality, mean_quality, top, left, places, link, least, choice, out_patches, out_trees
        )
        for p in range(CELL_PIXELS):
            least[p] = away[root_of(link, p)]
            link[p] = choice[root_of(link, p)] + (link[p] >> _LINK_BITS)
        for y in range(top, bottom):
            for x in range(left, right):
                out_labels[y, x] = link[(y - top) * CELL_WIDTH + x - left]
        # Where the patches had no room, the cell is done again and no exit is worth knowing.
        if patch_count <= places[1]:
            note_exits(edges, top, left, least, link, out_trees)
        out_cells[Cell.PATCHES, cell] = patch_count
        out_cells[Cell.CONTACTS, cell] = 0
        out_cells[Cell.STEPS, cell] = steps
