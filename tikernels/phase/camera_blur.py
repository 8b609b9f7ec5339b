"""Undo what the camera's blur does to the phase where the brightness changes, as at an edge of paint.

A pixel averages light over its area, and the lens blurs it besides: together about a Gaussian of variance v, in px^2.
Beside an edge the brighter side counts for more, and that side's phase with it. Blurring multiplies s exp(i phi), s the
brightness, by

    1 + v/2 laplacian(s exp(i phi)) / (s exp(i phi)) + ...,

whose imaginary part turns the phase by v grad(log s) grad(phi), besides the mean over the blur that any pixel sees. At
12 px per cycle an edge where the brightness doubles makes 0.06 rad of it.
"""

from functools import cache
from typing import Any

import numpy as np

from tikernels import checks
from tikernels._taichi import Static, ti
from tikernels.arrays import F32
from tikernels.lanes import (
    Lanes,
    as_lanes,
    lane_count,
    lanes_at,
    load_around,
    load_lanes,
    planes,
    put_back,
    store_lanes,
    whole_rows,
    width_of,
)
from tikernels.launching import kernel
from tikernels.phase.phase_fit import doubted
from tikernels.phase.phase_vector import TINY, absolute_lanes, wrap_lanes
from tikernels.phase.wrapped_phase import LEAST_NO_PHASE, NO_PHASE

#: v, px^2: a pixel's area makes 1/12, and a lens that is made for the sensor, with a blur of half a pixel, 1/4.
VARIANCE_PX = 1 / 3
# How far it may be from that, and what the second order leaves at lips and moles, as a standard deviation.
_DOUBT_PX = 0.5
# Slopes on either side of a pixel that differ by more than this, or are steeper, are none: a step is near. rad per px
_SAME_SLOPE, _STEEPEST = 0.4, 1.2


@ti.func
def turned_by_blur(before: Static, here: Static, after: Static, dim: Static, bright: Static):
    """Return grad(log s) grad(phi) along one direction, from lanes of phases in a row and the brightness at both ends.

    Zero next to a step, and where there is no phase.
    """
    one, other = wrap_lanes(here - before), wrap_lanes(after - here)
    # (s1 - s0) / (s1 + s0) is the hyperbolic tangent of half the logarithms' difference: it cannot run away.
    turned = 0.5 * (one + other) * (bright - dim) / ti.max(bright + dim, TINY)
    turned = ti.select(absolute_lanes(one - other) < _SAME_SLOPE, turned, 0.0)
    return ti.select(absolute_lanes(one + other) < 2.0 * _STEEPEST, turned, 0.0)


@cache
def _undo_camera_blur_kernel(wide: bool) -> Any:
    """Return the kernel for rows of vectors, or of numbers."""
    lanes = Lanes.of(wide)

    @kernel(whole_vectors=wide)
    def undo_camera_blur_kernel(
        phase: planes(wide),  # (H, W) rad, a little beyond +-pi; NO_PHASE outside the mask
        brightness: planes(wide),  # (H, W)
        precision: planes(wide),  # (H, W) 1 / rad^2
        out: planes(wide),  # (H, W) rad, as the phase
        out_misfit: planes(wide),  # (H, W) in units of the precision's variance; added to
    ):
        height, width = phase.shape[0], width_of(phase, wide)
        for t in range(height * lane_count(width, wide)):
            y, place = lanes_at(t, width, wide)
            above, below = ti.max(y - 1, 0), ti.min(y + 1, height - 1)
            here = load_around(phase, lanes.three_floats, y, place, width, 1, NO_PHASE, wide)
            light = load_around(brightness, lanes.three_floats, y, place, width, 1, 0.0, wide)
            upper = load_lanes(phase, lanes.floats, above, place, width, wide)
            lower = load_lanes(phase, lanes.floats, below, place, width, wide)
            light_above = load_lanes(brightness, lanes.floats, above, place, width, wide)
            light_below = load_lanes(brightness, lanes.floats, below, place, width, wide)
            sure = load_lanes(precision, lanes.floats, y, place, width, wide)
            misfit = load_lanes(out_misfit, lanes.floats, y, place, width, wide)
            centre, left, right = lanes.floats(0.0), lanes.floats(0.0), lanes.floats(0.0)
            dim, bright = lanes.floats(0.0), lanes.floats(0.0)
            for k in range(lanes.count):
                x = lanes.count + k
                centre[k], left[k], right[k] = here[x], here[x - 1], here[x + 1]
                dim[k], bright[k] = light[x - 1], light[x + 1]
            turn = turned_by_blur(upper, centre, lower, light_above, light_below)
            turn += turned_by_blur(left, centre, right, dim, bright)
            turned = centre - ti.select(centre < LEAST_NO_PHASE, VARIANCE_PX * turn, 0.0)
            misfit = doubted(misfit, _DOUBT_PX * turn, sure)
            store_lanes(out, y, place, width, turned, wide)
            store_lanes(out_misfit, y, place, width, misfit, wide)

    return undo_camera_blur_kernel


def undo_camera_blur(phase: F32, brightness: F32, precision: F32, out: tuple[F32, F32]) -> None:
    """Correct phases for the camera's blur, and add to their misfit what that is unsure of.

    Parameters
    ----------
    phase : (H, W) float32
        rad, a little beyond [-pi, pi]; NO_PHASE outside the mask.
    brightness : (H, W) float32
        Of the surface under equal light, without the fringe, in any unit.
    precision : (H, W) float32
        1 / rad^2, one over the phase's variance.
    out : two (H, W) float32
        The phase, rad, not the input; and its misfit, in units of that variance, which is added to.

    Raises
    ------
    ShapeError
        A shape or dtype is another one, or an output cannot be written.
    """
    phase = checks.read_array("phase", phase, (None, None), np.float32)
    shape = (int(phase.shape[0]), int(phase.shape[1]))
    brightness = checks.read_array("brightness", brightness, shape, np.float32)
    precision = checks.read_array("precision", precision, shape, np.float32)
    corrected, misfit = (
        checks.out_buffer(name, buffer, shape, np.float32)
        for name, buffer in zip(("corrected phase", "misfit"), out, strict=True)
    )
    rows, wide = whole_rows(phase, brightness, precision, corrected, misfit, beyond=NO_PHASE)
    _undo_camera_blur_kernel(wide)(*(as_lanes(array, wide) for array in rows))
    put_back(rows[3], corrected)
    put_back(rows[4], misfit)
