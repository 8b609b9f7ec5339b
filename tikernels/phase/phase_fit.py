"""From the camera's levels to the phase: the arctangent, and from there the phase that the channel model fits best.

The arctangent weighs the channels as if all were equally bright, and takes the projector's light for a sinusoid. The
model of `channel_model.py`, C_i = s A_i t_i(phi) + B_i, knows better, and a step of Gauss and Newton from the
arctangent's phase weighs the channels by what they say.

Each channel is divided by the standard deviation of its noise, whose variance is the read noise's and a gain times the
light; c is then C - B, and of unit variance. With M = A t, its derivative M' by the phase, and W = A (t - 1), by which
it changes when the contrast does, the model is linear in the brightness s, the step d and the deviation k of the
pixel's contrast from its neighbourhood's:

    c = s (M + d M' + k W) + noise,    k ~ N(0, K^2), K = contrast_doubt.

Nothing is known of s, so only what stands across M says anything: D = M' - (M' M / M M) M and Q = W - (W M / M M) M,
and s = c M / M M. The doubtful contrast is noise along Q with the deviation q = s K. The covariance across M is
therefore 1 + q^2 Q Q^T, whose inverse is 1 - q^2 Q Q^T / v with v = 1 + q^2 Q Q (Sherman and Morrison). Weighted least
squares with E = v D - q^2 (D Q) Q, that is v times the inverse times D, give

    d = c E / (s D E),    variance of the phase = v / (s^2 D E).

With K = 0 that is d = c D / (s D D) and 1 / (s^2 D D), the limit of Cramer and Rao for a pixel of unknown brightness
(C. Rathjen, Statistical properties of phase-shift algorithms, Journal of the Optical Society of America A 12, 1995,
doi:10.1364/JOSAA.12.001997). What is left lies along M x D: light that no model knows, as from another surface. Its
variance is at most v; the square of it over v, beyond that of three standard deviations, widens the phase's variance.
"""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from tikernels import checks
from tikernels._taichi import (
    AnyArray3,
    F32Array1,
    F32Array2,
    F32Array3,
    Static,
    U8Array2,
    f32,
    i32,
    mat3,
    ti,
    vec3,
)
from tikernels.arrays import F32, LevelsImage
from tikernels.launching import kernel
from tikernels.phase.channel_model import ChannelModel, is_lit
from tikernels.phase.channel_template import load_harmonics, sharpened_cycle_and_slope, sharpening_of
from tikernels.phase.crosstalk import Crosstalk, weighed_vector
from tikernels.phase.equalization import equalized
from tikernels.phase.frame_statistics import FrameLevels
from tikernels.phase.phase_vector import SIGMAS, TINY, arctangent, color_at, matrix_of, modulation_of
from tikernels.phase.surfaces import (
    shows_surface,
    surface_ambient,
    surface_at,
    surface_matrix,
)
from tikernels.phase.wrapped_phase import NO_PHASE
from tikernels.raw.linearization import LEVEL_TYPES
from tikernels.strips import STRIP, color_of, set_color, strip_at, strip_count

# The arctangent is never further off than this; a model that says so is wrong there. rad
_MAX_STEP = 0.3
#: Larger misfits, the squares of what is left over, are not noise.
MAX_MISFIT = SIGMAS**2


class FittedPhase(NamedTuple):
    """What the fit says of every pixel, (H, W) float32 each."""

    phase: F32
    """rad, a little beyond [-pi, pi]; NO_PHASE where a pixel is dark, clipped, or without fringe."""
    modulation: F32
    """Amplitude of the fringe, levels."""
    precision: F32
    """1 / rad^2: one over the phase's variance."""
    misfit: F32
    """The square of what brightness and phase leave over, over its variance."""
    brightness: F32
    """Mean of the channels over a cycle, without ambient light, levels."""


