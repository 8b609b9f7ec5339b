"""Correct the phase of places whose modulation is not the usual one, or changes, as a code makes it.

Response and blur bend the phase by what the modulation is. Where the order of a cycle is absolute, its modulation is
the code's, so what is to be added depends on the absolute phase, and on the place along the stripe if the code changes
there. It comes before the phase is smoothed along the stripe.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tikernels import checks
from tikernels._taichi import F32Array1, F32Array2, F32Array3, I32Array1, I32Array2, f32, i32, ti, vec3, vec4
from tikernels.arrays import F32, I32
from tikernels.launching import kernel
from tikernels.phase.phase_vector import PI
from tikernels.strips import STRIP, strip_at, strip_count

#: Places a cycle at which the code's ripples are tabled.
TABLED = 20
#: Terms of the columns along the stripe are known at nodes this many px apart, as a strip is long.
NODE_PX = STRIP


class CodeRipples(NamedTuple):
    """What a code changes, by the absolute phase and the place along the stripe, and how much of it bends the phase."""

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
def tabled(table: F32Array2, row: i32, share: f32) -> f32:
    """Interpolate a row of a table at a share of its length, 0..1."""
    last = table.shape[1] - 1
    place = ti.min(ti.max(share, 0.0), 1.0) * last
    below = ti.min(ti.cast(place, ti.i32), last - 1)
    return table[row, below] + (place - below) * (table[row, below + 1] - table[row, below])


@ti.func
def ripples_at(table: F32Array3, cycles: f32, along: f32) -> vec3:
    """Interpolate a code's ripples at an absolute phase in cycles, and a column in repeats of the code."""
    last = table.shape[0] - 1
    place = ti.min(ti.max(cycles * TABLED, 0.0), ti.cast(last, ti.f32))
    below = ti.min(ti.cast(place, ti.i32), last - 1)
    # Not a number where a ray meets the pattern nowhere.
    column = ti.max(ti.min(ti.cast((along - ti.floor(along)) * table.shape[1], ti.i32), table.shape[1] - 1), 0)
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
                cycles = unwrapped[y, x] * (0.5 / PI)
                here = terms + k * change
                along = here[0] + cycles * (here[1] + cycles * (here[2] + cycles * here[3]))
                ripples = ripples_at(table, cycles, along)
                share = cycles + 0.5 - ti.floor(cycles + 0.5)
                of_contrast = tabled(within, 0, share) + (2.0 + ripples[0]) * tabled(within, 1, share)
                added = shares[0] * ripples[0] * of_contrast + shares[1] * ripples[1] + shares[2] * ripples[2]
                phase[y, x] = phase[y, x] + added


@kernel
def follow_phase_kernel(
    region: I32Array2,  # (H, W) region's number from 1; 0 outside
    smoothed: F32Array2,  # (H, W) rad, the phase after the correction
    phase: F32Array2,  # (H, W) rad, before; becomes the same
    unwrapped: F32Array2,  # (H, W) rad, which follows
):
    """Let the unwrapped phase follow what has changed."""
    height, width = phase.shape[0], phase.shape[1]
    for t in range(height * strip_count(width, STRIP)):
        y, first, count = strip_at(t, width, STRIP)
        for x in range(first, first + count):
            change = smoothed[y, x] - phase[y, x]
            # Beside a step smoothing may find the other surface now.
            if region[y, x] > 0 and ti.abs(change) < 0.5 * PI:
                unwrapped[y, x] = unwrapped[y, x] + change
                phase[y, x] = smoothed[y, x]


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
        Whether a region's orders are absolute; False for 0. It must reach to the largest number in `region`:
        nobody checks that, which would cost a pass over the image.
    ripples : CodeRipples
        What the code does.
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


def follow_phase(region: I32, smoothed: F32, out: tuple[F32, F32]) -> None:
    """Let the unwrapped phase follow the phase that has been corrected and smoothed.

    Parameters
    ----------
    region : (H, W) int32
        The region's number from 1; 0 outside.
    smoothed : (H, W) float32
        rad.
    out : two (H, W) float32
        The phase as it was (rad), which becomes the same, and the unwrapped phase (rad), which follows.

    Raises
    ------
    ShapeError
        A shape or dtype is another one, or an output cannot be written.
    """
    shape = (int(out[0].shape[0]), int(out[0].shape[1]))
    region = checks.read_array("region", region, shape, np.int32)
    smoothed = checks.read_array("smoothed", smoothed, shape, np.float32)
    names = ("out[0]", "out[1]")
    follow_phase_kernel(
        region,
        smoothed,
        *(checks.out_array(name, array, shape, np.float32) for name, array in zip(names, out, strict=True)),
    )
