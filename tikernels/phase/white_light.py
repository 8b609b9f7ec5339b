"""A pixel's light under the projector's white, computed from its light under the fringe.

The channels' model (`channel_model.py`) is C_i = s A_i t_i(phi) + B_i, or T of that where a surface has a crosstalk of
its own (`surfaces.py`). Around the smoothed phase the model of a pixel is linear in its brightness s, a step d of the
phase and a deviation k of its contrast, and three channels determine three numbers:

    c = C - B = s (M + d M' + k W),    M = A t, W = A (t - 1),    s = c.(W x M') / M.(W x M').

So neither a phase nor a contrast that is a little off shows in s. k is not the surface's but the pattern's and the
lens', and is averaged over a part of a cycle. With the template's peak P of `white_level.py` for t,

    white_i = s A_i (P_i + k (P_i - 1)) + B_i,    kappa = s (1 + k) / (s + B / A).

Ambient light is in it: under a code, the window of A and B holds but a few cycles, and what B has of their contrast
cannot be separated from it. kappa is the contrast of the fringe relative to the template's. A pixel with a clipped
channel has a phase that is a little off, and two channels that are dark: it takes s, RMS, from those within the window
of k; where there are none, its two other channels determine s, with d = 0.

The colour of that light is A's, smooth over about a cycle, but for edges between surfaces that the frame distinguishes;
its brightness is every pixel's own. What of that still follows the fringe `brightness_ripple.py` finds.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from tikernels import checks, runtime
from tikernels._taichi import AnyArray3, F32Array1, F32Array2, F32Array3, Static, U8Array2, f32, i32, ti, vec3
from tikernels.arrays import F32, LevelsImage, Mask
from tikernels.lanes import LANES, float_lanes
from tikernels.launching import kernel
from tikernels.phase.brightness_ripple import within_cycle
from tikernels.phase.channel_template import load_harmonics, sharpened_cycle_and_slope
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.phase_fit import lane_of, nodes_between
from tikernels.phase.phase_vector import TINY, channel_mean, color_at
from tikernels.phase.surfaces import surface_ambient, surface_at, surface_matrix
from tikernels.phase.white_level import white_level
from tikernels.phase.wide_blur import wide_blur
from tikernels.raw.linearization import LEVEL_TYPES
from tikernels.strips import color_of, lanes_of_colors, set_color, strip_at, strip_count

# The window of k, across the stripes and along them, as a standard deviation in cycles: across, a code's contrast
# changes by up to a sixth from one cycle to the next; along, by nothing. Without any, the second and third harmonic of
# what the model gets wrong are 5 and 10 dB stronger.
_CONTRAST_ACROSS, _CONTRAST_ALONG = 0.25, 0.4
# Contrasts beyond are no pattern's: a code's differ by a sixth from their mean.
_MOST_CONTRAST = 0.3
# kappa has all that A and B took over in it, and ambient light; beyond these it is of no fringe.
_LOWEST, _HIGHEST = 0.5, 1.5


@dataclass(frozen=True, eq=False)
class FrameLight:
    """Light kept of a decoded frame, stripes along the rows."""

    image: LevelsImage
    """(H, W, 3) linear light, levels."""
    white: float
    """Full scale, levels."""
    clipped: float
    """From here on a channel is clipped, levels."""
    nodes: F32
    """(Hg, Wg, 6) A and B."""
    sharpness: F32
    """(Hg, Wg) see `fringe_sharpness.py`."""
    spacing_px: int
    """Between nodes."""
    template: npt.NDArray[np.float32]
    """(3, terms) t."""
    crosstalk: Crosstalk
    """Crosstalk of the model."""
    neutral: npt.NDArray[np.float32]
    """(3,) what a white surface shows under the projector's white, over the channels' mean; ones: not known."""
    coded: bool
    """True if the pattern's contrast changes from cycle to cycle."""


@ti.func
def surface_model(
    cycle: vec3,
    slope: vec3,
    color: vec3,
    ambient: vec3,
    surface: i32,
    mixing: F32Array3,
    besides: F32Array2,
    mixed: Static,
):
    """Return a pixel's channels M, their change with phase M' and contrast W, all for s = 1, and with ambient B."""
    model, change, swing, rest = color * cycle, color * slope, color * (cycle - 1.0), ambient
    if ti.static(mixed):
        matrix = surface_matrix(mixing, surface)
        model, change, swing = matrix @ model, matrix @ change, matrix @ swing
        rest = matrix @ ambient + surface_ambient(besides, surface)
    return model, change, swing, rest


