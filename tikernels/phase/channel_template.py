"""One cycle of each channel: how a balanced channel changes with the phase, the same all over the frame.

    t_i(phi) = 1 + sum over n of c_in cos(n phi) + s_in sin(n phi)

has projector response, crosstalk and lateral colour in it. `channel_model.py` measures it in the frame; here are what
is known of it beforehand, and the mathematics of a pixel. Its rows are 1, c_i1 to c_i4, s_i1 to s_i4.

Four harmonics, although a response of gamma 2 makes two: a sample is divided by its own brightness, which has the
response's third harmonic r in it, common to channels a third of a cycle apart. So cos(phi) becomes
cos(phi) (1 - r cos 3 phi), a second and a fourth harmonic of r / 2; a template without the fourth leaves a ripple of
three times per cycle, 0.026 rad at gamma 2.3. A third of its own has only what the channels do not have in common.
"""

import numpy as np
import numpy.typing as npt

from tikernels._taichi import F32Array2, Static, f32, ti, vec3
from tikernels.launching import constant
from tikernels.phase.phase_vector import cosine_and_sine

#: Harmonics of a channel over one cycle.
HARMONICS = 4
#: Numbers of a channel's template.
TERMS = 1 + 2 * HARMONICS


def known_template(matrix: npt.NDArray[np.floating], light: npt.NDArray[np.complex128]) -> npt.NDArray[np.float32]:
    """Return (3, terms) float32: one cycle of each channel of a rig that is known.

    Parameters
    ----------
    matrix : (3, 3)
        Map from the projector's balanced channels to the template's.
    light : (3, N) complex128
        Harmonics from the zeroth on of the projector's light; see `projector_response.light_spectrum`.
    """
    waves = 2 * light[:, 1 : HARMONICS + 1] / light[:, :1].real
    mixed = matrix @ np.concatenate([np.ones((3, 1)), waves.real, -waves.imag], axis=1)
    return constant(np.asarray(mixed / mixed[:, :1], np.float32))


def channel_harmonics(template: npt.NDArray[np.floating]) -> npt.NDArray[np.complex128]:
    """Return (3, harmonics): a template's harmonics from the first on, the real part of each times a turning wave."""
    return np.asarray(template[:, 1 : 1 + HARMONICS] - 1j * template[:, 1 + HARMONICS :], np.complex128)


def flat_template() -> npt.NDArray[np.float32]:
    """Return (3, terms) float32: the template of a rig of which nothing is known."""
    return constant(np.eye(1, TERMS, dtype=np.float32).repeat(3, axis=0))


def template_mismatch(template: npt.NDArray[np.float32], weights: npt.NDArray[np.float32]) -> float:
    """Return by how much the channels' fundamentals differ from those that `phase_weights` are made for, as a fraction.

    What all three have in common, a phase and a modulation, is the surface's and the response's.

    Parameters
    ----------
    template : (3, terms) float32
        One cycle of each channel.
    weights : (3, 3) float32
        `phase_weights`.

    Returns
    -------
    float
        0 or more; NaN for a flat template.
    """
    waves = np.linalg.inv(weights.astype(np.float64))
    ratio = channel_harmonics(template)[:, 0] / (waves[:, 0] - 1j * waves[:, 1])
    if abs(ratio.mean()) == 0:
        return np.nan
    return float(np.sqrt((np.abs(ratio / ratio.mean() - 1) ** 2).sum() / 2))


@ti.func
def waves_of(phase: f32):
    """Return 1, cos and sin of the phase and its multiples, in the template's order."""
    c, s = cosine_and_sine(phase)
    result = ti.Vector.zero(f32, TERMS)
    result[0] = 1.0
    real, imaginary = c, s
    for n in ti.static(range(1, HARMONICS + 1)):
        result[n] = real
        result[HARMONICS + n] = imaginary
        real, imaginary = real * c - imaginary * s, real * s + imaginary * c
    return result


@ti.func
def cycle_at(template: F32Array2, waves: Static) -> vec3:
    """Return the template's three channels, given `waves_of` the phase."""
    result = vec3(0.0)
    for n in ti.static(range(TERMS)):
        result += waves[n] * vec3(template[0, n], template[1, n], template[2, n])
    return result


@ti.func
def load_harmonics(template: F32Array2):
    """Load the template without its constants, which are one: (3, 2 harmonics), once a thread."""
    result = ti.Matrix.zero(f32, 3, TERMS - 1)
    for channel, n in ti.static(ti.ndrange(3, TERMS - 1)):
        result[channel, n] = template[channel, 1 + n]
    return result


@ti.func
def sharpening_factors(sharpness: f32):
    """Return what `waves_of` are to be multiplied by, given `FringeSharpness`'s value: see `sharpening_of`."""
    result, factors = ti.Vector.one(f32, TERMS), sharpening_of(sharpness)
    for n in ti.static(range(2, HARMONICS + 1)):
        result[n], result[HARMONICS + n] = factors[n - 2], factors[n - 2]
    return result


@ti.func
def sharpening_of(sharpness: f32):
    """Return what harmonics 2 to 4 are multiplied by, exp((n^2 - 1) sharpness); see `fringe_sharpness.py`."""
    # From one to the next by exp((2 n + 1) sharpness): an exponential is a call of the C library.
    result, factor, once = vec3(0.0), 1.0, ti.exp(sharpness)
    ratio = once * once * once
    for n in ti.static(range(HARMONICS - 1)):
        factor *= ratio
        result[n] = factor
        ratio *= once * once
    return result


@ti.func
def cycle_and_slope(harmonics: Static, phase: f32):
    """Return the template's three channels at a phase and their derivatives, given `load_harmonics`."""
    return sharpened_cycle_and_slope(harmonics, phase, vec3(1.0))


@ti.func
def sharpened_cycle_and_slope(harmonics: Static, phase: f32, factors: vec3):
    """Return `cycle_and_slope` of harmonics that are to be multiplied by these factors; see `sharpening_of`."""
    cycle, slope = cycles_and_slopes(harmonics, phase, factors)
    return vec3(cycle), vec3(slope)


@ti.func
def cycles_and_slopes(harmonics: Static, phase: Static, factors: Static):
    """Return lists of `sharpened_cycle_and_slope`'s three channels; phase and factors may be lanes."""
    cosine, sine = cosine_and_sine(phase)
    cycle = [1.0 + harmonics[c, 0] * cosine + harmonics[c, HARMONICS] * sine for c in ti.static(range(3))]
    slope = [harmonics[c, HARMONICS] * cosine - harmonics[c, 0] * sine for c in ti.static(range(3))]
    real, imaginary = cosine, sine
    for n in ti.static(range(2, HARMONICS + 1)):
        real, imaginary = real * cosine - imaginary * sine, real * sine + imaginary * cosine
        even, odd = factors[n - 2] * real, factors[n - 2] * imaginary
        for c in ti.static(range(3)):
            of_cosine, of_sine = harmonics[c, n - 1], harmonics[c, HARMONICS + n - 1]
            cycle[c] += of_cosine * even + of_sine * odd
            slope[c] += n * (of_sine * even - of_cosine * odd)
    return cycle, slope
