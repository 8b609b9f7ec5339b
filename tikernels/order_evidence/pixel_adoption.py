"""Give pixels at steps, which belong to nobody, to the one absolute surface that they continue.

What sees two surfaces at once has any phase, and less modulation. So a pixel belongs to the surface beside it if it
continues that one's phase and brightness, and no other surface within reach.
"""

import numpy as np
import numpy.typing as npt

from tikernels import checks, runtime
from tikernels._taichi import F32Array2, F32Array3, I32Array1, I32Array2, U8Array2, f32, i32, ivec4, ti, u1, vec2, vec3
from tikernels.arrays import F32, I32, U8
from tikernels.launching import kernel
from tikernels.phase.phase_vector import PI, wrap
from tikernels.phase.wrapped_phase import NO_PHASE, has_phase
from tikernels.unwrapping.continuity import frame_rates
from tikernels.unwrapping.tables import HIDES_STEP, Final, cell_bounds, cell_count, step_to

# Where other surfaces are within reach: departure from the best one's continuation, rad; modulation relative to the
# neighbour's; and by how much more, rad, the pixel must depart from every other surface.
_MAX_ADOPTED, _ALIKE, _MIN_RIVAL = 0.25, 0.85, 0.5
# Where there is no other one, a steep facet may continue less smoothly: departure, rad, and relative modulation.
_MAX_ALONE, _ALIKE_ALONE = 1.2, 0.5
# Other surfaces are looked for at up to this distance, px, in eight directions; steps are closed by this many pixels
# from either side, one a pass.
_REACH, _PASSES = 3, 4


@ti.func
def continued(
    phase: f32, unwrapped: F32Array2, region: I32Array2, rates: F32Array2, y: i32, x: i32, dy: i32, dx: i32, far: i32
) -> vec3:
    """Return a phase with the orders of the surface at this distance, how far it departs from it, and its region.

    The surface is continued by the slope of its last two pixels; a region of 0 means that there is none.
    """
    height, width = region.shape[0], region.shape[1]
    along, across, _ = frame_rates(rates)
    result = vec3(0.0, NO_PHASE, 0.0)
    y1, x1 = y + far * dy, x + far * dx
    y2, x2 = y1 + dy, x1 + dx
    if y1 >= 0 and y1 < height and x1 >= 0 and x1 < width:
        number = region[y1, x1]
        if number > 0:
            slope = -(dx * along + dy * across)
            if y2 >= 0 and y2 < height and x2 >= 0 and x2 < width:
                if region[y2, x2] == number:
                    slope = unwrapped[y1, x1] - unwrapped[y2, x2]
            expected = unwrapped[y1, x1] + far * slope
            value = phase + 2.0 * PI * ti.round((expected - phase) * (0.5 / PI))
            result = vec3(value, ti.abs(value - expected), ti.cast(number, ti.f32))
    return result


@ti.func
def find_rival(
    here: f32, best: vec3, unwrapped: F32Array2, region: I32Array2, rates: F32Array2, y: i32, x: i32
) -> vec2:
    """Return how far a pixel departs from the nearest surface whole cycles away, and 1 if no other one is in reach."""
    rival, alone = NO_PHASE, 1.0
    for direction in range(9):
        dy, dx = direction // 3 - 1, direction % 3 - 1
        for far in range(1, ti.select(direction == 4, 1, _REACH + 1)):
            other = continued(here, unwrapped, region, rates, y, x, dy, dx, far)
            if other.z > 0.0:
                if ti.abs(other.x - best.x) > PI:
                    rival = ti.min(rival, other.y)
                    alone = 0.0
                if other.z != best.z:
                    alone = 0.0
    return vec2(rival, alone)


@ti.func
def adopter(
    phase: F32Array2,
    raw_phase: F32Array2,
    modulation: F32Array2,
    rates: F32Array2,
    absolute: I32Array1,
    unwrapped: F32Array2,
    region: I32Array2,
    hides_step: u1,
    y: i32,
    x: i32,
) -> vec2:
    """Return a pixel's phase in the one absolute surface that it continues, and that region's number, 0 if none.

    In a cell that hides a step other surfaces may go on as well: there it must look like its neighbour, too, even if
    that is alone.
    """
    result = vec2(0.0)
    here = ti.select(has_phase(phase[y, x]), phase[y, x], raw_phase[y, x])
    best, alike = vec3(0.0, NO_PHASE, 0.0), 0.0
    if has_phase(here):
        for side in range(4):
            dy, dx = step_to(side)
            other = continued(here, unwrapped, region, rates, y, x, dy, dx, 1)
            if other.y < best.y:
                best = other
                low = ti.min(modulation[y, x], modulation[y + dy, x + dx])
                alike = low / ti.max(ti.max(modulation[y, x], modulation[y + dy, x + dx]), 1e-12)
    if best.y < _MAX_ALONE and absolute[ti.cast(best.z, ti.i32)] == 1:
        rival = find_rival(here, best, unwrapped, region, rates, y, x)
        alone = rival.y == 1.0
        belongs = best.y < _MAX_ADOPTED and alike > _ALIKE and rival.x > best.y + _MIN_RIVAL
        if hides_step:
            belongs = alone and best.y < _MAX_ADOPTED and alike > _ALIKE
        elif alone:
            belongs |= alike > _ALIKE_ALONE
        if belongs:
            result = vec2(best.x, best.z)
    return result


