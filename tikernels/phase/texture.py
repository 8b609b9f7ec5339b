"""The surface's colour without the fringe, as pictures and meshes hold it: sRGB, eight bits.

What every pixel would show under the projector's white (`white_light.py`), less what still follows the fringe all over
the frame (`brightness_ripple.py`), divided by what a white surface would show, and encoded.
"""

from functools import cache

import numpy as np
import numpy.typing as npt

from tikernels import checks
from tikernels._taichi import AnyArray3, F32Array1, F32Array2, F32Array3, I32Array1, U8Array2, f32, i32, ti, vec3
from tikernels.arrays import F32, U8, Mask
from tikernels.launching import constant, kernel
from tikernels.phase.brightness_ripple import contrast_slope, measure_ripple, ripple_at
from tikernels.phase.phase_vector import color_at
from tikernels.phase.white_light import FrameLight, light_by_white
from tikernels.raw.linearization import srgb_values
from tikernels.strips import STRIP, strip_at, strip_count

#: What 255 stands for, in units of full scale: under white all primaries reach a channel, under a fringe hardly more
#: than one, so that what leaks, up to a third of it, would be beyond full scale; and a channel that the fringe clips by
#: a tenth follows from the two others.
BRIGHTEST = 1.5
# Places of the table that encodes: from one to the next are 0.1 levels.
_ROOTS = 4096
lanes = ti.types.vector(STRIP, ti.f32)


@kernel
def encode_texture_kernel(
    light: F32Array3,  # (H, W, 3) levels; zeros off the mask
    phase: F32Array2,  # (H, W) rad
    contrast: F32Array2,  # (H, W) logarithm of the fringe's contrast
    mask: U8Array2,  # (H, W)
    ripple: F32Array1,  # (6,) see `measure_ripple`
    slope: f32,  # see `contrast_slope`
    mean: f32,  # of the contrast
    scale: F32Array1,  # (3,) levels to 0..1
    encoded: I32Array1,  # (places,) sRGB of evenly spaced square roots of light
    out: AnyArray3,  # (H, W, 3) uint8 sRGB
):
    """Take off what follows the fringe, and encode."""
    for strip in range(light.shape[0] * strip_count(light.shape[1], STRIP)):
        y, first, count = strip_at(strip, light.shape[1], STRIP)
        even, slow, factors, last = lanes(0.0), lanes(0.0), vec3(scale[0], scale[1], scale[2]), encoded.shape[0] - 1
        for k in range(count):
            if mask[y, first + k] != 0:
                even[k], slow[k] = phase[y, first + k], slope * (contrast[y, first + k] - mean)
        for k in range(STRIP):
            even[k] = ti.exp(-ripple_at(ripple, even[k]) - slow[k])
        for k in range(count):
            color = even[k] * color_at(light, y, first + k) * factors
            for i in ti.static(range(3)):
                place = ti.sqrt(ti.min(color[i], 1.0)) * last + 0.5
                out[y, first + k, i] = ti.cast(encoded[ti.cast(place, i32)], ti.u8)


@cache
def srgb_table() -> npt.NDArray[np.int32]:
    """Return sRGB of 0 to 255 for evenly spaced square roots of light of 0 to 1 (IEC 61966-2-1)."""
    light = np.linspace(0, 1, _ROOTS) ** 2
    return constant(np.rint(255 * srgb_values(light)).astype(np.int32))


def measure_texture(light: FrameLight, phase: F32, mask: Mask, period_px: float, out: U8 | None = None) -> U8:
    """Return the surface's colour without the fringe.

    Parameters
    ----------
    light : FrameLight
        Image and model of the frame.
    phase : (H, W) float32
        rad, smoothed, wrapped or not; of no account off the mask.
    mask : (H, W) bool or uint8
        Valid pixels.
    period_px : float
        Camera px per cycle.
    out : (H, W, 3) uint8, optional
        Output array.

    Returns
    -------
    (H, W, 3) uint8
        sRGB, 255 at `BRIGHTEST` times full scale; 0 off the mask. In a buffer of the device if none is given.

    Raises
    ------
    ShapeError
        A shape or dtype is another one, or `out` cannot be written.
    """
    shape = (int(light.image.shape[0]), int(light.image.shape[1]))
    phase = checks.read_array("phase", phase, shape, np.float32)
    valid = checks.read_mask("mask", mask, shape)
    out = checks.out_buffer("out", out, (*shape, 3), np.uint8)
    shown, brightness, contrast = light_by_white(light, phase, valid, period_px)
    ripple = measure_ripple(brightness, phase, valid, period_px)
    scale = np.asarray(1 / (BRIGHTEST * light.white * light.neutral), np.float32)
    slope, mean = contrast_slope(brightness, contrast, valid, period_px) if light.coded else (0.0, 0.0)
    encode_texture_kernel(shown, phase, contrast, valid, ripple, slope, mean, scale, srgb_table(), out)
    return out