@ti.func
def node_model(nodes: F32Array3, row: f32, j: i32):
    """Return A and B at a column of nodes, between two rows of them."""
    i = ti.cast(row, ti.i32)
    i1 = ti.min(i + 1, nodes.shape[0] - 1)
    fraction = row - i
    column = ti.min(ti.max(j, 0), nodes.shape[1] - 1)
    color, ambient = vec3(0.0), vec3(0.0)
    for k in ti.static(range(3)):
        color[k] = nodes[i, column, k] + fraction * (nodes[i1, column, k] - nodes[i, column, k])
        ambient[k] = nodes[i, column, 3 + k] + fraction * (nodes[i1, column, 3 + k] - nodes[i, column, 3 + k])
    return color, ambient


@ti.func
def fringe_vector(channels: vec3, color: vec3, ambient: vec3, weights: mat3) -> vec3:
    """Return b cos(phi), b sin(phi) and a of a pixel's balanced channels, (C - B) / A."""
    # One division for three.
    others = vec3(color.y * color.z, color.x * color.z, color.x * color.y)
    return weighed_vector(channels - ambient, others, weights) / (color.x * others.x)


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
def estimator_of(light: vec3, model: vec3, change: vec3, swing: vec3, contrast_doubt: f32):
    """Return E, D, v and s of the module, of channels in units of their noise."""
    inverse_square = 1.0 / ti.max(model.dot(model), TINY)
    brightness = ti.max(light.dot(model) * inverse_square, TINY)
    of_phase = change - change.dot(model) * inverse_square * model
    of_contrast = swing - swing.dot(model) * inverse_square * model
    doubt = contrast_doubt * brightness
    variance = 1.0 + doubt * doubt * of_contrast.dot(of_contrast)
    estimator = variance * of_phase - doubt * doubt * of_phase.dot(of_contrast) * of_contrast
    return estimator, of_phase, variance, brightness


@ti.func
def fitted_step(light: vec3, model: vec3, change: vec3, swing: vec3, contrast_doubt: f32):
    """Return the phase's step, rad, one over its variance, the misfit, and s: see the module.

    All channels are in units of their noise. The misfit is the square of what is left, over its variance.
    """
    estimator, of_phase, variance, brightness = estimator_of(light, model, change, swing, contrast_doubt)
    # Divisions cost most: reciprocals come from one of their product.
    curvature, square = ti.max(estimator.dot(of_phase), TINY), ti.max(of_phase.dot(of_phase), TINY)
    reciprocal = 1.0 / (curvature * variance * brightness * square)
    step = light.dot(estimator) * variance * square * reciprocal
    residual = light.dot(model.cross(of_phase))
    # In this order, as the products of what is free of noise are too large for float32.
    share = curvature * reciprocal * brightness
    misfit = residual * residual / ti.max(model.dot(model), TINY) * share
    precision = share * curvature * square * brightness * brightness
    return step, precision, misfit, brightness


@ti.func
def doubted(misfit: f32, doubt: f32, precision: f32) -> f32:
    """Return a misfit with what a correction is unsure of, rad, added to it, in units of the precision's variance.

    No further than the largest misfit: beyond that the fit has divided the precision by its own.
    """
    return ti.max(misfit, ti.min(misfit + doubt * doubt * precision, MAX_MISFIT))


