"""Correct the phase of cycles whose modulation is not the usual one, or changes, as a code makes it.

Response and blur bend the phase by what the modulation is. Where the order of a cycle is absolute, its modulation is
the code's, so what is to be added depends on the absolute phase alone and stands in a table; between two of its places
a line stands for it.
"""

import numpy as np
import numpy.typing as npt

from tikernels import checks
from tikernels._taichi import F32Array1, F32Array2, I32Array1, I32Array2, f32, ti
from tikernels.arrays import F32, I32
from tikernels.launching import kernel
from tikernels.phase.phase_vector import PI
from tikernels.strips import STRIP, strip_at, strip_count

#: Cycles to either side between which the modulation's slope is taken: blur rounds the tips of the code off.
SLOPE_REACH = 0.2
#: Places a cycle at which the correction is tabled: the slope's reach is a whole number of them, so its bends are met.
TABLED = 120


@ti.func
def tabled(corrections: F32Array1, unwrapped: f32) -> f32:
    """Interpolate the correction of an absolute phase, rad."""
    last = corrections.shape[0] - 1
    place = ti.min(ti.max(unwrapped * (0.5 * TABLED / PI), 0.0), ti.cast(last, ti.f32))
    below = ti.min(ti.cast(place, ti.i32), last - 1)
    share = place - ti.cast(below, ti.f32)
    return corrections[below] + share * (corrections[below + 1] - corrections[below])


@kernel
def correct_by_modulation_kernel(
    region: I32Array2,  # (H, W) region's number from 1; 0 outside
    absolute: I32Array1,  # (regions + 1,) 1 where the orders are absolute
    corrections: F32Array1,  # (N,) rad to add at an absolute phase, TABLED a cycle, from the first cycle's middle on
    phase: F32Array2,  # (H, W) rad in [-pi, pi], to be corrected
    unwrapped: F32Array2,  # (H, W) rad, to be corrected
):
    """Correct the phases of all regions whose orders are absolute."""
    height, width = phase.shape[0], phase.shape[1]
    for t in range(height * strip_count(width, STRIP)):
        y, first, count = strip_at(t, width, STRIP)
        for x in range(first, first + count):
            if absolute[region[y, x]] == 1:
                correction = tabled(corrections, unwrapped[y, x])
                phase[y, x] = phase[y, x] + correction
                unwrapped[y, x] = unwrapped[y, x] + correction


def correct_by_modulation(
    region: I32, known: npt.NDArray[np.bool_], corrections: npt.NDArray[np.floating], out: tuple[F32, F32]
) -> None:
    """Correct the phase of cycles whose modulation is not the usual one, or changes.

    Parameters
    ----------
    region : (H, W) int32
        The region's number from 1; 0 outside.
    known : (regions + 1,) bool
        Whether a region's orders are absolute; False for 0. It must reach to the largest number in `region`:
        nobody checks that, which would cost a pass over the image.
    corrections : (N,) float
        rad to add at an absolute phase, TABLED a cycle, from the middle of the first cycle on; two or more.
    out : two (H, W) float32
        The phase (rad in [-pi, pi]) and the unwrapped phase (rad), which are corrected.

    Raises
    ------
    ShapeError
        A shape or dtype is another one, or an output cannot be written.
    """
    shape = (int(out[0].shape[0]), int(out[0].shape[1]))
    region = checks.read_array("region", region, shape, np.int32)
    phase = checks.out_array("out[0]", out[0], shape, np.float32)
    unwrapped = checks.out_array("out[1]", out[1], shape, np.float32)
    known = checks.read_array("known", known, (None,), np.bool_)
    tables = (known.astype(np.int32), np.asarray(corrections, np.float32))
    correct_by_modulation_kernel(region, *tables, phase, unwrapped)
