"""Places where no fringe falls: even light has a phase as well, that of its colour, but it is the same everywhere."""

import numpy as np
import numpy.typing as npt

from tikernels import runtime
from tikernels._taichi import F32Array2, I32Array2, f32, ivec4, ti
from tikernels.arrays import I32
from tikernels.phase.phase_change import LEAST_CHANGE
from tikernels.phase.wrapped_phase import without_cycles
from tikernels.unwrapping.tables import Cell

# One column of a cell in this many is looked at. The least number of changes, of the 60 of a whole cell, that is relied
# on: at the image's border a cell may be a row or two.
_EVERY, _LEAST_COUNT = 2, 16


@ti.func
def mean_change(phase: F32Array2, labels: I32Array2, bounds: ivec4, usual: f32) -> f32:
    """Return a cell's mean change of phase from row to row, as a share of the usual one; 1 if few are known."""
    beyond, count = 0.0, 0.0
    for y in range(bounds[0], bounds[2] - 1):
        for column in range((bounds[3] - bounds[1] + _EVERY - 1) // _EVERY):
            x = bounds[1] + _EVERY * column
            if labels[y, x] >= 0 and labels[y + 1, x] >= 0:
                beyond += without_cycles(phase[y + 1, x] - phase[y, x] - usual)
                count += 1.0
    return ti.select(count >= _LEAST_COUNT, 1.0 + beyond / (count * usual), 1.0)


def patches_of_even_light(changes: npt.NDArray[np.float32], cells: I32, count: int) -> npt.NDArray[np.bool_]:
    """Return (P,) bool, the patches in cells whose phase hardly changes across the stripes.

    Parameters
    ----------
    changes : (cells,) float32
        The `mean_change` of each.
    cells : (3, cells + 1) int32
        See `Cell`; numbered.
    count : int
        Number of patches.
    """
    even = changes < LEAST_CHANGE
    if not even.any():
        return np.zeros(count, bool)
    return np.asarray(np.repeat(even, np.diff(runtime.to_host(cells)[Cell.PATCHES])))
