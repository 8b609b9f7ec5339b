"""Correct the phase of places whose modulation is not the usual one, or changes, as a code makes it.

Response and blur bend the phase by what the modulation is. Where the order of a cycle is absolute, its modulation is
the code's, so what is to be added depends on the absolute phase, and on the place along the stripe if the code changes
there. It comes before the phase is smoothed along the stripe.
"""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from tikernels import checks
from tikernels._taichi import (
    F32Array1,
    F32Array2,
    F32Array3,
    I32Array1,
    I32Array2,
    f32,
    i32,
    mat5,
    ti,
    vec2,
    vec3,
    vec4,
    vec5,
)
from tikernels.arrays import F32, I32
from tikernels.lanes import (
    Lanes,
    as_lanes,
    lane_count,
    lanes_at,
    load_lanes,
    planes,
    put_back,
    store_lanes,
    whole_rows,
    width_of,
)
from tikernels.launching import kernel
from tikernels.phase.phase_vector import PI
from tikernels.strips import STRIP, strip_at, strip_count

#: Places a cycle at which the code's ripples are tabled.
TABLED = 20
#: Terms of the columns along the stripe are known at nodes this many px apart, as a strip is long.
NODE_PX = STRIP
#: Of the frame's pixels every sixteenth column is enough, and every fourth row, another one from column to column.
EVERY_COLUMN, EVERY_ROW = 16, 4


class CodeRipples(NamedTuple):
    """Changes that a code makes, by absolute phase and place along the stripe, and the part that bends the phase."""

    table: npt.NDArray[np.float32]
    """(N, places, 3) TABLED a cycle, from the first cycle's middle on: the contrast's deviation from the usual one, as
    a fraction of it; the slope of the modulation's logarithm, a cycle; what the balance's window passes of it."""
    within: npt.NDArray[np.float32]
    """(2, bins + 1) rad over a cycle from -pi on: what of the correction goes with the contrast, and its square."""
    shares: npt.NDArray[np.float32]
    """(3,) of the correction by contrast, and rad to add for the other two."""
    columns: npt.NDArray[np.float32]
    """(h, w, 4) at nodes NODE_PX apart: terms of a polynomial of the order, which gives the column along the stripe in
    repeats of the code."""


@ti.func
def tabled(within: F32Array2, cycles: f32) -> vec2:
    """Interpolate the two rows of a table over a cycle, which begins half a cycle before its middle."""
    last = within.shape[1] - 1
    place = (cycles + 0.5 - ti.floor(cycles + 0.5)) * last
    below = ti.min(ti.cast(place, ti.i32), last - 1)
    low, high = vec2(within[0, below], within[1, below]), vec2(within[0, below + 1], within[1, below + 1])
    return low + (place - below) * (high - low)


@ti.func
def ripples_at(table: F32Array3, terms: vec4, cycles: f32) -> vec3:
    """Interpolate a code's ripples at an absolute phase in cycles, in a column with these terms."""
    last, places = table.shape[0] - 1, table.shape[1]
    place = ti.min(ti.max(cycles * TABLED, 0.0), ti.cast(last, ti.f32))
    below, column = ti.min(ti.cast(place, ti.i32), last - 1), 0
    if places > 1:
        along = terms[0] + cycles * (terms[1] + cycles * (terms[2] + cycles * terms[3]))
        # Not a number where a ray meets the pattern nowhere.
        column = ti.max(ti.min(ti.cast((along - ti.floor(along)) * places, ti.i32), places - 1), 0)
    ripples = vec3(0.0)
    for k in ti.static(range(3)):
        low, high = table[below, column, k], table[below + 1, column, k]
        ripples[k] = low + (place - below) * (high - low)
    return ripples


@ti.func
def node_terms(columns: F32Array3, row: i32, down: f32, column: i32) -> vec4:
    """Return a column's terms at a node, between two rows of them."""
    terms = vec4(0.0)
    for k in ti.static(range(4)):
        terms[k] = columns[row, column, k] + down * (columns[row + 1, column, k] - columns[row, column, k])
    return terms


@ti.func
def bending_at(table: F32Array3, within: F32Array2, terms: vec4, unwrapped: f32) -> vec3:
    """Return how much there is of each ripple at an absolute phase, rad, of a column with these terms."""
    cycles = unwrapped * (0.5 / PI)
    ripples, of_contrast = ripples_at(table, terms, cycles), tabled(within, cycles)
    return vec3(ripples[0] * (of_contrast[0] + (2.0 + ripples[0]) * of_contrast[1]), ripples[1], ripples[2])


