"""Smooth the phase along the stripes, where it changes least, without crossing a step.

A pixel at a step sees both surfaces and has a phase between them that belongs to neither: such pixels are dropped.
"""

from functools import cache
from typing import Any

import numpy as np

from tikernels import checks, runtime
from tikernels._taichi import F32Array2, Static, f32, i32, ti, u1
from tikernels.arrays import F32, Mask
from tikernels.errors import ShapeError
from tikernels.phase.phase_vector import PI, wrap
from tikernels.phase.wrapped_phase import NO_PHASE, STEP_PHASE, has_phase, mark_no_phase_kernel
from tikernels.strips import STRIP, strip_at, strip_count

# A pair of neighbours left and right counts while each is within a radian of the pixel and the surface bends less
# between them than noise makes it, four standard deviations, of which one of three pixels weighs twice; or than the
# least, which round surfaces do within a few px. Beyond the most, some 4 mm on a rig with 0.14 rad a mm, it is a step.
_BEND_SIGMAS = 4.0 * 6.0**0.5
_LEAST_BEND, _MAX_BEND = 0.1, 0.6
_MAX_CHANGE = 1.0
# A neighbour that departs by more than this from the usual change lies on another surface: 0.8 rad is a depth step of
# 6 mm on that rig; noise of 0.2 rad a pixel passes.
MAX_DEPARTURE = 0.8
# Departures beyond this mean that there is no neighbour: no two phases are that far apart.
NO_NEIGHBOUR = 0.5 * NO_PHASE
# A pixel at a step that departs by less than this from one side belongs to that side.
_SAME_SURFACE = 0.3
# Every eighth pixel both ways tells the usual change.
_SAMPLE = 8
#: Places in the last row of what `measure_rates` fills: the usual change along and across the stripes, rad a px, and
#: the mean quality.
RATE_ALONG, RATE_ACROSS, MEAN_QUALITY = range(3)
# Places in its other rows: sums of the changes' cosines and sines along and across, and the row's mean quality.
_ALONG_COSINE, _ALONG_SINE, _ACROSS_COSINE, _ACROSS_SINE, _ROW_QUALITY = range(5)


@ti.func
def between_surfaces(one: f32, other: f32) -> u1:
    """Whether a pixel that is this far from its neighbours on either side belongs to neither's surface."""
    low, high = ti.min(one, other), ti.max(one, other)
    farthest = ti.select(high < NO_NEIGHBOUR, high, low)
    return (farthest > MAX_DEPARTURE) & (farthest < NO_NEIGHBOUR) & (low > _SAME_SURFACE)


@ti.func
def departure(difference: f32, rate: f32) -> f32:
    """How far a difference of two phases is from the usual change, modulo a cycle, rad."""
    size = ti.abs(difference - rate)
    return ti.min(size, ti.abs(size - 2.0 * PI))


@ti.func
def largest_bend(precision: f32) -> f32:
    """Return how much the phase may bend between two neighbours left and right of a pixel, rad."""
    return ti.min(ti.max(_BEND_SIGMAS / ti.sqrt(precision + 1e-6), _LEAST_BEND), _MAX_BEND)


@ti.func
def mean_correction(values: Static, middle: i32, pairs: Static, max_bend: f32) -> f32:
    """Return what to add to a phase of a row to make it the mean with its neighbours.

    They count in pairs, so that a steady slope along the stripe leaves no bias.
    """
    total, count = 0.0, 1.0
    for tap in ti.static(range(1, pairs + 1)):
        left, right = wrap(values[middle - tap] - values[middle]), wrap(values[middle + tap] - values[middle])
        near = ti.max(ti.abs(left), ti.abs(right)) < _MAX_CHANGE
        # Fading, so that rounding decides nothing.
        counts = ti.min(ti.max(2.5 - 2.0 * ti.abs(left + right) / max_bend, 0.0), 1.0)
        counts = ti.select(near, counts, 0.0)
        total += counts * ti.select(near, left + right, 0.0)
        count += 2.0 * counts
    return total / count


