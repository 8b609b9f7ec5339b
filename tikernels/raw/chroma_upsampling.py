"""Turn luma and subsampled chroma into RGB without losing the fringe, which is in the chroma.

A chroma sample is the mean over the pixels about its site, as many as it represents: of two, at a period of p px, that
takes 1 - cos(pi / p) of the chroma's modulation (3.4 % at 12 px) and none of the luma's. A straight line between
samples takes three times as much again, and differently from row to row; repeating them, as libraries do for speed,
costs 0.26 rad. So each pixel takes the value of the polynomial whose means at the nearest six samples (five on a
sample's own site) are those samples: Lagrange's interpolation, for means instead of points.

R, G, B follow from the definition of luma, Y = kr R + kg G + kb B, Cb = (B - Y) / (2 (1 - kb)) and
Cr = (R - Y) / (2 (1 - kr)) (Rec. ITU-R BT.601-7, BT.709-6, BT.2020-2 without constant luminance).
"""

from functools import cache
from typing import Any, TypeAlias

import numpy as np

from tikernels import checks
from tikernels._taichi import AnyArray2, F32Array3, Static, f32, i32, ti, vec2, vec3
from tikernels.arrays import F32, Plane
from tikernels.launching import kernel
from tikernels.raw.pixel_format import LUMA_WEIGHTS, SITES, PixelFormat

#: How far the interpolation reaches, samples to either side.
_REACH = 3
#: Weights along one axis: by pixel of a group, of the seven nearest samples.
Taps: TypeAlias = tuple[tuple[float, ...], ...]
# Groups of pixels that share their columns of chroma: more of them pay little and compile slowly.
_GROUPS_A_THREAD = 4


@cache
def chroma_taps(subsampling: int, site: float) -> Taps:
    """Return the weights of the seven nearest samples along one axis, for each pixel of its group.

    Parameters
    ----------
    subsampling : int
        Pixels per sample.
    site : float
        Place of a sample: 0, on its first pixel, to 1, on its last.
    """
    if subsampling == 1:
        return ((0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0),)
    phases = []
    averaged = np.arange(subsampling) - (subsampling - 1) / 2  # px from its site, whose mean a sample is
    for pixel in range(subsampling):
        place = pixel - site * (subsampling - 1)  # px from the group's own sample
        first, last = (-2, 2) if place == 0 else (-_REACH, 2) if place < 0 else (-2, _REACH)
        samples = np.arange(first, last + 1)
        powers = np.arange(len(samples))[:, None]
        means = np.mean([(subsampling * samples + part) ** powers for part in averaged], axis=0)
        taps = np.zeros(2 * _REACH + 1)
        taps[samples + _REACH] = np.linalg.solve(means, place ** powers[:, 0])
        phases.append(tuple(float(tap) for tap in taps))
    return tuple(phases)


def ycc_scales(format: PixelFormat) -> tuple[float, float, float, float]:
    """Return luma's black level and gain, and chroma's zero level and gain, that give Y in 0..1 and C in -0.5..0.5."""
    step = float(2 ** (format.bits - 8 + format.shift))  # one level of 8 bits
    if format.full_range:
        return 0.0, 1 / format.white_level, 128 * step, 1 / format.white_level
    return 16 * step, 1 / (219 * step), 128 * step, 1 / (224 * step)


def chroma_gains(format: PixelFormat) -> tuple[float, float, float, float]:
    """Return what Cr adds to red, Cb and Cr to green, and Cb to blue."""
    red, blue = LUMA_WEIGHTS[format.matrix]
    of_red, of_blue = 2 * (1 - red), 2 * (1 - blue)
    green = 1 - red - blue
    return of_red, -of_blue * blue / green, -of_red * red / green, of_blue