@kernel
def measure_bends_kernel(
    phase: F32Array2,  # (H, W) rad
    unwrapped: F32Array2,  # (H, W) rad
    region: I32Array2,  # (H, W) region's number from 1; 0 outside
    absolute: I32Array1,  # (regions + 1,) 1 where the orders are absolute
    table: F32Array3,  # (N, places, 3)
    within: F32Array2,  # (2, bins + 1) rad
    columns: F32Array3,  # (h, w, 4)
    half: i32,  # of a cycle, rows
    most: f32,  # by how much a surface that is even bends at most, rad
    out_moments: F32Array3,  # (H, 5, 5) of 1, what the phase bends, and the ripples
):
    """Sum up how the phase bends, and the ripples, from half a cycle above a pixel to half a cycle below it."""
    height, width = phase.shape[0], phase.shape[1]
    for row in range(height):
        moments = mat5(0.0)
        for n in range((width + EVERY_COLUMN - 1) // EVERY_COLUMN):
            x, above, below = n * EVERY_COLUMN, ti.max(row - half, 0), ti.min(row + half, height - 1)
            number = region[row, x]
            alike = region[above, x] == number and region[below, x] == number and below - above == 2 * half
            if (row + n) % EVERY_ROW == 0 and alike and absolute[number] == 1:
                bend, bending = 0.0, vec3(0.0)
                for k in range(-1, 2):
                    y, counts = row + k * half, 1.0 - 3.0 * (k == 0)
                    down, right = (y % NODE_PX) / NODE_PX, (x % NODE_PX) / NODE_PX
                    terms = node_terms(columns, y // NODE_PX, down, x // NODE_PX)
                    terms += right * (node_terms(columns, y // NODE_PX, down, x // NODE_PX + 1) - terms)
                    bending += counts * bending_at(table, within, terms, unwrapped[y, x])
                    off = phase[y, x] - unwrapped[y, x]
                    bend += counts * (unwrapped[y, x] + off - 2 * PI * ti.round(off / (2 * PI)))
                # What the response's correction lacks is known, but for a share.
                bend += bending[0]
                if ti.abs(bend) < most:
                    seen = vec5(1.0, bend, bending[0], bending[1], bending[2])
                    moments += seen.outer_product(seen)
        for j, k in ti.static(ti.ndrange(5, 5)):
            out_moments[row, j, k] = moments[j, k]


@kernel
def correct_by_modulation_kernel(
    region: I32Array2,  # (H, W) region's number from 1; 0 outside
    unwrapped: F32Array2,  # (H, W) rad
    absolute: I32Array1,  # (regions + 1,) 1 where the orders are absolute
    table: F32Array3,  # (N, places, 3)
    within: F32Array2,  # (2, bins + 1) rad
    shares: F32Array1,  # (3,)
    columns: F32Array3,  # (h, w, 4)
    phase: F32Array2,  # (H, W) rad, to be corrected
):
    """Correct the phases of all regions whose orders are absolute."""
    height, width = phase.shape[0], phase.shape[1]
    for t in range(height * strip_count(width, STRIP)):
        y, first, count = strip_at(t, width, STRIP)
        row, node = y // NODE_PX, first // NODE_PX
        down = ti.cast(y - row * NODE_PX, ti.f32) / NODE_PX
        terms = node_terms(columns, row, down, node)
        change = (node_terms(columns, row, down, node + 1) - terms) / NODE_PX
        for k in range(count):
            x = first + k
            if absolute[region[y, x]] == 1:
                bending = bending_at(table, within, terms + k * change, unwrapped[y, x])
                added = shares[0] * bending[0] + shares[1] * bending[1] + shares[2] * bending[2]
                phase[y, x] = phase[y, x] + added


@cache
def _follow_phase_kernel(wide: bool) -> Any:
    """Return the kernel for rows of vectors, or of numbers."""
    lanes = Lanes.of(wide)

    @kernel(whole_vectors=wide)
    def follow_phase_kernel(
        smoothed: planes(wide),  # (H, W) rad, the phase after the correction
        phase: planes(wide),  # (H, W) rad, before
        unwrapped: planes(wide),  # (H, W) rad, which follows; NaN outside the mask
    ):
        """Let the unwrapped phase follow what has changed."""
        height, width = phase.shape[0], width_of(phase, wide)
        for t in range(height * lane_count(width, wide)):
            y, place = lanes_at(t, width, wide)
            after = load_lanes(smoothed, lanes.floats, y, place, width, wide)
            before = load_lanes(phase, lanes.floats, y, place, width, wide)
            follows = load_lanes(unwrapped, lanes.floats, y, place, width, wide)
            for k in range(lanes.count):
                change = after[k] - before[k]
                # Beside a step smoothing may find the other surface now.
                follows[k] += ti.select(ti.abs(change) < 0.5 * PI, change, 0.0)
            store_lanes(unwrapped, y, place, width, follows, wide)

    return follow_phase_kernel


def measure_bends(
    phase: F32,
    unwrapped: F32,
    region: I32,
    known: npt.NDArray[np.bool_],
    ripples: CodeRipples,
    half: int,
    most: float,
) -> npt.NDArray[np.float64]:
    """Return how the phase bends within a cycle, where the surface does not, and how the ripples do.

    Parameters
    ----------
    phase : (H, W) float32
        rad, before it is smoothed.
    unwrapped : (H, W) float32
        rad.
    region : (H, W) int32
        The region's number from 1; 0 outside.
    known : (regions + 1,) bool
        True where a region's orders are absolute; see `correct_by_modulation`.
    ripples : CodeRipples
        Ripples of the code, whatever the shares.
    half : int
        Rows of half a cycle.
    most : float
        By how much an even surface bends at most, rad.

    Returns
    -------
    (5, 5) float64
        Sums of the products of 1, what the phase bends after the response's ripple has been added, and the ripples.

    Raises
    ------
    ShapeError
        A shape or dtype is another one.
    """
    shape = (int(phase.shape[0]), int(phase.shape[1]))
    phase = checks.read_array("phase", phase, shape, np.float32)
    unwrapped = checks.read_array("unwrapped", unwrapped, shape, np.float32)
    region = checks.read_array("region", region, shape, np.int32)
    moments = np.empty((shape[0], 5, 5), np.float32)
    table, within, _, columns = ripples
    seen = phase, unwrapped, region, known.astype(np.int32)
    measure_bends_kernel(*seen, table, within, columns, half, most, moments)
    return np.asarray(moments.sum(axis=0), np.float64)


def correct_by_modulation(
    region: I32, unwrapped: F32, known: npt.NDArray[np.bool_], ripples: CodeRipples, out: F32
) -> None:
    """Correct the phase of places whose modulation is not the usual one, or changes.

    Parameters
    ----------
    region : (H, W) int32
        The region's number from 1; 0 outside.
    unwrapped : (H, W) float32
        rad.
    known : (regions + 1,) bool
        True where a region's orders are absolute; False for 0. It must reach to the largest number in `region`:
        nobody checks that, which would cost a pass over the image.
    ripples : CodeRipples
        Ripples of the code.
    out : (H, W) float32
        The phase (rad, a little beyond [-pi, pi]), which is corrected.

    Raises
    ------
    ShapeError
        A shape or dtype is another one, or the output cannot be written.
    """
    shape = (int(out.shape[0]), int(out.shape[1]))
    region = checks.read_array("region", region, shape, np.int32)
    unwrapped = checks.read_array("unwrapped", unwrapped, shape, np.float32)
    phase = checks.out_array("out", out, shape, np.float32)
    known = checks.read_array("known", known, (None,), np.bool_)
    correct_by_modulation_kernel(region, unwrapped, known.astype(np.int32), *ripples, phase)


def follow_phase(smoothed: F32, phase: F32, out: F32) -> None:
    """Let the unwrapped phase follow the phase that has been corrected and smoothed.

    Parameters
    ----------
    smoothed : (H, W) float32
        rad.
    phase : (H, W) float32
        rad, as it was before.
    out : (H, W) float32
        The unwrapped phase (rad; NaN outside the mask), which follows.

    Raises
    ------
    ShapeError
        A shape or dtype is another one, or the output cannot be written.
    """
    shape = (int(phase.shape[0]), int(phase.shape[1]))
    smoothed = checks.read_array("smoothed", smoothed, shape, np.float32)
    phase = checks.read_array("phase", phase, shape, np.float32)
    unwrapped = checks.out_array("out", out, shape, np.float32)
    rows, wide = whole_rows(smoothed, phase, unwrapped)
    _follow_phase_kernel(wide)(*(as_lanes(array, wide) for array in rows))
    put_back(rows[2], unwrapped)
