"""Brightness that follows the fringe, all over a frame: its phase, and its contrast.

Brightness and one cycle of the channels (`channel_template.py`) are known but for a common function of the phase:
C_i = s t_i = (s / g(phi)) (g(phi) t_i). Phases do not care; but what s has of g shows as stripes. The object knows
nothing of the phase, so of log s that is g which a frame's pixels have in common as a function of their phase,

    log g = sum over n = 1 to 3 of  u_n cos(n phi) + v_n sin(n phi),

by least squares, after both sides have lost what is smooth on the object (P. M. Robinson, Root-N-consistent
semiparametric regression, Econometrica 56, 1988, doi:10.2307/1912705): here by second differences over three rows a
quarter of a cycle apart, which leave out slopes, take the first and third harmonic twice and the second four times.
Six numbers per frame take nothing from the picture's resolution, where the same by tiles of the frame would take print
for ripple.

Nor does the object know of a code, which changes the contrast kappa from cycle to cycle: of log s that is taken off
which follows log kappa, by a straight line over rows a whole cycle apart. A code keeps the peak of every cycle, which
is what s consists of, but for the effect of a response that is not linear: 0.015 at gamma 2.
"""

import numpy as np
import numpy.typing as npt

from tikernels import checks, runtime
from tikernels._taichi import F32Array1, F32Array2, U8Array2, f32, i32, ti
from tikernels.arrays import F32, Mask
from tikernels.launching import kernel
from tikernels.phase.channel_model import EVERY, PRIOR_SAMPLES
from tikernels.phase.phase_vector import PI, TINY, cosine_and_sine
from tikernels.strips import STRIP, strip_at, strip_count

#: Numbers of a ripple: cosine and sine of three harmonics.
RIPPLE_TERMS = 6
# Places of the upper triangle of the normal equations, row by row.
_UPPER = tuple((a, b) for a in range(RIPPLE_TERMS) for b in range(a, RIPPLE_TERMS))
_CORNERS = len(_UPPER)
_SUMS = _CORNERS + RIPPLE_TERMS + 1
# Second differences beyond this are paint and edges, not ripple: they count less (P. J. Huber, Annals of Mathematical
# Statistics 35, 1964, doi:10.1214/aoms/1177703732).
_HUBER = 0.05


@ti.func
def within_cycle(phase: f32) -> f32:
    """Return a phase without its whole cycles, rad."""
    return phase - 2.0 * PI * ti.round(phase / (2.0 * PI))


