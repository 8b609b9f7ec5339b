"""Wrapped phase, modulation and background of three sinusoids a third of a cycle apart.

R, G, B = a + b cos(phi - 2 pi/3), a + b cos(phi), a + b cos(phi + 2 pi/3) gives
phi = atan2(sqrt(3) (R - B), 2 G - R - B) (equation 2.4 of Je, Lee and Park 2004).
"""

from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from tikernels import _checks
from tikernels._taichi import AnyArray3, F32Array2, F32Array3, U8Array2, f32, i32, ti, vec3
from tikernels.phase_vector import arctangent, channel_waves, matrix_of, phase_vector

#: What a phase buffer holds outside the mask between two stages: no angle, and far from every threshold, where NaN
#: would slip through comparisons that the compiler takes to be free of NaN.
NO_PHASE = 100.0
#: The same, for a pixel that saw two surfaces at once.
STEP_PHASE = 2.0 * NO_PHASE

# Gain cells that one thread walks along a row: enough threads for a GPU, and more than the 512 iterations below which
# the CPU runtime uses a single core.
_CELLS_A_THREAD = 8
# Pixels that are worked on at once.
_LANES = 8
# A pixel with two channels at full scale has lost its phase; one alone bends it by 0.03 rad at the most.
_CLIPPED = 0.998


def phase_weights(
    inverse: npt.NDArray[np.float64], lag: npt.NDArray[np.float64] | None = None
) -> npt.NDArray[np.float64]:
    """Return the (3, 3) weights that take balanced camera channels to b (cos phi, sin phi) and 0.

    Parameters
    ----------
    inverse : (3, 3)
        Undoes the crosstalk.
    lag : (3,), optional
        See `channel_waves`.
    """
    weights: npt.NDArray[np.float64] = np.linalg.inv(channel_waves(lag))[[1, 2, 0]] @ inverse
    weights[2] = 0
    return weights


@cache
def recover_phase_kernel(balance_first: bool) -> Any:
    """Return the kernel from grey levels to phase: balance, crosstalk, arctangent and masks in one pass."""
    lanes = ti.types.vector(_LANES, ti.f32)

    @ti.func
    def node_gain(gains: F32Array3, i: i32, i1: i32, fraction: f32, j: i32) -> vec3:
        column = ti.min(ti.max(j, 0), gains.shape[1] - 1)
        result = vec3(0.0)
        for k in ti.static(range(3)):
            result[k] = gains[i, column, k] + fraction * (gains[i1, column, k] - gains[i, column, k])
        return result

    @ti.kernel
    def recover_phase(
        image: AnyArray3,  # (H, W, 3) levels
        white: f32,  # level of full scale
        inverse_matrix: F32Array2,  # (3, 3) undoes the crosstalk; used where the gains come after it
        phase_weights: F32Array2,  # (3, 3) takes the channels that the gains belong to to b (cos phi, sin phi), 0
        gains: F32Array3,  # (Hg, Wg, 3)
        cell: i32,  # px between two nodes of the gains
        min_intensity: f32,  # levels
        min_modulation: f32,  # levels
        out_phase: F32Array2,  # (H, W) rad, [-pi, pi]; NO_PHASE outside the mask
        out_modulation: F32Array2,  # (H, W) levels
    ):
        height, width = image.shape[0], image.shape[1]
        half = cell // 2
        stretches = (gains.shape[1] + _CELLS_A_THREAD) // _CELLS_A_THREAD
        for t in range(height * stretches):
            y, stretch = t // stretches, t % stretches
            inverse, weights = matrix_of(inverse_matrix), matrix_of(phase_weights)
            v = ti.min(ti.max((y + 0.5) / cell - 0.5, 0.0), ti.cast(gains.shape[0] - 1, ti.f32))
            i = ti.cast(v, ti.i32)
            i1 = ti.min(i + 1, gains.shape[0] - 1)
            fraction = v - i
            # Cell j lies between node j and the next one, whose pixels are half a cell further on.
            first = stretch * _CELLS_A_THREAD - 1
            right = node_gain(gains, i, i1, fraction, first)
            red, green, blue = lanes(0.0), lanes(0.0), lanes(0.0)
            phase, modulation = lanes(0.0), lanes(0.0)
            for j in range(first, ti.min(first + _CELLS_A_THREAD, gains.shape[1])):
                left = right
                right = node_gain(gains, i, i1, fraction, j + 1)
                slope = (right - left) / ti.cast(cell, ti.f32)
                start = j * cell + half
                x, stop = ti.max(start, 0), ti.min(start + cell, width)
                while x < stop:
                    count = ti.min(_LANES, stop - x)
                    for k in range(count):
                        red[k] = ti.cast(image[y, x + k, 0], ti.f32)
                        green[k] = ti.cast(image[y, x + k, 1], ti.f32)
                        blue[k] = ti.cast(image[y, x + k, 2], ti.f32)
                    for k in range(_LANES):
                        seen = vec3(red[k], green[k], blue[k])
                        channels = seen
                        if ti.static(not balance_first):
                            channels = inverse @ seen
                        gain = left + slope * (ti.cast(x + k - start, ti.f32) + 0.5)
                        vector = weights @ (channels * gain)
                        modulation[k] = ti.sqrt(vector.x * vector.x + vector.y * vector.y)
                        # The second brightest channel at full scale: two are.
                        low, high = ti.min(seen.x, seen.y), ti.max(seen.x, seen.y)
                        second = ti.max(low, ti.min(high, seen.z))
                        bright = (seen.sum() > 3.0 * min_intensity) & (second < _CLIPPED * white)
                        valid = bright & (modulation[k] > min_modulation)
                        phase[k] = ti.select(valid, arctangent(vector.y, vector.x), NO_PHASE)
                    for k in range(count):
                        out_phase[y, x + k] = phase[k]
                        out_modulation[y, x + k] = modulation[k]
                    x += _LANES

    return recover_phase