@ti.func
def solved(light: vec3, model: vec3, change: vec3, swing: vec3):
    """Return s and s k of the module."""
    across = swing.cross(change)
    determinant = model.dot(across)
    reciprocal = ti.select(ti.abs(determinant) > TINY, 1.0 / determinant, 0.0)
    return light.dot(across) * reciprocal, light.dot(change.cross(model)) * reciprocal


@cache
def _measure_swing_kernel(mixed: bool, spacing_px: int) -> Any:
    """Return the kernel that measures contrasts, for nodes that are `spacing_px` px apart."""

    @kernel
    def measure_swing_kernel(
        image: AnyArray3,  # (H, W, 3) levels
        phase: F32Array2,  # (H, W) rad
        mask: U8Array2,  # (H, W)
        labels: U8Array2,  # (H, W) see `Surfaces`
        mixing: F32Array3,  # (N, 3, 3)
        besides: F32Array2,  # (N, 3) levels
        template: F32Array2,  # (3, terms)
        nodes: F32Array3,  # (Hg, Wg, 6) A and B
        sharpness: F32Array2,  # (Hg, Wg)
        clipped: f32,  # levels
        out: F32Array3,  # (H, W, 3) s^2 k, s^2 and 1; zeros off the mask, and where a channel is clipped
    ):
        for t in range(out.shape[0] * strip_count(out.shape[1], LANES)):
            y, start, count = strip_at(t, out.shape[1], LANES)
            light, angle, counts = lanes_of_colors(0.0), float_lanes(0.0), float_lanes(0.0)
            product, square, harmonics = float_lanes(0.0), float_lanes(0.0), load_harmonics(template)
            colors, ambients, sharper = nodes_between(nodes, sharpness, spacing_px, y, start, float_lanes)
            for k in range(count):
                set_color(light, k, color_at(image, y, start + k))
                if mask[y, start + k] != 0:
                    angle[k], counts[k] = within_cycle(phase[y, start + k]), 1.0
            for k in range(LANES):
                seen = color_of(light, k)
                cycle, slope = sharpened_cycle_and_slope(harmonics, angle[k], lane_of(sharper, k))
                surface = surface_at(labels, y, start + k)
                model, change, swing, rest = surface_model(
                    cycle, slope, lane_of(colors, k), lane_of(ambients, k), surface, mixing, besides, mixed
                )
                brightness, by_contrast = solved(seen - rest, model, change, swing)
                counts[k] = ti.select(seen.max() < clipped, counts[k], 0.0)
                brightness *= counts[k]
                product[k], square[k] = brightness * by_contrast, brightness * brightness
            for k in range(count):
                out[y, start + k, 0], out[y, start + k, 1], out[y, start + k, 2] = product[k], square[k], counts[k]

    return measure_swing_kernel


