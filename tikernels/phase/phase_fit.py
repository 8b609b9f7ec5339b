"""From the camera's levels to the phase: the arctangent, and from there the phase that the channel model fits best.

The arctangent weighs the channels as if all were equally bright, and takes the projector's light for a sinusoid. With
`channel_model.py`'s C_i = s A_i t_i(phi) + B_i a step of Gauss and Newton weighs them by what they say. Each channel
is divided by its noise, whose variance is the read noise's and a gain times the light; then with M_i = A_i t_i and its
derivative's part across M, D_i = M_i' - (M' M / M M) M_i, the least squares over s and phi are

    step = D (C - B) / (s D D),    s = M (C - B) / M M,

and the phase's standard deviation is 1 / (s |D|). That the contrast may depart a little from its neighbourhood's is
part of the fit. What is left lies along M x D: light that no model knows, as from another surface.
"""

from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from tikernels import _checks, runtime
from tikernels._taichi import AnyArray3, F32Array1, F32Array2, F32Array3, I32Array2, f32, i32, ti, vec3
from tikernels.arrays import F32, LevelsImage
from tikernels.phase.channel_model import HARMONICS, ChannelModel
from tikernels.phase.color_balance import Gains, gain_at
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.equalization import equalized
from tikernels.phase.frame_statistics import CLIPPED, FrameLevels
from tikernels.phase.phase_vector import PI, arctangent, cosine_and_sine, matrix_of
from tikernels.phase.wrapped_phase import NO_PHASE
from tikernels.raw.linearization import LEVEL_TYPES

# Gain cells that one thread walks along a row: enough threads for a GPU, and more than the 512 iterations below which
# the CPU runtime uses a single core.
_CELLS_A_THREAD = 8
# The arctangent is never further off than this; a model that says so is wrong there.
_MAX_STEP = 0.3


@ti.func
def second_brightest(light: vec3) -> f32:
    """Return the middle one of three channels."""
    low, high = ti.min(light.x, light.y), ti.max(light.x, light.y)
    return ti.max(low, ti.min(high, light.z))


