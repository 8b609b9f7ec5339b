"""Where the phase is not the fringe's: even light has one, too, that of its colour, and everywhere the same."""

import numpy as np
import numpy.typing as npt

from tikernels import runtime
from tikernels._taichi import F32Array1, F32Array2, I32Array2, f32
from tikernels.arrays import F32, I32
from tikernels.launching import kernel
from tikernels.unwrapping.continuity import frame_rates
from tikernels.unwrapping.surface_borders import without_cycles
from tikernels.unwrapping.tables import Cell, cell_bounds, cell_count

# Light is even where the phase changes across the stripes by less than this share of what is usual. Of surfaces, even
# those that the projector grazes, it is .4 and more; of shadows in a lit room and of what lies beyond the projector's
# picture .05 and less.
_LEAST_CHANGE = 0.2
# Every so manieth column of a cell is looked at.
_EVERY = 2


@kernel
def mean_changes_kernel(
    phase: F32Array2,  # (H, W) rad
    rates: F32Array2,  # see `frame_rates`
    labels: I32Array2,  # (H, W) negative: no patch's
    out_changes: F32Array1,  # (cells,) over the usual change; 1 where there is no phase
):
    """Measure by how much the phase changes from row to row, on average over each cell."""
    height, width = phase.shape[0], phase.shape[1]
    for cell in range(cell_count(height, width)):
        _, usual, _ = frame_rates(rates)
        top, left, bottom, right = cell_bounds(cell, height, width)
        beyond, count = f32(0.0), f32(0.0)
        for y in range(top, bottom - 1):
            for column in range((right - left + _EVERY - 1) // _EVERY):
                x = left + _EVERY * column
                if labels[y, x] >= 0 and labels[y + 1, x] >= 0:
                    beyond += without_cycles(phase[y + 1, x] - phase[y, x] - usual)
                    count += 1.0
        out_changes[cell] = 1.0 + beyond / (max(count, 1.0) * usual)


def patches_of_even_light(phase: F32, rates: F32, labels: I32, cells: I32) -> npt.NDArray[np.bool_]:
    """Return (P,) bool, the patches in cells whose phase hardly changes across the stripes.

    Parameters
    ----------
    phase : (H, W) float32
        rad in [-pi, pi].
    rates : (N, 5) float32
        What `measure_rates` found.
    labels : (H, W) int32
        Patch and order in it; negative where there is none.
    cells : (3, cells + 1) int32
        See `Cell`; numbered.
    """
    changes = runtime.empty((cells.shape[1] - 1,), np.float32)
    mean_changes_kernel(phase, rates, labels, changes)
    even = runtime.to_host(changes) < _LEAST_CHANGE  # synchronises
    return np.asarray(np.repeat(even, np.diff(runtime.to_host(cells)[Cell.PATCHES])))