@ti.func
def load_nodes(
    nodes: F32Array3,
    sharpness: F32Array2,
    spacing_px: Static,
    y: i32,
    place: i32,
    colors: Static,
    ambients: Static,
    sharper: Static,
):
    """Fill a strip with A, B, and the factors of the second to fourth harmonic, gap by gap between nodes.

    Gap j lies between nodes j - 1 and j; the first one begins half of it before the image, where `place` is 0.
    """
    in_gap = ti.static(min(spacing_px, STRIP))
    row = ti.min(ti.max((y + 0.5) / spacing_px - 0.5, 0.0), ti.cast(nodes.shape[0] - 1, ti.f32))
    right_color, right_ambient = node_model(nodes, row, place // spacing_px - 1)
    for gap in range(STRIP // in_gap):
        j = (place + gap * in_gap) // spacing_px
        left_color, left_ambient = right_color, right_ambient
        right_color, right_ambient = node_model(nodes, row, j)
        color_slope = (right_color - left_color) * ti.static(1.0 / spacing_px)
        ambient_slope = (right_ambient - left_ambient) * ti.static(1.0 / spacing_px)
        factors = sharpening_of(sharpness[ti.cast(row, ti.i32), ti.min(j, nodes.shape[1] - 1)])
        for number in range(in_gap):
            k = gap * in_gap + number
            along = ti.cast(place + k - j * spacing_px, ti.f32) + 0.5
            set_color(colors, k, left_color + color_slope * along)
            set_color(ambients, k, left_ambient + ambient_slope * along)
            set_color(sharper, k, factors)


@cache
def _fit_phase_kernel(mixed: bool, spacing_px: int) -> Any:
    """Return the kernel from grey levels to phase, for nodes that are `spacing_px` px apart."""
    lanes, lanes_of_colors = ti.types.vector(STRIP, ti.f32), ti.types.matrix(3, STRIP, ti.f32)

    @kernel
    def fit_phase_kernel(
        image: AnyArray3,  # (H, W, 3) levels
        labels: U8Array2,  # (H, W) see `Surfaces`
        mixing: F32Array3,  # (N, 3, 3)
        unmixing: F32Array3,  # (N, 3, 3)
        besides: F32Array2,  # (N, 3) levels
        phase_weights: F32Array2,  # (3, 3) takes the model's balanced channels to b (cos phi, sin phi), a
        correction: F32Array1,  # (bins + 1,) rad to add to the arctangent
        template: F32Array2,  # (3, terms) one cycle of each channel
        nodes: F32Array3,  # (Hg, Wg, 6) A and B
        sharpness: F32Array2,  # (Hg, Wg) see `fringe_sharpness.py`
        min_intensity: f32,  # levels
        min_modulation: f32,  # levels
        min_precision: f32,  # 1 / rad^2
        clipped: f32,  # levels
        read_noise: f32,  # standard deviation of a dark channel, levels
        noise_gain: f32,  # by how much the variance grows with the light, levels
        contrast_doubt: f32,  # standard deviation of the model's contrast, as a fraction
        out_phase: F32Array2,  # (H, W) rad, a little beyond +-pi; NO_PHASE outside the mask
        out_modulation: F32Array2,  # (H, W) levels
        out_precision: F32Array2,  # (H, W) 1 / rad^2: one over the phase's variance
        out_misfit: F32Array2,  # (H, W) the square of what is left, over its variance
        out_brightness: F32Array2,  # (H, W) levels: the mean over the cycle, without ambient light
    ):
        height, width, before = image.shape[0], image.shape[1], ti.static(spacing_px // 2)
        for t in range(height * strip_count(width + before, STRIP)):
            y, place, _ = strip_at(t, width + before, STRIP)
            start = place - before
            weights, harmonics = matrix_of(phase_weights), load_harmonics(template)
            light, colors, ambients = lanes_of_colors(0.0), lanes_of_colors(1.0), lanes_of_colors(0.0)
            sharper, bare, start_phase = lanes_of_colors(1.0), lanes(0.0), lanes(0.0)
            phase, modulation, precision, left, bright = lanes(0.0), lanes(0.0), lanes(0.0), lanes(0.0), lanes(0.0)
            load_nodes(nodes, sharpness, spacing_px, y, place, colors, ambients, sharper)
            first, stop = ti.max(-start, 0), ti.min(STRIP, width - start)
            own, surfaces = lanes(0.0), ti.static(0 if mixed else 1)  # a bit for each that the strip shows
            for k in range(first, stop):
                set_color(light, k, color_at(image, y, start + k))
                if ti.static(mixed):
                    surface = surface_at(labels, y, start + k)
                    own[k], surfaces = surface, surfaces | (1 << surface)
            # Nearly all strips show one: its matrix is loaded once, and what others do of its pixels is left.
            for surface in range(mixing.shape[0]):
                if (surfaces >> surface) & 1 == 0:
                    continue
                for k in range(STRIP):
                    color, channels = color_of(colors, k), color_of(light, k)
                    if ti.static(mixed):
                        ambience = surface_ambient(besides, surface)
                        channels = surface_matrix(unmixing, surface) @ (channels - ambience)
                    vector = fringe_vector(channels, color, color_of(ambients, k), weights)
                    modulation[k] = modulation_of(vector) * color.sum() / 3.0  # of channels as they are
                    bare[k] = arctangent(vector.y, vector.x)
                for k in range(STRIP):
                    start_phase[k] = equalized(bare[k], correction)
                for k in range(STRIP):
                    seen, color, ambient = color_of(light, k), color_of(colors, k), color_of(ambients, k)
                    cycle, slope = sharpened_cycle_and_slope(harmonics, start_phase[k], color_of(sharper, k))
                    model, change, swing, rest = surface_model(
                        cycle, slope, color, ambient, surface, mixing, besides, mixed
                    )
                    weight = 1.0 / ti.sqrt(read_noise * read_noise + noise_gain * ti.max(seen, 0.0))
                    step, precise, left[k], shown = fitted_step(
                        weight * (seen - rest), weight * model, weight * change, weight * swing, contrast_doubt
                    )
                    precision[k] = precise / ti.max(1.0, left[k] / MAX_MISFIT)
                    bright[k] = shown * (model - swing).sum() / 3.0
                    valid = is_lit(seen, min_intensity, clipped) & (modulation[k] > min_modulation)
                    fitted = start_phase[k] + ti.math.clamp(step, -_MAX_STEP, _MAX_STEP)
                    phase[k] = ti.select(valid & (precision[k] > min_precision), fitted, NO_PHASE)
                for k in range(first, stop):
                    if own[k] == surface:
                        shows = shows_surface(labels, y, start + k) if ti.static(mixed) else True
                        out_phase[y, start + k] = ti.select(shows, phase[k], NO_PHASE)
                        out_modulation[y, start + k] = modulation[k]
                        out_precision[y, start + k] = precision[k]
                        out_misfit[y, start + k] = left[k]
                        out_brightness[y, start + k] = bright[k]

    return fit_phase_kernel


def fit_phase(
    image: LevelsImage,
    model: ChannelModel,
    crosstalk: Crosstalk,
    levels: FrameLevels,
    correction: npt.NDArray[np.float32],
    contrast_doubt: float,
    out: FittedPhase | None = None,
) -> FittedPhase:
    """Find the phase of every pixel that fits the channels' model best.

    Parameters
    ----------
    image : (H, W, 3) uint8, uint16 or float32
        Linear light, levels, stripes along the rows.
    model : ChannelModel
        The frame's, fitted.
    crosstalk : Crosstalk
        What the model and its gains were made with.
    levels : FrameLevels
        The frame's noise, and what a pixel needs to have a phase.
    correction : (bins + 1,) float32
        rad to add to the arctangent; see `equalization.correction_table`.
    contrast_doubt : float
        Standard deviation of a pixel's contrast about what its neighbourhood shows, as a fraction.
    out : FittedPhase, optional
        Where the results go.

    Raises
    ------
    ShapeError
        A shape or dtype is another one, or an output cannot be written.
    """
    shape = (model.gains.height, model.gains.width)
    image = checks.read_array("image", image, (*shape, 3), *LEVEL_TYPES)
    correction = checks.read_array("correction", correction, (None,), np.float32)
    outs = (None,) * len(FittedPhase._fields) if out is None else out
    named = zip(FittedPhase._fields, outs, strict=True)
    results = FittedPhase(*(checks.out_buffer(name, buffer, shape, np.float32) for name, buffer in named))
    surfaces = crosstalk.surfaces
    _fit_phase_kernel(surfaces.mixed, model.gains.spacing_px)(
        image,
        surfaces.labels,
        surfaces.mixing,
        surfaces.unmixing,
        surfaces.ambient,
        crosstalk.weights,
        correction,
        model.template,
        model.nodes,
        model.sharpness.values,
        levels.intensity,
        levels.modulation,
        levels.precision,
        levels.clipped,
        levels.read_noise,
        levels.noise_gain,
        contrast_doubt,
        *results,
    )
    return results
