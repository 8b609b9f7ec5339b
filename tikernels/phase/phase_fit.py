"""From the camera's levels to the phase: the arctangent, and from there the phase that the channel model fits best.

The arctangent weighs the channels as if all were equally bright, and takes the projector's light for a sinusoid. The
model of `channel_model.py`, C_i = s A_i t_i(phi) + B_i, knows better, and a step of Gauss and Newton from the
arctangent's phase weighs the channels by their information.

Each channel is divided by the standard deviation of its noise, whose variance is the read noise's and a gain times the
light; c is then C - B, and of unit variance. With M = A t, its derivative M' by the phase, and W = A (t - 1), by which
it changes when the contrast does, the model is linear in the brightness s, the step d and the deviation k of the
pixel's contrast from its neighbourhood's:

    c = s (M + d M' + k W) + noise,    k ~ N(0, K^2), K = contrast_doubt.

Nothing is known of s, so only what is orthogonal to M has information: D = M' - (M' M / M M) M and Q = W - (W M / M M)
M, and s = c M / M M. The doubtful contrast is noise along Q with the deviation q = s K. The covariance across M is
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
    ti,
    vec3,
)
from tikernels.arrays import F32, LevelsImage
from tikernels.lanes import LANES, as_lanes, planes, put_back, whole_rows
from tikernels.launching import kernel
from tikernels.phase.channel_model import ChannelModel, is_lit
from tikernels.phase.channel_template import cycles_and_slopes, load_harmonics, sharpening_of
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.equalization import equalized_lanes
from tikernels.phase.frame_statistics import FrameLevels
from tikernels.phase.phase_vector import SIGMAS, TINY, arctangent_lanes, channel_mean, color_at, matrix_of
from tikernels.phase.surfaces import matrix_lanes, shows_surface, surface_at, through
from tikernels.phase.wrapped_phase import NO_PHASE
from tikernels.raw.linearization import LEVEL_TYPES
from tikernels.strips import strip_at, strip_count

# The arctangent is never further off than this; a model that differs more is wrong there. rad
_MAX_STEP = 0.3
#: Larger misfits, the squares of what is left over, are not noise.
MAX_MISFIT = SIGMAS**2


class FittedPhase(NamedTuple):
    """Results of the fit at every pixel, (H, W) float32 each."""

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
def lane_of(channels: Static, k: i32) -> vec3:
    """Return one lane of a list of three channels."""
    return vec3(channels[0][k], channels[1][k], channels[2][k])


@ti.func
def dot(a: Static, b: Static):
    """Return the product of two lists of three channels' lanes."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@ti.func
def fringe_vector(channels: Static, color: Static, ambient: Static, weights: Static):
    """Return lanes of b cos(phi), b sin(phi) and a of pixels' balanced channels, (C - B) / A."""
    # One division for three.
    others = [color[1] * color[2], color[0] * color[2], color[0] * color[1]]
    light = [(channels[c] - ambient[c]) * others[c] for c in ti.static(range(3))]
    share = 1.0 / (color[0] * others[0])
    return [
        (weights[k, 0] * light[0] + weights[k, 1] * light[1] + weights[k, 2] * light[2]) * share
        for k in ti.static(range(3))
    ]


@ti.func
def across(light: Static, model: Static, inverse_square: Static):
    """Return what of the light lies across the model."""
    share = dot(light, model) * inverse_square
    return [light[c] - share * model[c] for c in ti.static(range(3))]


