"""Places of surfaces next to what each surface's matrix predicts of them: what `surface_matrix.py` is fitted to.

In units of noise a place is c = s K p(phi) + z n, n across K p and its derivative by the phase, K p'. A step of Gauss
and Newton finds the phase; what lies across K p' determines s, so neither s nor z depends on a phase a little off.
"""

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tikernels import runtime
from tikernels._taichi import F32Array2, F32Array3, Static, f32, ti, vec3
from tikernels.lanes import LANES, float_lanes
from tikernels.launching import kernel
from tikernels.phase.channel_template import HARMONICS, load_harmonics, sharpened_cycle_and_slope
from tikernels.phase.phase_vector import TINY, cosine_and_sine
from tikernels.phase.surfaces import surface_ambient, surface_matrix
from tikernels.strips import SPREAD, color_of, lanes_of_colors, strip_at, strip_count

_Array = npt.NDArray[np.float64]
_Floats = npt.NDArray[np.floating]

# A step of Gauss and Newton in the phase goes no further than this, rad.
_PHASE_STEP = 0.2


@dataclass(frozen=True, eq=False)
class SurfaceSamples:
    """Places of n surfaces, S of each, and what is known of them; float32."""

    light: _Floats  # (n, 3, S) the camera's, levels
    variance: _Floats  # (n, 3, S) of the noise
    phase: _Floats  # (n, S) rad, where the fit begins
    around: _Floats  # (n, S) mean brightness around, levels
    contrast: _Floats  # (n, S) of the first harmonic relative to the light's, as a factor; the nth has its power of n^2
    share: _Array  # (n,) of the S places, how many there are: of a small surface some are listed again
    contrast_doubt: float  # standard deviation of each place's contrast, as a fraction


class _Row(IntEnum):
    """First rows of what `compare_samples_kernel` writes; see `ComparedSamples`."""

    RESIDUAL = 0
    VARIANCE = 1
    BRIGHTNESS = 2
    SQUARE = 3
    WAVES = 4
    ACROSS = 7
    ALONG = 10
    TURNS = 13


_ROWS = _Row.TURNS + 2 * HARMONICS
_row_lanes = ti.types.matrix(_ROWS, LANES, ti.f32)


class ComparedSamples(NamedTuple):
    """Places next to their model, (n, 1 or more, S)."""

    phase: _Floats  # (n, S) rad, what fits best
    residual: _Floats  # z, in standard deviations of the noise
    variance: _Floats  # of z, since a place's contrast is not quite the light's
    brightness: _Floats  # s
    square: _Floats  # of s K p, in units of noise
    waves: _Floats  # (n, 3, S) p
    across: _Floats  # (n, 3, S) by how much z changes with the light, per level
    along: _Floats  # (n, 3, S) by how much the logarithm of s does
    turns: _Floats  # (n, 2 harmonics, S) cosines, then sines, each by what blur leaves of it


@ti.func
def blurred_cycle(harmonics: Static, angle: f32, contrast: f32):
    """Return p and its derivative by the phase where blur has taken of the contrast."""
    square = contrast * contrast
    third, eighth = square * contrast, square * square * square * square
    factors = vec3(third, eighth, eighth * square * square * third)
    cycle, slope = sharpened_cycle_and_slope(harmonics, angle, factors)
    return 1.0 + contrast * (cycle - 1.0), contrast * slope