@ti.kernel
def mark_no_phase_kernel(
    wrapped_phase: F32Array2,  # (H, W) rad
    mask: U8Array2,  # (H, W)
    out: F32Array2,  # (H, W) rad; NO_PHASE outside the mask
):
    for pixel in range(wrapped_phase.shape[0] * wrapped_phase.shape[1]):
        y, x = pixel // wrapped_phase.shape[1], pixel % wrapped_phase.shape[1]
        value = NO_PHASE
        if mask[y, x] != 0 and not ti.math.isnan(wrapped_phase[y, x]):
            value = wrapped_phase[y, x]
        out[y, x] = value


@ti.kernel
def compute_wrapped_phase_kernel(
    image: F32Array3,  # (H, W, 3) linear light, balanced and without crosstalk
    out_phase: F32Array2,  # (H, W) rad
    out_modulation: F32Array2,  # (H, W)
    out_background: F32Array2,  # (H, W)
):
    for pixel in range(image.shape[0] * image.shape[1]):
        y, x = pixel // image.shape[1], pixel % image.shape[1]
        vector, background = phase_vector(vec3(image[y, x, 0], image[y, x, 1], image[y, x, 2]))
        out_phase[y, x] = arctangent(vector.y, vector.x)
        out_modulation[y, x] = vector.norm()
        out_background[y, x] = background


def compute_wrapped_phase(image: Any, out: tuple[Any, Any, Any] | None = None) -> tuple[Any, Any, Any]:
    """Compute wrapped phase, modulation and background.

    Parameters
    ----------
    image : (H, W, 3) float32
        R, G, B in linear light, balanced and without crosstalk.
    out : three (H, W) float32, optional
        Where the results go.

    Returns
    -------
    wrapped_phase : (H, W) float32
        rad in [-pi, pi]; green is brightest at 0.
    modulation : (H, W) float32
        Amplitude of the sinusoid, in the image's unit.
    background : (H, W) float32
        Its mean.

    Raises
    ------
    ShapeError
        A shape or dtype is another one, or an output cannot be written.

    Notes
    -----
    The arctangent is a polynomial with an error of 2e-6 rad. Where the modulation is zero the phase means nothing.

    Examples
    --------
    >>> import numpy as np, tikernels
    >>> _ = tikernels.init("cpu")
    >>> codes = 0.5 + 0.25 * np.cos(1.0 + np.array([-1, 0, 1]) * 2 * np.pi / 3)
    >>> phase, modulation, background = compute_wrapped_phase(codes.reshape(1, 1, 3).astype(np.float32))
    >>> round(float(phase[0, 0]), 4), round(float(modulation[0, 0]), 4), round(float(background[0, 0]), 4)
    (1.0, 0.25, 0.5)
    """
    image = _checks.read_array("image", image, (None, None, 3), np.float32)
    shape = (int(image.shape[0]), int(image.shape[1]))
    names = ("wrapped_phase", "modulation", "background")
    outs = out if out is not None else (None, None, None)
    results = tuple(_checks.out_array(name, o, shape, np.float32) for name, o in zip(names, outs, strict=True))
    compute_wrapped_phase_kernel(image, *results)
    return results[0], results[1], results[2]