@ti.func
def ripple_waves(phase: f32):
    """Return cosine and sine of a phase, of twice and of three times that; the phase may have whole cycles."""
    cosine, sine = cosine_and_sine(within_cycle(phase))
    result = ti.Vector.zero(f32, RIPPLE_TERMS)
    real, imaginary = cosine, sine
    for n in ti.static(range(RIPPLE_TERMS // 2)):
        result[2 * n], result[2 * n + 1] = real, imaginary
        real, imaginary = real * cosine - imaginary * sine, real * sine + imaginary * cosine
    return result


@ti.func
def ripple_at(ripple: F32Array1, phase: f32) -> f32:
    """Return log g at a phase, rad."""
    waves, total = ripple_waves(phase), 0.0
    for n in ti.static(range(RIPPLE_TERMS)):
        total += ripple[n] * waves[n]
    return total


@kernel
def sum_ripple_kernel(
    brightness: F32Array2,  # (H, W) any unit
    phase: F32Array2,  # (H, W) rad
    mask: U8Array2,  # (H, W)
    step: i32,  # px between the rows that are compared
    out_sums: F32Array2,  # (strips, 28) upper triangle and right side of the normal equations, and the samples
):
    columns = strip_count(brightness.shape[1], EVERY)
    for strip in range((brightness.shape[0] - 2 * step) * strip_count(columns, STRIP)):
        y, first, count = strip_at(strip, columns, STRIP)
        sums = ti.Vector.zero(f32, _SUMS)
        for number in range(first, first + count):
            # Another one from row to row, so that all columns are sampled.
            x = ti.min(number * EVERY + y % EVERY, brightness.shape[1] - 1)
            change, waves, holds = 0.0, ti.Vector.zero(f32, RIPPLE_TERMS), 1.0
            for k in ti.static(range(3)):
                weight, row = ti.static((-1.0, 2.0, -1.0)[k]), y + k * step
                if mask[row, x] == 0 or brightness[row, x] <= 0.0:
                    holds = 0.0
                else:
                    change += weight * ti.log(brightness[row, x])
                    waves += weight * ripple_waves(phase[row, x])
            holds *= ti.min(1.0, _HUBER / (ti.abs(change) + TINY))
            for place in ti.static(range(_CORNERS)):
                sums[place] += holds * waves[_UPPER[place][0]] * waves[_UPPER[place][1]]
            for n in ti.static(range(RIPPLE_TERMS)):
                sums[_CORNERS + n] += holds * waves[n] * change
            sums[_SUMS - 1] += holds
        for place in ti.static(range(_SUMS)):
            out_sums[strip, place] = sums[place]


@kernel
def sum_contrast_kernel(
    brightness: F32Array2,  # (H, W) any unit
    contrast: F32Array2,  # (H, W) its logarithm
    mask: U8Array2,  # (H, W)
    step: i32,  # px between the rows that are compared
    out_sums: F32Array2,  # (H - 2 step, 4) contrast's change times brightness', squared; contrast; pixels
):
    for y in range(out_sums.shape[0]):
        product, square, total, count = 0.0, 0.0, 0.0, 0.0
        for number in range(strip_count(brightness.shape[1], EVERY)):
            x = ti.min(number * EVERY + y % EVERY, brightness.shape[1] - 1)
            change, by_contrast, holds = 0.0, 0.0, 1.0
            for k in ti.static(range(3)):
                weight, row = ti.static((-1.0, 2.0, -1.0)[k]), y + k * step
                if mask[row, x] == 0 or brightness[row, x] <= 0.0:
                    holds = 0.0
                else:
                    change += weight * ti.log(brightness[row, x])
                    by_contrast += weight * contrast[row, x]
            holds *= ti.min(1.0, _HUBER / (ti.abs(change) + TINY))
            if mask[y, x] != 0:
                total += contrast[y, x]
                count += 1.0
            product += holds * change * by_contrast
            square += holds * by_contrast * by_contrast
        out_sums[y, 0], out_sums[y, 1], out_sums[y, 2], out_sums[y, 3] = product, square, total, count


def contrast_slope(brightness: F32, contrast: F32, mask: Mask, period_px: float) -> tuple[float, float]:
    """Return by how much the logarithm of the brightness changes with that of the contrast, and the mean of that.

    Parameters
    ----------
    brightness : (H, W) float32
        In any unit, stripes along the rows.
    contrast : (H, W) float32
        The logarithm of the fringe's contrast, which a code changes from cycle to cycle.
    mask : (H, W) bool or uint8
        Valid pixels.
    period_px : float
        Camera px per cycle.

    Returns
    -------
    slope : float
        0 with too little evidence.
    mean : float
        Of the contrast's logarithm.

    Raises
    ------
    ShapeError
        A shape or dtype is another one.
    """
    brightness = checks.read_array("brightness", brightness, (None, None), np.float32)
    height, width = int(brightness.shape[0]), int(brightness.shape[1])
    contrast = checks.read_array("contrast", contrast, (height, width), np.float32)
    mask = checks.read_mask("mask", mask, (height, width))
    step = max(1, round(period_px))
    if height <= 2 * step:
        return 0.0, 0.0
    out = runtime.empty((height - 2 * step, 4), np.float32)
    sum_contrast_kernel(brightness, contrast, mask, step, out)
    product, square, total, count = runtime.to_host(out).sum(axis=0, dtype=np.float64)  # synchronises
    return float(product / (square + PRIOR_SAMPLES * _HUBER**2)), float(total / max(count, 1.0))


def measure_ripple(brightness: F32, phase: F32, mask: Mask, period_px: float) -> npt.NDArray[np.float32]:
    """Measure what of the brightness repeats with every cycle.

    Parameters
    ----------
    brightness : (H, W) float32
        In any unit, stripes along the rows.
    phase : (H, W) float32
        rad, wrapped or not; of no account off the mask.
    mask : (H, W) bool or uint8
        Valid pixels.
    period_px : float
        Camera px per cycle.

    Returns
    -------
    (6,) float32
        u_1, v_1, u_2, v_2, u_3, v_3 of log g; zeros with too little evidence.

    Raises
    ------
    ShapeError
        A shape or dtype is another one.
    """
    brightness = checks.read_array("brightness", brightness, (None, None), np.float32)
    height, width = int(brightness.shape[0]), int(brightness.shape[1])
    phase = checks.read_array("phase", phase, (height, width), np.float32)
    mask = checks.read_mask("mask", mask, (height, width))
    step = max(1, round(period_px / 4))
    if height <= 2 * step:
        return np.zeros(RIPPLE_TERMS, np.float32)
    columns = -(-width // EVERY)
    out = runtime.empty(((height - 2 * step) * -(-columns // STRIP), _SUMS), np.float32)
    sum_ripple_kernel(brightness, phase, mask, step, out)
    sums = runtime.to_host(out).sum(axis=0, dtype=np.float64)  # synchronises
    gram = np.zeros((RIPPLE_TERMS, RIPPLE_TERMS))
    gram[tuple(np.transpose(_UPPER))] = sums[:_CORNERS]
    gram += np.triu(gram, 1).T + PRIOR_SAMPLES * np.eye(RIPPLE_TERMS)
    return np.asarray(np.linalg.solve(gram, sums[_CORNERS:-1]), np.float32)