@cache
def _fit_phase_kernel(balance_first: bool, cell: int) -> Any:
    """Return the kernel from grey levels to phase: balance, crosstalk, arctangent, fit and masks in one pass.

    `cell` is the distance of two nodes, px.
    """
    width_at_once = min(max(cell, 8), 16)
    lanes = ti.types.vector(width_at_once, ti.f32)

    @ti.func
    def node_model(nodes: F32Array3, i: i32, i1: i32, fraction: f32, j: i32):
        """Return A and B at a column of nodes."""
        column = ti.min(ti.max(j, 0), nodes.shape[1] - 1)
        gain, ambient = vec3(0.0), vec3(0.0)
        for k in ti.static(range(3)):
            gain[k] = nodes[i, column, k] + fraction * (nodes[i1, column, k] - nodes[i, column, k])
            ambient[k] = nodes[i, column, 3 + k] + fraction * (nodes[i1, column, 3 + k] - nodes[i, column, 3 + k])
        return gain, ambient

    @ti.kernel
    def fit_phase_kernel(
        image: AnyArray3,  # (H, W, 3) levels
        white: f32,  # level of full scale
        inverse_matrix: F32Array2,  # (3, 3) undoes the crosstalk; used where the model's channels come after it
        crosstalk_matrix: F32Array2,  # (3, 3)
        phase_weights: F32Array2,  # (3, 3) takes the model's balanced channels to b (cos phi, sin phi), a
        correction: F32Array1,  # (bins + 1,) rad to add to the arctangent
        template: F32Array2,  # (3, 1 + 2 harmonics) one cycle of each channel
        nodes: F32Array3,  # (Hg, Wg, 6) A and B
        min_intensity: f32,  # levels
        min_modulation: f32,  # levels
        read_noise: f32,  # standard deviation of a dark channel, levels
        noise_gain: f32,  # by how much the variance grows with the light, levels
        contrast_doubt: f32,  # standard deviation of the model's contrast
        out_phase: F32Array2,  # (H, W) rad, a little beyond +-pi; NO_PHASE outside the mask
        out_modulation: F32Array2,  # (H, W) levels
        out_precision: F32Array2,  # (H, W) 1 / rad^2: one over the phase's variance
    ):
        height, width = image.shape[0], image.shape[1]
        half = cell // 2
        stretches = (nodes.shape[1] + _CELLS_A_THREAD) // _CELLS_A_THREAD
        for t in range(height * stretches):
            y, stretch = t // stretches, t % stretches
            inverse, weights = matrix_of(inverse_matrix), matrix_of(phase_weights)
            matrix = matrix_of(crosstalk_matrix)
            waves = ti.Matrix.zero(f32, 3, 2 * HARMONICS)
            for c, n in ti.static(ti.ndrange(3, 2 * HARMONICS)):
                waves[c, n] = template[c, 1 + n]
            v = ti.min(ti.max((y + 0.5) / cell - 0.5, 0.0), ti.cast(nodes.shape[0] - 1, ti.f32))
            i = ti.cast(v, ti.i32)
            i1 = ti.min(i + 1, nodes.shape[0] - 1)
            fraction = v - i
            # Cell j lies between node j and the next one, whose pixels are half a cell further on.
            first = stretch * _CELLS_A_THREAD - 1
            right_gain, right_ambient = node_model(nodes, i, i1, fraction, first)
            red, green, blue, bend = lanes(0.0), lanes(0.0), lanes(0.0), lanes(0.0)
            bare, phase, modulation, precision = lanes(0.0), lanes(0.0), lanes(0.0), lanes(0.0)
            for j in range(first, ti.min(first + _CELLS_A_THREAD, nodes.shape[1])):
                left_gain, left_ambient = right_gain, right_ambient
                right_gain, right_ambient = node_model(nodes, i, i1, fraction, j + 1)
                gain_slope = (right_gain - left_gain) / ti.cast(cell, ti.f32)
                ambient_slope = (right_ambient - left_ambient) / ti.cast(cell, ti.f32)
                start = j * cell + half
                x, stop = ti.max(start, 0), ti.min(start + cell, width)
                while x < stop:
                    count = ti.min(width_at_once, stop - x)
                    for k in range(count):
                        red[k] = ti.cast(image[y, x + k, 0], ti.f32)
                        green[k] = ti.cast(image[y, x + k, 1], ti.f32)
                        blue[k] = ti.cast(image[y, x + k, 2], ti.f32)
                    for k in range(width_at_once):
                        along = ti.cast(x + k - start, ti.f32) + 0.5
                        gain, ambient = left_gain + gain_slope * along, left_ambient + ambient_slope * along
                        channels = vec3(red[k], green[k], blue[k])
                        if ti.static(not balance_first):
                            channels = inverse @ channels
                        # One division for three.
                        others = vec3(gain.y * gain.z, gain.x * gain.z, gain.x * gain.y)
                        vector = weights @ ((channels - ambient) * others) / (gain.x * others.x)
                        # In levels of the channels as they are, which the model has stretched to one contrast.
                        modulation[k] = ti.sqrt(vector.x * vector.x + vector.y * vector.y) * gain.sum() / 3.0
                        bare[k] = arctangent(vector.y, vector.x)
                    for k in range(width_at_once):
                        bend[k] = equalized(bare[k], correction)
                    for k in range(width_at_once):
                        along = ti.cast(x + k - start, ti.f32) + 0.5
                        gain, ambient = left_gain + gain_slope * along, left_ambient + ambient_slope * along
                        seen = vec3(red[k], green[k], blue[k])
                        cosine, sine = cosine_and_sine(bend[k])
                        cycle, change = vec3(1.0), vec3(0.0)
                        real, imaginary = cosine, sine
                        for n in ti.static(range(1, HARMONICS + 1)):
                            for c in ti.static(range(3)):
                                across, along_wave = waves[c, n - 1], waves[c, HARMONICS + n - 1]
                                cycle[c] += across * real + along_wave * imaginary
                                change[c] += n * (along_wave * real - across * imaginary)
                            if ti.static(n < HARMONICS):
                                real, imaginary = (
                                    real * cosine - imaginary * sine,
                                    real * sine + imaginary * cosine,
                                )
                        model, gradient, rest = gain * cycle, gain * change, ambient
                        swing = gain * (cycle - 1.0)
                        if ti.static(not balance_first):
                            model, gradient, rest = matrix @ model, matrix @ gradient, matrix @ ambient
                            swing = matrix @ swing
                        sure_of = 1.0 / ti.sqrt(read_noise * read_noise + noise_gain * ti.max(seen, 0.0))
                        model, gradient, swing = sure_of * model, sure_of * gradient, sure_of * swing
                        # Least squares over the pixel's brightness, a step of its phase, and its contrast as far as it
                        # is in doubt. Divisions cost most: reciprocals come from one of their product.
                        light = sure_of * (seen - rest)
                        inverse_square = 1.0 / ti.max(model.dot(model), 1e-12)
                        brightness = ti.max(light.dot(model) * inverse_square, 1e-6)
                        free = gradient - gradient.dot(model) * inverse_square * model
                        fade = swing - swing.dot(model) * inverse_square * model
                        doubt = contrast_doubt * brightness
                        widened = 1.0 + doubt * doubt * fade.dot(fade)
                        sure = widened * free - doubt * doubt * free.dot(fade) * fade
                        steep, square = ti.max(sure.dot(free), 1e-12), ti.max(free.dot(free), 1e-12)
                        reciprocal = 1.0 / (steep * widened * brightness * square)
                        step = light.dot(sure) * widened * square * reciprocal
                        left = light.dot(model.cross(free))
                        misfit = left * left * inverse_square * steep * brightness * reciprocal
                        information = brightness * brightness * brightness * steep * steep * square * reciprocal
                        # What fits worse than by three standard deviations is so much less certain.
                        precision[k] = information / ti.max(1.0, misfit / 9.0)
                        # The second brightest channel at full scale: two are.
                        bright = (seen.sum() > 3.0 * min_intensity) & (second_brightest(seen) < CLIPPED * white)
                        valid = bright & (modulation[k] > min_modulation)
                        value = bend[k] + ti.min(ti.max(step, -_MAX_STEP), _MAX_STEP)
                        phase[k] = ti.select(valid, value, NO_PHASE)
                    for k in range(count):
                        out_phase[y, x + k] = phase[k]
                        out_modulation[y, x + k] = modulation[k]
                        out_precision[y, x + k] = precision[k]
                    x += width_at_once

    return fit_phase_kernel