@ti.func
def fitted_step(light: Static, model: Static, change: Static, swing: Static, contrast_doubt: f32):
    """Return the phase's step, rad, one over its variance, the misfit, and s: see the module.

    Of lanes; all channels are in units of their noise. The misfit is the square of what is left, over its variance.
    """
    inverse_square = 1.0 / ti.max(dot(model, model), TINY)
    brightness = ti.max(dot(light, model) * inverse_square, TINY)
    of_phase, of_contrast = across(change, model, inverse_square), across(swing, model, inverse_square)
    doubt = contrast_doubt * brightness
    variance = 1.0 + doubt * doubt * dot(of_contrast, of_contrast)
    both = doubt * doubt * dot(of_phase, of_contrast)
    estimator = [variance * of_phase[c] - both * of_contrast[c] for c in ti.static(range(3))]
    # Divisions cost most: reciprocals come from one of their product.
    curvature, square = ti.max(dot(estimator, of_phase), TINY), ti.max(dot(of_phase, of_phase), TINY)
    reciprocal = 1.0 / (curvature * variance * brightness * square)
    step = dot(light, estimator) * variance * square * reciprocal
    normal = [
        model[(c + 1) % 3] * of_phase[(c + 2) % 3] - model[(c + 2) % 3] * of_phase[(c + 1) % 3]
        for c in ti.static(range(3))
    ]
    residual = dot(light, normal)
    # In this order, as the products of what is free of noise are too large for float32.
    share = curvature * reciprocal * brightness
    misfit = residual * residual * inverse_square * share
    precision = share * curvature * square * brightness * brightness
    return step, precision, misfit, brightness


@ti.func
def doubted(misfit: f32, doubt: f32, precision: f32) -> f32:
    """Return a misfit with what a correction is unsure of, rad, added to it, in units of the precision's variance.

    No further than the largest misfit: beyond that the fit has divided the precision by its own.
    """
    return ti.max(misfit, ti.min(misfit + doubt * doubt * precision, MAX_MISFIT))


