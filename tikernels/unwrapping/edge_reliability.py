"""How reliable the edges between neighbouring pixels are, for unwrapping along the most reliable ones.

A pixel is reliable where the phase bends little: its reliability is H^2 + V^2 + D1^2 + D2^2, the smaller the better,
with H the sum of the wrapped differences to the left and to the right neighbour, V, D1 and D2 the same up and down and
along the diagonals (M. Arevallilo Herraez et al., Applied Optics 41, 7437, 2002, doi:10.1364/AO.41.007437). An edge has
the sum of both its ends as its cost. Costs are integers, equal on every device.
"""

from tikernels._taichi import F32Array2, I32Array3, Static, f32, i32, ti
from tikernels.launching import kernel
from tikernels.phase.phase_vector import PI
from tikernels.phase.wrapped_phase import LEAST_NO_PHASE, LEAST_STEP_PHASE
from tikernels.strips import STRIP, strip_at, strip_count
from tikernels.unwrapping.continuity import frame_rates
from tikernels.unwrapping.tables import MOST, Edge

# Phases count in 2^15ths of a cycle, 0.2 mrad, whose squares fit an integer; costs in 2^28ths of a squared cycle.
_PHASE_BITS = 15
_UNIT = 2**_PHASE_BITS / (2.0 * PI)
_SPARE_BITS = 32 - _PHASE_BITS
#: More than any counted phase, less than what is none; and less than what stands for a pixel that saw two surfaces.
MISSING, TWO_SURFACES = int(LEAST_NO_PHASE * _UNIT), int(LEAST_STEP_PHASE * _UNIT)
# Where a neighbour is missing nothing tells how reliable a pixel is: it comes after all others.
_UNKNOWN = 2**29
#: The cost where there is no edge, or a step across it.
NO_EDGE = MOST
# Sides of a pixel; the opposite one differs in the last bit.
LEFTWARDS, RIGHTWARDS, UPWARDS, DOWNWARDS, NOWHERE = range(5)
_BAND = 16  # rows that one thread walks down


fringed_strip = ti.types.vector(STRIP + 4, ti.i32)


@ti.func
def counted(phase: f32) -> i32:
    """Return a phase (rad) in whole 2^15ths of a cycle."""
    return ti.cast(phase * _UNIT, i32)


@ti.func
def wrapped(difference: i32) -> i32:
    """Bring a difference of counted phases to half a cycle or less."""
    return (difference << _SPARE_BITS) >> _SPARE_BITS


@ti.func
def edge_cost(phase: i32, phase2: i32, reliability: i32, reliability2: i32, rate: i32, most: i32) -> i32:
    """Return how unreliable the step from a pixel to the next is; NO_EDGE across a step of the surface.

    Between two pixels of unknown reliability the more usual change is the better one.
    """
    departs = ti.abs(wrapped(phase2 - phase - rate))
    cost = reliability + reliability2 + ti.select(reliability + reliability2 == 2 * _UNKNOWN, departs, 0)
    return ti.select((departs > most) | (ti.max(phase, phase2) > MISSING), NO_EDGE, cost)


@ti.func
def cycles_to(phase: i32, phase2: i32, rate: i32) -> i32:
    """Whole cycles to add to a counted phase that it goes on from another one by the usual change."""
    difference = phase2 - phase
    return (wrapped(difference - rate) + rate - difference) >> _PHASE_BITS


@ti.func
def pixel_reliability(above: Static, here: Static, below: Static, k: i32) -> i32:
    """Return H^2 + V^2 + D1^2 + D2^2 of a pixel, the smaller the better, given three rows around it."""
    centre = here[k]
    h = wrapped(here[k - 1] - centre) + wrapped(here[k + 1] - centre)
    v = wrapped(above[k] - centre) + wrapped(below[k] - centre)
    d1 = wrapped(above[k - 1] - centre) + wrapped(below[k + 1] - centre)
    d2 = wrapped(above[k + 1] - centre) + wrapped(below[k - 1] - centre)
    value = (h * h >> 2) + (v * v >> 2) + (d1 * d1 >> 2) + (d2 * d2 >> 2)
    most_above = ti.max(ti.max(above[k - 1], above[k]), above[k + 1])
    most_here = ti.max(ti.max(here[k - 1], centre), here[k + 1])
    most_below = ti.max(ti.max(below[k - 1], below[k]), below[k + 1])
    missing = ti.max(ti.max(most_above, most_here), most_below) > MISSING
    return ti.select(missing, _UNKNOWN, ti.min(value, _UNKNOWN - 1))