_BINS = 256
# The picture's histograms are those of so many parts both ways.
_PARTS = 6
# So many pixels pin the equalisation down: the cumulative distribution of N phases errs by up to pi / sqrt(N).
_COUNTED = 2**17


# Pixels that a thread takes at once.
_RUN = 16


@cache
def _count_phases_kernel(balance_first: bool) -> Any:
    lanes = ti.types.vector(_RUN, ti.f32)

    @ti.kernel
    def count_phases_kernel(
        image: AnyArray3,  # (H, W, 3) levels
        inverse_matrix: F32Array2,  # (3, 3)
        phase_weights: F32Array2,  # (3, 3)
        gains: F32Array3,  # (Hg, Wg, 3)
        cell: i32,
        step: i32,  # px between two that are counted
        min_intensity: f32,  # levels
        min_modulation: f32,  # levels
        max_level: f32,
        out_histogram: I32Array2,  # (parts, bins), to be added to
    ):
        height, width, bins = image.shape[0], image.shape[1], out_histogram.shape[1]
        runs = (width + _RUN * step - 1) // (_RUN * step)
        for run in range(height * runs):
            y, first = run // runs, (run % runs) * _RUN * step
            middle = ti.min(first + _RUN * step // 2, width - 1)
            # Gains hardly change within a run.
            inverse, weights = matrix_of(inverse_matrix), matrix_of(phase_weights)
            gain = gain_at(gains, cell, y, middle)
            part = (y * _PARTS // height) * _PARTS + middle * _PARTS // width
            red, green, blue, place = lanes(0.0), lanes(0.0), lanes(0.0), lanes(0.0)
            for k in range(ti.min(_RUN, (width - first + step - 1) // step)):
                x = first + k * step
                red[k] = ti.cast(image[y, x, 0], ti.f32)
                green[k] = ti.cast(image[y, x, 1], ti.f32)
                blue[k] = ti.cast(image[y, x, 2], ti.f32)
            for k in range(_RUN):
                seen = vec3(red[k], green[k], blue[k])
                channels = seen
                if ti.static(not balance_first):
                    channels = inverse @ channels
                vector = weights @ (channels * gain)
                bin_at = (arctangent(vector.y, vector.x) + PI) * (ti.cast(bins, ti.f32) / (2.0 * PI))
                # Leaving out whatever has a single clipped channel would leave out the phases at which it is bright.
                counts = (seen.sum() > 3.0 * min_intensity) & (second_brightest(seen) < max_level)
                counts &= vector.x * vector.x + vector.y * vector.y > min_modulation * min_modulation
                place[k] = ti.select(counts, bin_at, -1.0)
            for k in range(_RUN):
                if place[k] >= 0.0:
                    out_histogram[part, ti.min(ti.cast(place[k], i32), bins - 1)] += 1

    return count_phases_kernel


def count_phases(image: LevelsImage, gains: Gains, crosstalk: Crosstalk, levels: FrameLevels) -> npt.NDArray[np.int64]:
    """Count how often the arctangent's phases fall into each part of the cycle, all over the picture.

    Parameters
    ----------
    image : (H, W, 3) uint8, uint16 or float32
        Linear light, levels.
    gains : Gains
        The frame's, measured.
    crosstalk : Crosstalk
        What the gains were measured with.
    levels : FrameLevels
        Darker pixels, those with less modulation and clipped ones do not count.

    Returns
    -------
    (parts, bins) int64
        From -pi to pi; by part of the picture.

    Raises
    ------
    ShapeError
        The image has another shape or dtype.
    """
    image = _checks.read_array("image", image, (gains.height, gains.width, 3), *LEVEL_TYPES)
    histogram = np.zeros((_PARTS**2, _BINS), np.int32)
    step = max(1, gains.height * gains.width // _COUNTED)
    thresholds = (levels.intensity, levels.modulation, levels.clipped)
    kernel = _count_phases_kernel(crosstalk.balance_first)
    kernel(image, crosstalk.inverse, crosstalk.weights, gains.gains, gains.cell, step, *thresholds, histogram)
    runtime.synchronize()
    return histogram.astype(np.int64)


def fit_phase(
    image: LevelsImage,
    gains: Gains,
    model: ChannelModel,
    crosstalk: Crosstalk,
    levels: FrameLevels,
    correction: npt.NDArray[np.float32],
    contrast_doubt: float,
    out: tuple[F32, F32, F32] | None = None,
) -> tuple[F32, F32, F32]:
    """Find the phase of every pixel that fits the channels' model best.

    Parameters
    ----------
    image : (H, W, 3) uint8, uint16 or float32
        Linear light, levels, stripes along the rows.
    gains : Gains
        The frame's, measured.
    model : ChannelModel
        The frame's, fitted.
    crosstalk : Crosstalk
        What both were made with.
    levels : FrameLevels
        The frame's noise, and what a pixel needs to have a phase.
    correction : (bins + 1,) float32
        rad to add to the arctangent; see `equalization.correction_table`.
    contrast_doubt : float
        Standard deviation of a pixel's contrast about what its neighbourhood shows, as a fraction.
    out : three (H, W) float32, optional
        Where the results go.

    Returns
    -------
    phase : (H, W) float32
        rad, a little beyond [-pi, pi]; NO_PHASE where a pixel is dark, clipped, or without fringe.
    modulation : (H, W) float32
        Amplitude of the fringe, levels.
    precision : (H, W) float32
        1 / rad^2: one over the phase's variance.

    Raises
    ------
    ShapeError
        A shape or dtype is another one, or an output cannot be written.
    """
    shape = (gains.height, gains.width)
    image = _checks.read_array("image", image, (*shape, 3), *LEVEL_TYPES)
    correction = _checks.read_array("correction", correction, (None,), np.float32)
    names, outs = ("phase", "modulation", "precision"), (None, None, None) if out is None else out
    results = tuple(_checks.out_buffer(name, o, shape, np.float32) for name, o in zip(names, outs, strict=True))
    _fit_phase_kernel(crosstalk.balance_first, gains.cell)(
        image,
        levels.white,
        crosstalk.inverse,
        crosstalk.matrix,
        crosstalk.weights,
        correction,
        model.template,
        model.nodes,
        levels.intensity,
        levels.modulation,
        levels.read_noise,
        levels.noise_gain,
        contrast_doubt,
        *results,
    )
    return results[0], results[1], results[2]