@ti.func
def nodes_between(nodes: F32Array3, sharpness: F32Array2, spacing_px: Static, y: i32, x: i32, lanes: Static):
    """Return lanes of A, B, and the factors of the second to fourth harmonic, from x on.

    Gap by gap between nodes: gap j lies between nodes j - 1 and j; the first one begins half of it before the image.
    """
    row = ti.min(ti.max((y + 0.5) / spacing_px - 0.5, 0.0), ti.cast(nodes.shape[0] - 1, ti.f32))
    first = (x + spacing_px // 2) // spacing_px
    right_color, right_ambient = node_model(nodes, row, first - 1)
    color, ambient = [lanes(0.0) for _ in ti.static(range(3))], [lanes(0.0) for _ in ti.static(range(3))]
    factors, ramp = [lanes(0.0) for _ in ti.static(range(3))], lanes(0.0)
    for k in range(lanes.n):
        ramp[k] = k
    for j in range(first, (x + lanes.n - 1 + spacing_px // 2) // spacing_px + 1):
        left_color, left_ambient = right_color, right_ambient
        right_color, right_ambient = node_model(nodes, row, j)
        sharper = sharpening_of(sharpness[ti.cast(row, ti.i32), ti.min(j, nodes.shape[1] - 1)])
        along = ramp - ti.cast(j * spacing_px - spacing_px // 2 - x, ti.f32)  # from the gap's first pixel
        share = (along + 0.5) * ti.static(1.0 / spacing_px)
        for c in ti.static(range(3)):
            here = left_color[c] + (right_color[c] - left_color[c]) * share
            color[c] = ti.select(along < 0.0, color[c], here)
            here = left_ambient[c] + (right_ambient[c] - left_ambient[c]) * share
            ambient[c] = ti.select(along < 0.0, ambient[c], here)
            factors[c] = ti.select(along < 0.0, factors[c], sharper[c])
    return color, ambient, factors


@ti.func
def put_lanes(out: Static, y: i32, place: i32, values: Static):
    """Write lanes of a row at a place, counted in as many."""
    if ti.static(values.n == 1):
        out[y, place] = values[0]
    else:
        out[y, place] = values


@cache
def _fit_phase_kernel(mixed: bool, spacing_px: int, wide: bool) -> Any:
    """Return the kernel from grey levels to phase, for nodes that are `spacing_px` px apart, and rows of vectors."""
    count = LANES if wide else 1
    lanes, results = ti.types.vector(count, ti.f32), planes(wide)

    @kernel(whole_vectors=True)
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
        out_phase: results,  # (H, W) rad, a little beyond +-pi; NO_PHASE outside the mask
        out_modulation: results,  # (H, W) levels
        out_precision: results,  # (H, W) 1 / rad^2: one over the phase's variance
        out_misfit: results,  # (H, W) the square of what is left, over its variance
        out_brightness: results,  # (H, W) levels: the mean over the cycle, without ambient light
    ):
        height, width = image.shape[0], image.shape[1]
        for t in range(height * strip_count(width, count)):
            y, start, inside = strip_at(t, width, count)
            weights, harmonics = matrix_of(phase_weights), load_harmonics(template)
            color, ambient, sharper = nodes_between(nodes, sharpness, spacing_px, y, start, lanes)
            light = [lanes(0.0) for _ in ti.static(range(3))]
            own, surfaces = lanes(0.0), ti.static(0 if mixed else 1)  # a bit for each that the pixels show
            for k in range(inside):
                seen = color_at(image, y, start + k)
                for c in ti.static(range(3)):
                    light[c][k] = seen[c]
                if ti.static(mixed):
                    surface = surface_at(labels, y, start + k)
                    own[k], surfaces = surface, surfaces | (1 << surface)
            noise = [read_noise * read_noise + noise_gain * ti.max(light[c], 0.0) for c in ti.static(range(3))]
            weight = [1.0 / ti.sqrt(noise[c]) for c in ti.static(range(3))]
            found = [lanes(0.0) for _ in ti.static(range(5))]
            # Nearly all show one surface, and what others do of their pixels is left.
            for surface in range(mixing.shape[0]):
                if (surfaces >> surface) & 1 == 0:
                    continue
                bare = [light[c] - besides[surface, c] for c in ti.static(range(3))]
                mix, unmix = matrix_lanes(mixing, surface, lanes), matrix_lanes(unmixing, surface, lanes)
                vector = fringe_vector(through(unmix, bare, mixed), color, ambient, weights)
                modulation = ti.sqrt(vector[0] * vector[0] + vector[1] * vector[1])
                modulation *= channel_mean(color)  # of channels as they are
                begin = equalized_lanes(arctangent_lanes(vector[1], vector[0]), correction)
                cycle, slope = cycles_and_slopes(harmonics, begin, sharper)
                mean, rest = through(mix, color, mixed), through(mix, ambient, mixed)
                model = through(mix, [color[c] * cycle[c] for c in ti.static(range(3))], mixed)
                change = through(mix, [color[c] * slope[c] for c in ti.static(range(3))], mixed)
                step, precision, left, brightness = fitted_step(
                    [weight[c] * (bare[c] - rest[c]) for c in ti.static(range(3))],
                    [weight[c] * model[c] for c in ti.static(range(3))],
                    [weight[c] * change[c] for c in ti.static(range(3))],
                    [weight[c] * (model[c] - mean[c]) for c in ti.static(range(3))],
                    contrast_doubt,
                )
                precise = precision / ti.max(1.0, left / MAX_MISFIT)
                fitted = begin + ti.math.clamp(step, -_MAX_STEP, _MAX_STEP)
                fitted = ti.select(modulation > min_modulation, fitted, NO_PHASE)
                fitted = ti.select(precise > min_precision, fitted, NO_PHASE)
                result = [fitted, modulation, precise, left, brightness * channel_mean(mean)]
                for c in ti.static(range(5)):
                    found[c] = ti.select(own == ti.cast(surface, ti.f32), result[c], found[c])
            for k in range(inside):
                lit = is_lit(lane_of(light, k), min_intensity, clipped)
                shows = lit & shows_surface(labels, y, start + k) if ti.static(mixed) else lit
                found[0][k] = ti.select(shows, found[0][k], NO_PHASE)
            put_lanes(out_phase, y, start // count, found[0])
            put_lanes(out_modulation, y, start // count, found[1])
            put_lanes(out_precision, y, start // count, found[2])
            put_lanes(out_misfit, y, start // count, found[3])
            put_lanes(out_brightness, y, start // count, found[4])

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
        Crosstalk of the model and its gains.
    levels : FrameLevels
        The frame's noise, and what a pixel needs to have a phase.
    correction : (bins + 1,) float32
        rad to add to the arctangent; see `equalization.correction_table`.
    contrast_doubt : float
        Standard deviation of a pixel's contrast about what its neighbourhood shows, as a fraction.
    out : FittedPhase, optional
        Output arrays.

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
    rows, wide = whole_rows(*results)
    _fit_phase_kernel(surfaces.mixed, model.gains.spacing_px, wide)(
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
        *(as_lanes(row, wide) for row in rows),
    )
    for row, result in zip(rows, results, strict=True):
        put_back(row, result)
    return results