@ti.func
def find_adopters(
    phase: F32Array2,
    raw_phase: F32Array2,
    modulation: F32Array2,
    rates: F32Array2,
    absolute: I32Array1,
    unwrapped: F32Array2,
    mask: U8Array2,
    region: I32Array2,
    bounds: ivec4,
    hides_step: u1,
    adopted: F32Array3,
):
    """Note of every pixel of a cell that is in no surface yet which one it continues."""
    for y in range(bounds[0], bounds[2]):
        for x in range(bounds[1], bounds[3]):
            if mask[y, x] == 0:
                found = adopter(phase, raw_phase, modulation, rates, absolute, unwrapped, region, hides_step, y, x)
                adopted[y, x, 0], adopted[y, x, 1] = found.x, found.y


@ti.func
def adopt(bounds: ivec4, adopted: F32Array3, phase: F32Array2, unwrapped: F32Array2, mask: U8Array2, region: I32Array2):
    """Give the pixels of a cell to the surfaces that were noted."""
    for y in range(bounds[0], bounds[2]):
        for x in range(bounds[1], bounds[3]):
            if mask[y, x] == 0 and adopted[y, x, 1] > 0.0:
                value = adopted[y, x, 0]
                unwrapped[y, x] = value
                phase[y, x] = wrap(value - 2.0 * PI * ti.round(value * (0.5 / PI)))
                region[y, x] = ti.cast(adopted[y, x, 1], ti.i32)
                mask[y, x] = ti.cast(1, ti.u8)


@kernel
def adopt_pixels_kernel(
    final: I32Array2,  # (3, cells or more) see `Final`; steps are read
    phase: F32Array2,  # (H, W) rad; STEP_PHASE at steps
    raw_phase: F32Array2,  # (H, W) rad, before smoothing; NO_PHASE where there is none
    modulation: F32Array2,  # (H, W)
    rates: F32Array2,  # see `frame_rates`
    absolute: I32Array1,  # (regions + 1,) 1 where the orders are absolute
    adopted: F32Array3,  # (H, W, 2) scratch
    unwrapped: F32Array2,  # (H, W) rad
    mask: U8Array2,  # (H, W)
    region: I32Array2,  # (H, W)
):
    """Look at what all pixels at steps continue, then give them to it."""
    height, width = phase.shape[0], phase.shape[1]
    for cell in range(cell_count(height, width)):
        if final[Final.STEPS, cell] > 0:
            hides_step = final[Final.STEPS, cell] == HIDES_STEP
            top, left, bottom, right = cell_bounds(cell, height, width)
            bounds = ivec4(top, left, bottom, right)
            find_adopters(
                phase, raw_phase, modulation, rates, absolute, unwrapped, mask, region, bounds, hides_step, adopted
            )
    for cell in range(cell_count(height, width)):
        if final[Final.STEPS, cell] > 0:
            top, left, bottom, right = cell_bounds(cell, height, width)
            bounds = ivec4(top, left, bottom, right)
            adopt(bounds, adopted, phase, unwrapped, mask, region)


def adopt_pixels(
    final: I32,
    phase: F32,
    raw_phase: F32,
    modulation: F32,
    rates: F32,
    known: npt.NDArray[np.bool_],
    out: tuple[F32, U8, I32],
) -> None:
    """Give pixels at steps to the one absolute surface that they continue.

    Parameters
    ----------
    final : (3, cells or more) int32
        `Patches.final`, after it was written: only cells with steps, and those beside them, are looked at.
    phase : (H, W) float32
        rad; STEP_PHASE at steps. Pixels that are adopted get theirs, in [-pi, pi].
    raw_phase : (H, W) float32
        rad, before smoothing; NO_PHASE where there is none.
    modulation : (H, W) float32
        Levels.
    rates : (N, 5) float32
        What `measure_rates` found.
    known : (regions + 1,) bool
        Whether a region's orders are absolute; False for 0. It must reach to the largest number in the region of `out`:
        nobody checks that, which would cost a pass over the image.
    out : (H, W) float32, (H, W) uint8 and (H, W) int32
        Unwrapped phase (rad), mask and region, to which the adopted pixels are added.

    Raises
    ------
    ShapeError
        A shape or dtype is another one, or an output cannot be written.
    """
    shape = (int(out[0].shape[0]), int(out[0].shape[1]))
    final = checks.read_array("final", final, (len(Final), None), np.int32)
    phase = checks.out_array("phase", phase, shape, np.float32)
    raw_phase = checks.read_array("raw_phase", raw_phase, shape, np.float32)
    modulation = checks.read_array("modulation", modulation, shape, np.float32)
    rates = checks.read_array("rates", rates, (None, 5), np.float32)
    known = checks.read_array("known", known, (None,), np.bool_)
    unwrapped, mask, region = (
        checks.out_array(f"out[{i}]", array, shape, dtype)
        for i, (array, dtype) in enumerate(zip(out, (np.float32, np.uint8, np.int32), strict=True))
    )
    adopted = runtime.empty((*shape, 2), np.float32)
    seen = (phase, raw_phase, modulation, rates, runtime.to_device(known.astype(np.int32)))
    for _ in range(_PASSES):
        adopt_pixels_kernel(final, *seen, adopted, unwrapped, mask, region)