@cache
def _convert_chroma_kernel(rows: Taps, columns: Taps, origin: tuple[int, int]) -> Any:
    group_y, group_x = len(rows), len(columns)
    reach = _REACH if group_x > 1 else 0
    n_columns = _GROUPS_A_THREAD + 2 * reach
    left, above = origin

    @ti.func
    def at_row(chroma: Static, row: Static, y: i32, x: i32) -> f32:
        """Return chroma at the middle of a row of pixels, the `row`-th of sample y's group."""
        value = 0.0
        for k in ti.static(range(2 * _REACH + 1)):
            if ti.static(rows[row][k] != 0):
                near = ti.min(ti.max(y + (k - _REACH), 0), chroma.shape[0] - 1)
                value += rows[row][k] * ti.cast(chroma[near, x], ti.f32)
        return value

    @ti.func
    def between(values: Static, group: Static, pixel: Static) -> f32:
        """Return chroma at a pixel of a group, given the samples of several groups in a row."""
        value = 0.0
        for i in ti.static(range(-reach, reach + 1)):
            if ti.static(columns[pixel][i + _REACH] != 0):
                value += columns[pixel][i + _REACH] * values[group + reach + i]
        return value

    @ti.func
    def write_color(out: F32Array3, y: i32, x: i32, color: vec3):
        """Write the three channels of a pixel."""
        for i in ti.static(range(3)):
            out[y, x, i] = color[i]

    @kernel
    def convert_chroma_kernel(
        luma: AnyArray2,  # (H, W) levels
        blue_chroma: AnyArray2,  # (H', W') levels
        red_chroma: AnyArray2,  # the same
        luma_scale: vec2,  # black level, gain
        chroma_scale: vec2,  # zero level, gain
        red_gain: f32,  # of Cr
        green_gains: vec2,  # of Cb and Cr
        blue_gain: f32,  # of Cb
        out: F32Array3,  # (H, W, 3) encoded RGB, 0..1
    ):
        width = blue_chroma.shape[1]
        strips = (width + _GROUPS_A_THREAD - 1) // _GROUPS_A_THREAD
        for strip in range(blue_chroma.shape[0] * strips):
            group, start = strip // strips, strip % strips * _GROUPS_A_THREAD
            for row in ti.static(range(group_y)):
                y = group * group_y + row - above
                if y >= 0 and y < out.shape[0]:
                    blues, reds = ti.Vector.zero(ti.f32, n_columns), ti.Vector.zero(ti.f32, n_columns)
                    for k in ti.static(range(n_columns)):
                        x = ti.min(ti.max(start + (k - reach), 0), width - 1)
                        blues[k] = at_row(blue_chroma, row, group, x) - chroma_scale[0]
                        reds[k] = at_row(red_chroma, row, group, x) - chroma_scale[0]
                    for k, pixel in ti.static(ti.ndrange(_GROUPS_A_THREAD, group_x)):
                        x = (start + k) * group_x + pixel - left
                        if x >= 0 and x < out.shape[1]:
                            blue = chroma_scale[1] * between(blues, k, pixel)
                            red = chroma_scale[1] * between(reds, k, pixel)
                            grey = luma_scale[1] * (ti.cast(luma[y, x], ti.f32) - luma_scale[0])
                            color = vec3(
                                grey + red_gain * red,
                                grey + green_gains[0] * blue + green_gains[1] * red,
                                grey + blue_gain * blue,
                            )
                            write_color(out, y, x, ti.min(ti.max(color, 0.0), 1.0))

    return convert_chroma_kernel


def convert_chroma(planes: tuple[Plane, ...], format: PixelFormat, out: F32 | None = None) -> F32:
    """Turn luma and chroma planes into RGB.

    Parameters
    ----------
    planes : (H, W) and two (H', W')
        Luma and chroma as stored, see `PixelFormat`; rows may be padded.
    format : PixelFormat
        Storage format; its layout is "yuv".
    out : (H, W, 3) float32, optional
        Output array.

    Returns
    -------
    (H, W, 3) float32
        Encoded RGB in 0..1, in a buffer of the device if none is given. What noise and interpolation take outside is
        cut: one value in a thousand, nearly all of them at the edges of shadows, where it changes nothing measurable
        in the phase; and what was saturated stays so.

    Raises
    ------
    ShapeError
        A plane has another shape or type than the format specifies, or `out` cannot be written.

    Examples
    --------
    >>> import numpy as np, tikernels
    >>> from tikernels.raw.pixel_format import PixelFormat
    >>> _ = tikernels.init("cpu")
    >>> white, neutral = np.full((2, 2), 235, np.uint8), np.full((1, 1), 128, np.uint8)
    >>> format = PixelFormat("yuv", subsampling=(2, 2))
    >>> [round(float(value), 3) for value in convert_chroma((white, neutral, neutral), format)[0, 0]]
    [1.0, 1.0, 1.0]
    """
    luma = checks.read_array("luma", planes[0], (None, None), format.dtype)
    height, width = luma.shape
    shape = format.plane_shapes(height, width)[1]
    blue_chroma, red_chroma = (
        checks.read_array(name, plane, shape, format.dtype)
        for name, plane in zip(("blue chroma", "red chroma"), planes[1:], strict=True)
    )
    out = checks.out_buffer("out", out, (height, width, 3), np.float32)
    black, luma_gain, zero, chroma_gain = ycc_scales(format)
    red, green_of_blue, green_of_red, blue = chroma_gains(format)
    x, y = format.subsampling
    across, down = SITES[format.siting]
    _convert_chroma_kernel(chroma_taps(y, down), chroma_taps(x, across), format.origin)(
        luma,
        blue_chroma,
        red_chroma,
        vec2(black, luma_gain),
        vec2(zero, chroma_gain),
        red,
        vec2(green_of_blue, green_of_red),
        blue,
        out,
    )
    return out
