"""Wrapped phase, modulation and background of three sinusoids a third of a cycle apart.

R, G, B = a + b cos(phi - 2 pi/3), a + b cos(phi), a + b cos(phi + 2 pi/3) gives
phi = atan2(sqrt(3) (R - B), 2 G - R - B) (equation 3.3 of Je, Lee and Park 2004).
"""

import numpy as np

from tikernels import checks
from tikernels._taichi import F32Array2, F32Array3, U8Array2, f32, ti, u1
from tikernels.arrays import F32
from tikernels.launching import kernel
from tikernels.phase.phase_vector import PI, arctangent, color_at, modulation_of, phase_vector

#: What a phase buffer holds outside the mask between two stages: no angle, and far from every threshold, where NaN
#: would slip through comparisons that the compiler takes to be free of NaN.
NO_PHASE = 100.0
#: The same, for a pixel that saw two surfaces at once.
STEP_PHASE = 2.0 * NO_PHASE
#: Values of a buffer (rad) are no phase beyond the first of these, and STEP_PHASE beyond the second. Each is half-way
#: between what it separates, so that rounding decides nothing.
LEAST_NO_PHASE, LEAST_STEP_PHASE = 0.5 * NO_PHASE, 0.5 * (NO_PHASE + STEP_PHASE)


@ti.func
def has_phase(phase: f32) -> u1:
    """Return whether this is a phase, and neither NO_PHASE nor STEP_PHASE."""
    return phase < LEAST_NO_PHASE


@ti.func
def whole_cycles(angle: f32) -> f32:
    """Return how many whole cycles bring an angle into [-pi, pi]."""
    return ti.floor(angle * (0.5 / PI) + 0.5)  # ti.round is a call of the C library


@ti.func
def without_cycles(angle: f32) -> f32:
    """Return an angle less its whole cycles, in [-pi, pi]."""
    return angle - 2.0 * PI * whole_cycles(angle)


@kernel
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


@kernel
def compute_wrapped_phase_kernel(
    image: F32Array3,  # (H, W, 3) linear light, balanced and without crosstalk
    out_phase: F32Array2,  # (H, W) rad
    out_modulation: F32Array2,  # (H, W)
    out_background: F32Array2,  # (H, W)
):
    for pixel in range(image.shape[0] * image.shape[1]):
        y, x = pixel // image.shape[1], pixel % image.shape[1]
        vector = phase_vector(color_at(image, y, x))
        out_phase[y, x] = arctangent(vector.y, vector.x)
        out_modulation[y, x] = modulation_of(vector)
        out_background[y, x] = vector.z


def compute_wrapped_phase(image: F32, out: tuple[F32, F32, F32] | None = None) -> tuple[F32, F32, F32]:
    """Compute wrapped phase, modulation and background.

    Parameters
    ----------
    image : (H, W, 3) float32
        R, G, B in linear light, balanced and without crosstalk.
    out : three (H, W) float32, optional
        Output arrays.

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
    image = checks.read_array("image", image, (None, None, 3), np.float32)
    shape = (int(image.shape[0]), int(image.shape[1]))
    names = ("wrapped_phase", "modulation", "background")
    outs = out if out is not None else (None, None, None)
    results = tuple(checks.out_array(name, o, shape, np.float32) for name, o in zip(names, outs, strict=True))
    compute_wrapped_phase_kernel(image, *results)
    return results[0], results[1], results[2]