@kernel
def compare_samples_kernel(
    light: F32Array3,  # (n, 3, S) levels
    variance: F32Array3,  # (n, 3, S)
    contrast: F32Array2,  # (n, S)
    matrices: F32Array3,  # (n, 3, 3)
    ambient: F32Array2,  # (n, 3) levels
    template: F32Array2,  # (3, terms) of the projector's light
    contrast_doubt: f32,
    phase: F32Array2,  # (n, S) rad, to be changed
    out: F32Array3,  # (n, rows, S) see `_Row`
):
    size = phase.shape[1]
    for t in range(SPREAD * phase.shape[0] * strip_count(size, LANES)):
        if t % SPREAD > 0:
            continue
        surface, first, count = strip_at(t // SPREAD, size, LANES)
        matrix, harmonics = surface_matrix(matrices, surface), load_harmonics(template)
        rest = surface_ambient(ambient, surface)
        seen, weights, found = lanes_of_colors(0.0), lanes_of_colors(1.0), _row_lanes(0.0)
        angle, sharp = float_lanes(0.0), float_lanes(1.0)
        for k in range(count):
            for c in ti.static(range(3)):
                weights[c, k] = 1.0 / ti.sqrt(variance[surface, c, first + k])
                seen[c, k] = (light[surface, c, first + k] - rest[c]) * weights[c, k]
            angle[k], sharp[k] = phase[surface, first + k], contrast[surface, first + k]
        for k in range(LANES):
            cycle, slope = blurred_cycle(harmonics, angle[k], sharp[k])
            weight, channels = color_of(weights, k), color_of(seen, k)
            model, change = weight * (matrix @ cycle), weight * (matrix @ slope)
            across = change - change.dot(model) / model.dot(model) * model
            step = channels.dot(across) * model.dot(model) / ti.max(channels.dot(model), TINY) / across.dot(across)
            angle[k] += ti.math.clamp(step, -_PHASE_STEP, _PHASE_STEP)
        for k in range(LANES):
            cycle, slope = blurred_cycle(harmonics, angle[k], sharp[k])
            weight, channels = color_of(weights, k), color_of(seen, k)
            model, change = weight * (matrix @ cycle), weight * (matrix @ slope)
            square, normal = model.dot(model), model.cross(change)
            normal /= ti.sqrt(normal.dot(normal))
            along = change.dot(change) * model - model.dot(change) * change
            along /= along.dot(model)
            brightness = ti.max(channels.dot(along), TINY)
            along /= brightness
            swing = contrast_doubt * brightness * normal.dot(weight * (matrix @ (cycle - 1.0)))
            found[_Row.RESIDUAL, k], found[_Row.VARIANCE, k] = channels.dot(normal), 1.0 + swing * swing
            found[_Row.BRIGHTNESS, k], found[_Row.SQUARE, k] = brightness, square * brightness * brightness
            for c in ti.static(range(3)):
                found[_Row.WAVES + c, k] = cycle[c]
                found[_Row.ACROSS + c, k] = weight[c] * normal[c]
                found[_Row.ALONG + c, k] = weight[c] * along[c]
            cosine, sine = cosine_and_sine(angle[k])
            real, imaginary, left, factor = cosine, sine, sharp[k], sharp[k]
            for n in ti.static(range(HARMONICS)):
                found[_Row.TURNS + n, k], found[_Row.TURNS + HARMONICS + n, k] = left * real, left * imaginary
                real, imaginary = real * cosine - imaginary * sine, real * sine + imaginary * cosine
                factor *= sharp[k] * sharp[k]
                left *= factor
        for k in range(count):
            phase[surface, first + k] = angle[k]
            for row in ti.static(range(_ROWS)):
                out[surface, row, first + k] = found[row, k]


def compare_samples(
    samples: SurfaceSamples,
    matrices: _Array,
    ambient: _Array,
    light: npt.NDArray[np.complex128],
) -> ComparedSamples:
    """Find the phase and the brightness of places, and what these leave over.

    Parameters
    ----------
    samples : SurfaceSamples
        The places.
    matrices, ambient : (n, 3, 3), (n, 3)
        Of their surfaces; levels.
    light : (3, 4) complex128
        Harmonics of the projector's light over its mean, from the first on.
    """
    template = np.concatenate([np.ones((3, 1)), light.real, -light.imag], axis=1)
    tables = (matrices.astype(np.float32), ambient.astype(np.float32), template.astype(np.float32))
    phase = samples.phase.copy()
    out = np.empty((len(phase), _ROWS, phase.shape[1]), np.float32)
    given = (samples.light, samples.variance, samples.contrast)
    compare_samples_kernel(*given, *tables, samples.contrast_doubt, phase, out)
    runtime.synchronize()
    return ComparedSamples(phase, *np.split(out, list(_Row)[1:], axis=1))