@cache
def _light_by_white_kernel(mixed: bool, spacing_px: int) -> Any:
    """Return the kernel from the image to light under white, for nodes that are `spacing_px` px apart."""

    # LLVM ends the process without flow analysis ("Invalid cast").
    @kernel(flow_analysis=True)
    def light_by_white_kernel(
        image: AnyArray3,  # (H, W, 3) levels
        phase: F32Array2,  # (H, W) rad
        mask: U8Array2,  # (H, W)
        labels: U8Array2,  # (H, W) see `Surfaces`
        mixing: F32Array3,  # (N, 3, 3)
        besides: F32Array2,  # (N, 3) levels
        template: F32Array2,  # (3, terms)
        nodes: F32Array3,  # (Hg, Wg, 6) A and B
        sharpness: F32Array2,  # (Hg, Wg)
        clipped: f32,  # levels
        white: F32Array1,  # (3,) see `white_level`
        means: F32Array3,  # (H, W, 3) of s^2 k, of s^2 and of 1, where no channel is clipped
        out_light: F32Array3,  # (H, W, 3) levels; zeros off the mask
        out_brightness: F32Array2,  # (H, W) their sum
        out_contrast: F32Array2,  # (H, W) the logarithm of kappa
    ):
        for t in range(out_brightness.shape[0] * strip_count(out_brightness.shape[1], LANES)):
            y, start, count = strip_at(t, out_brightness.shape[1], LANES)
            level, harmonics = vec3(white[0], white[1], white[2]), load_harmonics(template)
            light, angle, counts = lanes_of_colors(0.0), float_lanes(0.0), float_lanes(0.0)
            deviation, around, known = float_lanes(0.0), float_lanes(0.0), float_lanes(0.0)
            colors, ambients, sharper = nodes_between(nodes, sharpness, spacing_px, y, start, float_lanes)
            for k in range(count):
                set_color(light, k, color_at(image, y, start + k))
                if mask[y, start + k] != 0:
                    angle[k], counts[k] = within_cycle(phase[y, start + k]), 1.0
                    around[k], known[k] = means[y, start + k, 1], means[y, start + k, 2]
                    deviation[k] = means[y, start + k, 0] / ti.max(around[k], TINY)
            for k in range(LANES):
                seen, color, ambient = color_of(light, k), lane_of(colors, k), lane_of(ambients, k)
                cycle, slope = sharpened_cycle_and_slope(harmonics, angle[k], lane_of(sharper, k))
                surface = surface_at(labels, y, start + k)
                model, change, swing, rest = surface_model(
                    cycle, slope, color, ambient, surface, mixing, besides, mixed
                )
                at_white, _, white_swing, _ = surface_model(
                    level, slope, color, ambient, surface, mixing, besides, mixed
                )
                more = ti.max(ti.min(deviation[k], _MOST_CONTRAST), -_MOST_CONTRAST)
                brightness, _ = solved(seen - rest, model, change, swing)
                product, square = 0.0, TINY
                for i in ti.static(range(3)):
                    expected = ti.select(seen[i] < clipped, model[i] + more * swing[i], 0.0)
                    product += expected * (seen[i] - rest[i])
                    square += expected * expected
                by_others = ti.select(known[k] > TINY, ti.sqrt(around[k] / ti.max(known[k], TINY)), product / square)
                brightness = ti.max(ti.select(seen.max() < clipped, brightness, by_others), 0.0)
                # What of white is no fringe, in units of s: the mean of B over A.
                besides_fringe = channel_mean(rest / ti.max(at_white, TINY)) * channel_mean(level)
                kappa = brightness * (1.0 + more) / ti.max(brightness + besides_fringe, TINY)
                deviation[k] = ti.log(ti.max(ti.min(kappa, _HIGHEST), _LOWEST))
                shown = counts[k] * (brightness * (at_white + more * white_swing) + rest)
                set_color(light, k, ti.max(shown, 0.0))
            for k in range(count):
                shown = color_of(light, k)
                out_brightness[y, start + k], out_contrast[y, start + k] = shown.sum(), deviation[k]
                for i in ti.static(range(3)):
                    out_light[y, start + k, i] = shown[i]

    return light_by_white_kernel


def light_by_white(light: FrameLight, phase: F32, mask: Mask, period_px: float) -> tuple[F32, F32, F32]:
    """Return what every pixel would show under the projector's white, with what still repeats with every cycle.

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

    Returns
    -------
    (H, W, 3) float32
        Levels of linear light; 0 off the mask.
    (H, W) float32
        The sum of the channels.
    (H, W) float32
        The logarithm of the fringe's contrast relative to the template's.

    Raises
    ------
    ShapeError
        A shape or dtype is another one.
    """
    image = checks.read_array("image", light.image, (None, None, 3), *LEVEL_TYPES)
    shape = (int(image.shape[0]), int(image.shape[1]))
    phase = checks.read_array("phase", phase, shape, np.float32)
    valid = checks.read_mask("mask", mask, shape)
    surfaces, white = light.crosstalk.surfaces, white_level(light.template, light.crosstalk)
    seen = (image, phase, valid, surfaces.labels, surfaces.mixing, surfaces.ambient)
    model = (light.template, light.nodes, light.sharpness, light.clipped)
    swings = runtime.empty((*shape, 3), np.float32)
    _measure_swing_kernel(surfaces.mixed, light.spacing_px)(*seen, *model, swings)
    window = (_CONTRAST_ALONG * period_px, _CONTRAST_ACROSS * period_px)
    means = wide_blur(runtime.to_host(swings), *window)  # synchronises
    shown = runtime.empty((*shape, 3), np.float32)
    brightness, contrast = (runtime.empty(shape, np.float32) for _ in range(2))
    averaged = runtime.to_device(means)
    kernel = _light_by_white_kernel(surfaces.mixed, light.spacing_px)
    kernel(*seen, *model, white, averaged, shown, brightness, contrast)
    return shown, brightness, contrast
