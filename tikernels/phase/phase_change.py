"""The usual change of the phase from pixel to pixel, along the stripes and across them, and how sure pixels are."""

from enum import IntEnum

import numpy as np

from tikernels import checks, runtime
from tikernels._taichi import F32Array2, ti
from tikernels.arrays import F32
from tikernels.launching import kernel
from tikernels.phase.phase_vector import TINY
from tikernels.phase.wrapped_phase import has_phase

#: The usual change is measured at every eighth pixel both ways.
SAMPLE = 8
#: Places in the last row of what `measure_rates` fills: the usual change along and across the stripes, rad per px, and
#: the mean quality.
RATE_ALONG, RATE_ACROSS, MEAN_QUALITY = 0, 1, 2
#: Light is even where the phase changes across the stripes by less than this share of what is usual. On surfaces, even
#: those that the projector grazes, it is .4 and more; in shadows of a lit room and beyond the projector's picture .05.
LEAST_CHANGE = 0.2


class _RowSum(IntEnum):
    """Columns of the other rows of what `measure_rates` fills."""

    ALONG_COSINE = 0  # of the changes along the stripes, summed up
    ALONG_SINE = 1
    ACROSS_COSINE = 2
    ACROSS_SINE = 3
    QUALITY = 4  # the row's mean


def rates_buffer(height: int) -> F32:
    """Allocate what `measure_rates` fills for frames of this height."""
    return runtime.empty(rates_shape(height), np.float32)


def rates_shape(height: int) -> tuple[int, int]:
    """Return the shape of what `measure_rates` fills for frames of this height."""
    return (-(-height // SAMPLE) + 1, len(_RowSum))


def measure_rates(phase: F32, quality: F32, out: F32 | None = None) -> F32:
    """Measure the usual change of the phase from pixel to pixel, and the mean quality.

    A change counts by the square of its quality, as its variance has it: even light of a lit room, which has the phase
    of its colour and a tenth of a surface's modulation, may fill most of a frame.

    Parameters
    ----------
    phase : (H, W) float32
        rad; NO_PHASE outside the mask.
    quality : (H, W) float32
        Quality of each pixel, in any unit, as its modulation.
    out : (H / 8 + 1, 5) float32, optional
        Output array; see `rates_buffer`.

    Returns
    -------
    (H / 8 + 1, 5) float32
        In the last row, at RATE_ALONG and RATE_ACROSS, the usual change along and across the stripes, rad per px, and
        at MEAN_QUALITY the mean quality; the rows before are sums over rows of the image.

    Raises
    ------
    ShapeError
        A shape or dtype is another one, or `out` cannot be written.
    """
    phase = checks.read_array("phase", phase, (None, None), np.float32)
    quality = checks.read_array("quality", quality, phase.shape, np.float32)
    out = checks.out_buffer("out", out, rates_shape(int(phase.shape[0])), np.float32)
    measure_rates_kernel(phase, quality, out)
    return out


@kernel
def measure_rates_kernel(
    phase: F32Array2,  # (H, W) rad; NO_PHASE outside the mask
    quality: F32Array2,  # (H, W)
    out_rates: F32Array2,  # (H / 8 + 1, 5) see `_RowSum`; in the last row RATE_ALONG ...
):
    height, width = phase.shape[0], phase.shape[1]
    rows = out_rates.shape[0] - 1
    for i in range(rows):
        y = ti.min(i * SAMPLE, ti.max(height - 2, 0))
        along, across = ti.Vector([0.0, 0.0]), ti.Vector([0.0, 0.0])
        total, count = 0.0, 0.0
        for j in range((width + SAMPLE - 1) // SAMPLE):
            x = ti.min(j * SAMPLE, ti.max(width - 2, 0))
            if has_phase(phase[y, x]):
                total += quality[y, x]
                count += 1.0
                # NaN is no quality, and the square of a larger one no float32.
                certain = ti.select(quality[y, x] > TINY, ti.min(quality[y, x], 1.0 / TINY), TINY)
                weight = certain * certain
                if x + 1 < width:
                    if has_phase(phase[y, x + 1]):
                        change = phase[y, x + 1] - phase[y, x]
                        along += weight * ti.Vector([ti.cos(change), ti.sin(change)])
                if y + 1 < height:
                    if has_phase(phase[y + 1, x]):
                        change = phase[y + 1, x] - phase[y, x]
                        across += weight * ti.Vector([ti.cos(change), ti.sin(change)])
        out_rates[i, _RowSum.ALONG_COSINE] = along.x
        out_rates[i, _RowSum.ALONG_SINE] = along.y
        out_rates[i, _RowSum.ACROSS_COSINE] = across.x
        out_rates[i, _RowSum.ACROSS_SINE] = across.y
        out_rates[i, _RowSum.QUALITY] = total / ti.max(count, 1.0)
    # One thread adds the rows up in order, so that the sum is the same every time.
    ti.loop_config(serialize=True)
    for _ in range(1):
        # Without phases nothing changes.
        along, across = ti.Vector([TINY * TINY, 0.0]), ti.Vector([TINY * TINY, 0.0])
        total, count = 0.0, 0.0
        for i in range(rows):
            along += ti.Vector([out_rates[i, _RowSum.ALONG_COSINE], out_rates[i, _RowSum.ALONG_SINE]])
            across += ti.Vector([out_rates[i, _RowSum.ACROSS_COSINE], out_rates[i, _RowSum.ACROSS_SINE]])
            if out_rates[i, _RowSum.QUALITY] > 0.0:
                total += out_rates[i, _RowSum.QUALITY]
                count += 1.0
        out_rates[rows, RATE_ALONG] = ti.atan2(along.y, along.x)
        out_rates[rows, RATE_ACROSS] = ti.atan2(across.y, across.x)
        out_rates[rows, MEAN_QUALITY] = ti.max(total / ti.max(count, 1.0), TINY)
        for k in range(MEAN_QUALITY + 1, out_rates.shape[1]):
            out_rates[rows, k] = 0.0