@ti.func
def best_edge(
    highest: Static,
    row: Static,
    lower: Static,
    beside: Static,  # costs of the edges from the row's pixels to the right,
    upwards: Static,  # from the row above to them,
    downwards: Static,  # and from them to the row below
    along: i32,
    across: i32,
    k: i32,
) -> i32:
    """Return the side of a pixel's best edge, and above three bits the cycles from there to here.

    Equal ones go in the order in which edges are named: to the right before downwards.
    """
    cost, pixel = ti.min(ti.min(beside[k - 1], beside[k]), ti.min(upwards[k], downwards[k])), row[k]
    side, shift = DOWNWARDS, cycles_to(lower[k], pixel, -across)
    is_best = upwards[k] == cost
    side = ti.select(is_best, UPWARDS, side)
    shift = ti.select(is_best, cycles_to(highest[k], pixel, across), shift)
    is_best = beside[k] == cost
    side = ti.select(is_best, RIGHTWARDS, side)
    shift = ti.select(is_best, cycles_to(row[k + 1], pixel, -along), shift)
    is_best = beside[k - 1] == cost
    side = ti.select(is_best, LEFTWARDS, side)
    shift = ti.select(is_best, cycles_to(row[k - 1], pixel, along), shift)
    return ti.select(cost == NO_EDGE, NOWHERE, (shift << 3) + side)


@kernel
def weigh_edges_kernel(
    phase: F32Array2,  # (H, W) rad; NO_PHASE outside the mask
    rates: F32Array2,  # see `frame_rates`
    max_departure: f32,  # rad
    out_edges: I32Array3,  # (4, whole cells + 1) see `Edge`; from a row and a column before the image
):
    """Weigh all edges and find the best of every pixel."""
    height, width = phase.shape[0], phase.shape[1]
    padded_height, padded_width = out_edges.shape[1], out_edges.shape[2]
    for t in range((padded_height + _BAND - 1) // _BAND * strip_count(padded_width, STRIP)):
        # Rows and columns count from the padding.
        band, first, count = strip_at(t, padded_width, STRIP)
        top = band * _BAND
        rate_along, rate_across, _ = frame_rates(rates)
        along, across, most = counted(rate_along), counted(rate_across), counted(max_departure)
        highest, above, here = fringed_strip(0), fringed_strip(0), fringed_strip(0)
        below = fringed_strip(2 * MISSING)
        trust, trust_above = fringed_strip(0), fringed_strip(0)
        beside, upwards, downwards, best = fringed_strip(0), fringed_strip(0), fringed_strip(0), fringed_strip(0)
        start, stop = ti.max(3 - first, 0), ti.min(STRIP + 4, width - first + 3)
        for y in range(top - 3, ti.min(top + _BAND, padded_height) + 1):
            # The row below enters; reliabilities are known of this row, edges of the row above.
            for k in range(STRIP + 4):
                highest[k], above[k], here[k], below[k] = above[k], here[k], below[k], 2 * MISSING
                trust_above[k], upwards[k] = trust[k], downwards[k]
            if y >= 0 and y < height:
                for k in range(start, stop):
                    below[k] = counted(phase[y, first - 3 + k])
            for k in range(1, STRIP + 3):
                trust[k] = pixel_reliability(above, here, below, k)
            for k in range(1, STRIP + 2):
                pixel, reliability = above[k], trust_above[k]
                beside[k] = edge_cost(pixel, above[k + 1], reliability, trust_above[k + 1], along, most)
                downwards[k] = edge_cost(pixel, here[k], reliability, trust[k], across, most)
            for k in range(2, STRIP + 2):
                best[k] = best_edge(highest, above, here, beside, upwards, downwards, along, across, k)
            if y > top:
                for k in range(count):
                    out_edges[Edge.COUNTED, y - 1, first + k] = above[k + 2]
                    out_edges[Edge.RIGHT, y - 1, first + k] = beside[k + 2]
                    out_edges[Edge.DOWN, y - 1, first + k] = downwards[k + 2]
                    out_edges[Edge.BEST, y - 1, first + k] = best[k + 2]