@cache
def _smooth_phase_kernel(pairs: int) -> Any:
    """Return the kernel that averages over `pairs` neighbours on either side."""
    reach = max(pairs, 1)
    window = 2 * reach + STRIP
    taps, lanes = ti.types.vector(window, ti.f32), ti.types.vector(STRIP, ti.f32)

    @ti.kernel
    def smooth_phase_kernel(
        phase: F32Array2,  # (H, W) rad, up to 0.6 beyond +-pi; NO_PHASE outside the mask
        precision: F32Array2,  # (H, W) 1 / rad^2: one over the phase's variance
        rates: F32Array2,  # last row: RATE_ALONG, RATE_ACROSS ..., rad a px
        out: F32Array2,  # (H, W) rad, a little beyond +-pi; NO_PHASE outside the mask, STEP_PHASE between two surfaces
    ):
        height, width = phase.shape[0], phase.shape[1]
        last = rates.shape[0] - 1
        for t in range(height * strip_count(width, STRIP)):
            y, first, length = strip_at(t, width, STRIP)
            above, below = ti.max(y - 1, 0), ti.min(y + 1, height - 1)
            rate_along, rate_across = rates[last, RATE_ALONG], rates[last, RATE_ACROSS]
            values = taps(0.0)
            upper, lower, certainty, result = lanes(0.0), lanes(0.0), lanes(0.0), lanes(0.0)
            for k in range(window):
                values[k] = NO_PHASE
            for k in range(ti.max(0, reach - first), ti.min(window, width - first + reach)):
                values[k] = phase[y, first - reach + k]
            for k in range(length):
                upper[k], lower[k] = phase[above, first + k], phase[below, first + k]
                certainty[k] = precision[y, first + k]
            for k in range(STRIP):
                centre = values[reach + k]
                # Without a neighbour the differences stay far beyond any phase.
                to_left = ti.abs(wrap(values[reach + k - 1] - centre) + rate_along)
                to_right = ti.abs(wrap(values[reach + k + 1] - centre) - rate_along)
                to_upper = departure(centre - upper[k], rate_across)
                to_lower = departure(lower[k] - centre, rate_across)
                to_upper = ti.select(above == y, 2.0 * NO_NEIGHBOUR, to_upper)
                to_lower = ti.select(below == y, 2.0 * NO_NEIGHBOUR, to_lower)
                step = between_surfaces(to_left, to_right) | between_surfaces(to_upper, to_lower)
                correction = mean_correction(values, reach + k, pairs, largest_bend(certainty[k]))
                value = ti.select(step, STEP_PHASE, centre + correction)
                result[k] = ti.select(has_phase(centre), value, NO_PHASE)
            for k in range(length):
                out[y, first + k] = result[k]

    return smooth_phase_kernel


def rates_buffer(height: int) -> F32:
    """Allocate what `measure_rates` fills for frames of this height."""
    return runtime.empty(_rates_shape(height), np.float32)


def _rates_shape(height: int) -> tuple[int, int]:
    return (-(-height // _SAMPLE) + 1, 5)


def measure_rates(phase: F32, quality: F32, out: F32 | None = None) -> F32:
    """Measure the usual change of the phase from pixel to pixel, and the mean quality.

    Parameters
    ----------
    phase : (H, W) float32
        rad; NO_PHASE outside the mask.
    quality : (H, W) float32
        How sure each pixel is, in any unit, as its modulation.
    out : (H / 8 + 1, 5) float32, optional
        Where the result goes; see `rates_buffer`.

    Returns
    -------
    (H / 8 + 1, 5) float32
        In the last row, at RATE_ALONG and RATE_ACROSS, the usual change along and across the stripes, rad a px, and at
        MEAN_QUALITY the mean quality; the rows before are sums over rows of the image.

    Raises
    ------
    ShapeError
        A shape or dtype is another one, or `out` cannot be written.
    """
    phase = checks.read_array("phase", phase, (None, None), np.float32)
    quality = checks.read_array("quality", quality, phase.shape, np.float32)
    out = checks.out_buffer("out", out, _rates_shape(int(phase.shape[0])), np.float32)
    measure_rates_kernel(phase, quality, out)
    return out


def smooth_phase(phase: F32, precision: F32, rates: F32, pairs: int, out: F32 | None = None) -> F32:
    """Average the phase over a few pixels along the rows, and mark the pixels between two surfaces.

    Parameters
    ----------
    phase : (H, W) float32
        rad, up to 0.6 beyond [-pi, pi]; NO_PHASE outside the mask.
    precision : (H, W) float32
        1 / rad^2, one over the phase's variance; 0 where nothing is known of it.
    rates : (H / 8 + 1, 5) float32
        What `measure_rates` found of the same phase.
    pairs : int
        Neighbours on either side that are averaged, 0 or more.
    out : (H, W) float32, optional
        Where the result goes; not the input.

    Returns
    -------
    (H, W) float32
        rad, a little beyond [-pi, pi]; NO_PHASE outside the mask, STEP_PHASE between two surfaces.

    Raises
    ------
    ShapeError
        A shape or dtype is another one, or `out` cannot be written.
    """
    phase = checks.read_array("phase", phase, (None, None), np.float32)
    shape = (int(phase.shape[0]), int(phase.shape[1]))
    precision = checks.read_array("precision", precision, shape, np.float32)
    rates = checks.read_array("rates", rates, _rates_shape(shape[0]), np.float32)
    out = checks.out_buffer("out", out, shape, np.float32)
    _smooth_phase_kernel(pairs)(phase, precision, rates, out)
    return out


@ti.kernel
def measure_rates_kernel(
    phase: F32Array2,  # (H, W) rad; NO_PHASE outside the mask
    quality: F32Array2,  # (H, W)
    out_rates: F32Array2,  # (H / 8 + 1, 5) see _ALONG_COSINE and so on; in the last row RATE_ALONG ...
):
    height, width = phase.shape[0], phase.shape[1]
    rows = out_rates.shape[0] - 1
    for i in range(rows):
        y = ti.min(i * _SAMPLE, ti.max(height - 2, 0))
        along, across = ti.Vector([0.0, 0.0]), ti.Vector([0.0, 0.0])
        total, count = 0.0, 0.0
        for j in range((width + _SAMPLE - 1) // _SAMPLE):
            x = ti.min(j * _SAMPLE, ti.max(width - 2, 0))
            if has_phase(phase[y, x]):
                total += quality[y, x]
                count += 1.0
                if x + 1 < width:
                    if has_phase(phase[y, x + 1]):
                        change = phase[y, x + 1] - phase[y, x]
                        along += ti.Vector([ti.cos(change), ti.sin(change)])
                if y + 1 < height:
                    if has_phase(phase[y + 1, x]):
                        change = phase[y + 1, x] - phase[y, x]
                        across += ti.Vector([ti.cos(change), ti.sin(change)])
        out_rates[i, _ALONG_COSINE] = along.x
        out_rates[i, _ALONG_SINE] = along.y
        out_rates[i, _ACROSS_COSINE] = across.x
        out_rates[i, _ACROSS_SINE] = across.y
        out_rates[i, _ROW_QUALITY] = total / ti.max(count, 1.0)
    # One thread adds the rows up in order, so that the sum is the same every time.
    ti.loop_config(serialize=True)
    for _ in range(1):
        along, across = ti.Vector([1e-6, 0.0]), ti.Vector([1e-6, 0.0])
        total, count = 0.0, 0.0
        for i in range(rows):
            along += ti.Vector([out_rates[i, _ALONG_COSINE], out_rates[i, _ALONG_SINE]])
            across += ti.Vector([out_rates[i, _ACROSS_COSINE], out_rates[i, _ACROSS_SINE]])
            if out_rates[i, _ROW_QUALITY] > 0.0:
                total += out_rates[i, _ROW_QUALITY]
                count += 1.0
        out_rates[rows, RATE_ALONG] = ti.atan2(along.y, along.x)
        out_rates[rows, RATE_ACROSS] = ti.atan2(across.y, across.x)
        out_rates[rows, MEAN_QUALITY] = ti.max(total / ti.max(count, 1.0), 1e-12)
        for k in range(MEAN_QUALITY + 1, out_rates.shape[1]):
            out_rates[rows, k] = 0.0


@ti.kernel
def restore_kernel(
    wrapped_phase: F32Array2,  # (H, W) rad
    out: F32Array2,  # (H, W) rad; wrapped; what is NO_PHASE becomes the input's phase
):
    for pixel in range(wrapped_phase.shape[0] * wrapped_phase.shape[1]):
        y, x = pixel // wrapped_phase.shape[1], pixel % wrapped_phase.shape[1]
        smoothed = out[y, x]
        out[y, x] = wrap(smoothed) if has_phase(smoothed) else wrapped_phase[y, x]


def smooth_along_stripes(wrapped_phase: F32, mask: Mask, smoothing_px: int = 5, *, out: F32 | None = None) -> F32:
    """Average the phase over a few pixels along the rows.

    Parameters
    ----------
    wrapped_phase : (H, W) float32
        rad in [-pi, pi], stripes running along the rows.
    mask : (H, W) bool or uint8
        Valid pixels.
    smoothing_px : int
        Odd length of the window, 1 to 33 px.
    out : (H, W) float32, optional
        Where the result goes; not the input.

    Returns
    -------
    (H, W) float32
        rad in [-pi, pi]; unchanged outside the mask and at steps. Neighbours count in pairs left and right, and only
        while the surface goes on, so steps stay sharp and slopes unbiased.

    Raises
    ------
    ShapeError
        A shape or dtype is another one, the window is even or too long, or `out` cannot be written.
    """
    wrapped_phase = checks.read_array("wrapped_phase", wrapped_phase, (None, None), np.float32)
    shape = (int(wrapped_phase.shape[0]), int(wrapped_phase.shape[1]))
    mask = checks.read_mask("mask", mask, shape)
    if smoothing_px % 2 == 0 or not 1 <= smoothing_px <= 33:
        raise ShapeError(f"smoothing_px is {smoothing_px}: take an odd number from 1 to 33")
    out = checks.out_array("out", out, shape, np.float32)
    marked = np.empty(shape, np.float32)
    mark_no_phase_kernel(wrapped_phase, mask, marked)
    of_noise_nothing_is_known = np.zeros(shape, np.float32)
    smooth_phase(marked, of_noise_nothing_is_known, measure_rates(marked, marked), smoothing_px // 2, out=out)
    restore_kernel(wrapped_phase, out)
    return out
