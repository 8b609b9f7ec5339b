"""What each channel of a pixel should be, given its phase: the surface's light, with all that bends it.

    C_i = s A_i t_i(phi) + B_i

t_i is one cycle of channel i, the same all over the frame: projector response, crosstalk and lateral colour are in it,
whatever they are, because it is read off the frame itself. A_i, the surface's colour, and B_i, the ambient light that
it sends back, change slowly and are fitted around every node of a coarse grid; s, the pixel's own brightness, is free.
Where the pixel turns away from the projector the fringe fades and the ambient light stays: only a model with B_i knows.

Three channels and two unknowns, s and phi: of all phases the likeliest is a step of Gauss and Newton from the
arctangent's (`wrapped_phase.py`), and the one combination that neither of the two can change tells how well the model
fits.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from tikernels import runtime
from tikernels._taichi import F32Array1, F32Array2, F32Array3, Static, f32, i32, ti, vec3
from tikernels.phase.color_balance import Gains, gain_at
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.equalization import equalized
from tikernels.phase.frame_statistics import FrameLevels
from tikernels.phase.phase_vector import arctangent, cosine_and_sine, matrix_of
from tikernels.phase.wrapped_phase import NO_PHASE

#: Harmonics of a channel over one cycle: gamma 2 makes two, and a third changes nothing.
HARMONICS = 2
_TERMS = 1 + 2 * HARMONICS
_UPPER = tuple((a, b) for a in range(_TERMS) for b in range(a, _TERMS))
_CORNERS = len(_UPPER)
# Samples that one thread adds up.
_RUN = 64
# Every second row of samples tells the template.
_EVERY = 2
# The template starts from what is known with the weight of so many samples: nothing where there is a surface.
_PRIOR_SAMPLES = 30
# Ambient light is at most this share of a surface's; more, and it is the contrast that is read wrongly.
_MAX_AMBIENT = 0.6
# Surfaces that vary less in brightness than this, as a fraction, do not tell ambient light from a low contrast.
_MIN_VARIATION = 0.03
# The ambient light that a node is fitted with is held to the frame's share as if by so large a part of its samples.
_RIDGE = 1e-3
# Per-channel corrections beyond a factor of two are a fit gone wrong, at a speck of a few samples.
_MIN_FACTOR, _MAX_FACTOR = 0.5, 2.0


def known_template(
    matrix: npt.NDArray[np.floating[Any]],
    response: npt.NDArray[np.float64],
    lag: npt.NDArray[np.float64] | None = None,
) -> npt.NDArray[np.float32]:
    """Return (3, terms) float32: one cycle of each channel of a rig that is known.

    Parameters
    ----------
    matrix : (3, 3)
        What takes the projector's balanced channels to the template's.
    response : (3, N)
        Light of N evenly spaced codes of R, G, B.
    lag : (3,), optional
        See `channel_waves`.
    """
    codes = 0.5 + 0.5 * np.cos(np.linspace(0, 2 * np.pi, 1024, endpoint=False))
    light = np.stack([np.interp(codes, np.linspace(0, 1, response.shape[1]), row) for row in response])
    n = np.arange(1, HARMONICS + 1)
    spectrum = np.fft.rfft(light, axis=1).real
    delays = np.array([-1, 0, 1]) * 2 * np.pi / 3 - (0 if lag is None else lag)
    waves = 2 * spectrum[:, 1 : HARMONICS + 1] / spectrum[:, :1] * np.exp(1j * n * delays[:, None])
    mixed = matrix @ np.concatenate([np.ones((3, 1)), waves.real, -waves.imag], axis=1)
    return np.asarray(mixed / mixed[:, :1], np.float32)


def flat_template() -> npt.NDArray[np.float32]:
    """Return (3, terms) float32: the template of a rig of which nothing is known."""
    return np.eye(1, _TERMS, dtype=np.float32).repeat(3, axis=0)


def _mismatch(template: npt.NDArray[np.float32], weights: npt.NDArray[np.float32]) -> float:
    """Return by how much the channels' fundamentals differ from those that `phase_weights` are made for.

    What all three have in common, a phase and a modulation, is the surface's and the response's. NaN without samples.
    """
    waves = np.linalg.inv(weights.astype(np.float64))
    ratio = (template[:, 1] - 1j * template[:, 1 + HARMONICS]) / (waves[:, 0] - 1j * waves[:, 1])
    if abs(ratio.mean()) == 0:
        return np.nan
    return float(np.sqrt((np.abs(ratio / ratio.mean() - 1) ** 2).sum() / 2))


class ChannelModel:
    """The model of one frame, and the buffers to fit it, for the grid of `gains`."""

    def __init__(self, gains: Gains) -> None:
        self._gains = gains
        height, columns = int(gains.samples.shape[0]), int(gains.samples.shape[1])
        blocks = tuple(gains.sums.shape[:2])
        #: (H, Wb) rad, the samples' bare phase; NO_PHASE where there is none.
        self.phases = runtime.empty((height, columns), np.float32)
        runs = height * -(-columns // _RUN)
        self._moments = runtime.empty((runs, 5), np.float32)
        template_runs = -(-height // _EVERY) * -(-columns // _RUN)
        self._normal = runtime.empty((template_runs, _CORNERS + 3 * _TERMS), np.float32)
        self._sums = runtime.empty((*blocks, 13), np.float32)
        self._half = runtime.empty((*gains.grid, 13), np.float32)
        self._smooth = runtime.empty((*gains.grid, 13), np.float32)
        #: (Hg, Wg, 6) A and B of the channels that the gains belong to, in levels where s is in levels.
        self.nodes = runtime.empty((*gains.grid, 6), np.float32)
        #: (3, terms) t_i: 1, cosines, sines.
        self.template = np.zeros((3, _TERMS), np.float32)
        #: How far the template's fundamentals are from those that crosstalk and lateral colour make, as a fraction.
        self.mismatch = np.nan
        #: The samples' mean modulation over their mean background; NaN without samples.
        self.contrast = np.nan
        self._share = 0.0
        self._weights = np.zeros((3, 3), np.float32)

    def recover_samples(self, crosstalk: Crosstalk, levels: FrameLevels) -> None:
        """Balance the samples by the gains, and find their bare phase, the arctangent's.

        Parameters
        ----------
        crosstalk : Crosstalk
            What the gains were measured with.
        levels : FrameLevels
            Clipped samples, and those with less modulation, say nothing.
        """
        gains = self._gains
        self._weights = crosstalk.weights
        samples = (gains.samples, gains.gains, gains.cell, crosstalk.weights)
        recover_samples_kernel(*samples, levels.modulation, levels.clipped, self.phases, self._moments)
        count, modulation, background, square, product = runtime.to_host(self._moments).sum(axis=0, dtype=np.float64)
        # Over the frame the modulation is proportional to what the projector sends, the background has the ambient
        # light in it, too.
        self._share, self.contrast = 0.0, float(modulation / background) if background > 0 else np.nan
        if count > 0:
            variance, covariance = square - background**2 / count, product - background * modulation / count
            if variance * count > (_MIN_VARIATION * background) ** 2 and covariance > 0:
                self._share = float(np.clip(1 - modulation * variance / (covariance * background), 0, _MAX_AMBIENT))

    def fit(self, correction: npt.NDArray[np.float32], known: npt.NDArray[np.float32]) -> None:
        """Fit the template to the samples, then A and B around every node.

        Parameters
        ----------
        correction : (bins + 1,) float32
            rad, to be added to the bare phase; see `equalization.correction_table`.
        known : (3, terms) float32
            The template as far as it is known: it helps to tell the samples' brightness, and stays where there are
            hardly any.
        """
        gains = self._gains
        args = (gains.samples, self.phases, correction, self._weights, known, gains.smooth, gains.cell, self._share)
        sum_template_kernel(*args, self._normal)
        normal = runtime.to_host(self._normal).sum(axis=0, dtype=np.float64)  # synchronises
        gram = np.zeros((_TERMS, _TERMS))
        gram[tuple(np.transpose(_UPPER))] = normal[:_CORNERS]
        gram += np.triu(gram, 1).T
        weight = max(gram[0, 0], 1e-6) / max(np.count_nonzero(runtime.to_host(self.phases)[::_EVERY] < NO_PHASE), 1)
        prior = _PRIOR_SAMPLES * weight * np.array([1.0] + [0.5] * (2 * HARMONICS))
        gram += np.diag(prior)
        right = normal[_CORNERS:].reshape(_TERMS, 3) + prior[:, None] * known.T
        solved = np.linalg.solve(gram, right)
        self.template[:] = (solved / solved[0]).T
        self.mismatch = _mismatch(self.template, self._weights)
        fitted = (gains.samples, self.phases, correction, self.template, gains.smooth, gains.rows, self._share)
        sum_model_kernel(*fitted, self._sums)
        gains.smooth_sums(self._sums, self._half, self._smooth)
        fit_nodes_kernel(self._smooth, gains.smooth, gains.gains, self._share, self.nodes)


@ti.func
def waves_of(phase: f32):
    """Return 1, cos and sin of the phase and its multiples, in the template's order."""
    c, s = cosine_and_sine(phase)
    result = ti.Vector.zero(f32, _TERMS)
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
    for n in ti.static(range(_TERMS)):
        result += waves[n] * vec3(template[0, n], template[1, n], template[2, n])
    return result


@ti.kernel
def recover_samples_kernel(
    samples: F32Array3,  # (H, Wb, 3) the channels that the gains belong to, levels; they are balanced
    gains: F32Array3,  # (Hg, Wg, 3)
    cell: i32,
    phase_weights: F32Array2,  # (3, 3)
    min_modulation: f32,  # levels
    max_level: f32,
    out_phase: F32Array2,  # (H, Wb) rad; NO_PHASE where there is none
    out_moments: F32Array2,  # (runs, 5) sums of 1, modulation, background, its square, the product
):
    columns = samples.shape[1]
    runs = (columns + _RUN - 1) // _RUN
    for run in range(samples.shape[0] * runs):
        y, first = run // runs, (run % runs) * _RUN
        weights = matrix_of(phase_weights)
        moments = ti.Vector.zero(f32, 5)
        for j in range(first, ti.min(first + _RUN, columns)):
            seen = vec3(samples[y, j, 0], samples[y, j, 1], samples[y, j, 2])
            balanced = seen * gain_at(gains, cell, y, j * cell + cell // 2)
            vector = weights @ balanced
            modulation, background = ti.sqrt(vector.x * vector.x + vector.y * vector.y), vector.z
            phase = NO_PHASE
            if modulation > min_modulation and seen.max() < max_level:
                phase = arctangent(vector.y, vector.x)
                moments += ti.Vector([1.0, modulation, background, background * background, background * modulation])
            out_phase[y, j] = phase
            for k in ti.static(range(3)):
                samples[y, j, k] = balanced[k]
        for k in ti.static(range(5)):
            out_moments[run, k] = moments[k]


@ti.func
def ambient_at(smooth: F32Array3, cell: i32, share: f32, y: i32, x: i32) -> f32:
    """Ambient light near a pixel: the frame's share of the mean background there."""
    i = ti.min(y // cell, smooth.shape[0] - 1)
    j = ti.min(x // cell, smooth.shape[1] - 1)
    return share * smooth[i, j, 6] / ti.max(smooth[i, j, 7], 1e-6)


@ti.kernel
def sum_template_kernel(
    samples: F32Array3,  # (H, Wb, 3) balanced, levels
    phases: F32Array2,  # (H, Wb) rad
    correction: F32Array1,  # (bins + 1,) rad
    phase_weights: F32Array2,  # (3, 3)
    known: F32Array2,  # (3, terms)
    smooth: F32Array3,  # (Hg, Wg, 8) background and count last
    cell: i32,
    share: f32,
    out_normal: F32Array2,  # (runs, terms) the normal equations: upper triangle, right sides
):
    columns = samples.shape[1]
    runs = (columns + _RUN - 1) // _RUN
    for run in range((samples.shape[0] + _EVERY - 1) // _EVERY * runs):
        y, first = run // runs * _EVERY, (run % runs) * _RUN
        # The upper triangle of the symmetric equations, row by row, and the right sides.
        gram, right = ti.Vector.zero(f32, _CORNERS), ti.Matrix.zero(f32, _TERMS, 3)
        brightness = vec3(phase_weights[2, 0], phase_weights[2, 1], phase_weights[2, 2])
        for j in range(first, ti.min(first + _RUN, columns)):
            if phases[y, j] < 0.5 * NO_PHASE:
                ambient = ambient_at(smooth, cell, share, y, j * cell)
                waves = waves_of(equalized(phases[y, j], correction))
                light = vec3(samples[y, j, 0], samples[y, j, 1], samples[y, j, 2]) - ambient
                # Each sample with its own brightness: bright ones count more, as they are more certain. The background
                # tells it whatever the phase, but for what is known of the response and lateral colour.
                waves *= light.dot(brightness) / cycle_at(known, waves).dot(brightness)
                for place in ti.static(range(_CORNERS)):
                    gram[place] += waves[_UPPER[place][0]] * waves[_UPPER[place][1]]
                right += waves.outer_product(light)
        for place in ti.static(range(_CORNERS)):
            out_normal[run, place] = gram[place]
        for a in ti.static(range(_TERMS)):
            for k in ti.static(range(3)):
                out_normal[run, _CORNERS + 3 * a + k] = right[a, k]


@ti.kernel
def sum_model_kernel(
    samples: F32Array3,  # (H, Wb, 3) balanced, levels
    phases: F32Array2,  # (H, Wb) rad
    correction: F32Array1,  # (bins + 1,) rad
    template: F32Array2,  # (3, terms)
    smooth: F32Array3,  # (Hg, Wg, 8) background and count last
    rows: i32,
    share: f32,
    out_sums: F32Array3,  # (Hb, Wb, 13) count; a channel's model, its square, the channel, their product
):
    height = samples.shape[0]
    for block in range(out_sums.shape[0] * out_sums.shape[1]):
        i, j = block // out_sums.shape[1], block % out_sums.shape[1]
        count = 0.0
        model, square, seen, product = vec3(0.0), vec3(0.0), vec3(0.0), vec3(0.0)
        ambient = ambient_at(smooth, 2 * rows, share, i * rows, j * 2 * rows)
        for y in range(i * rows, ti.min((i + 1) * rows, height)):
            if phases[y, j] < 0.5 * NO_PHASE:
                waves = waves_of(equalized(phases[y, j], correction))
                light = vec3(samples[y, j, 0], samples[y, j, 1], samples[y, j, 2]) - ambient
                cycle = cycle_at(template, waves)
                expected = light.dot(cycle) / cycle.dot(cycle) * cycle
                count += 1.0
                model += expected
                square += expected * expected
                seen += light + ambient
                product += expected * (light + ambient)
        out_sums[i, j, 0] = count
        for k in ti.static(range(3)):
            out_sums[i, j, 1 + k] = model[k]
            out_sums[i, j, 4 + k] = square[k]
            out_sums[i, j, 7 + k] = seen[k]
            out_sums[i, j, 10 + k] = product[k]


@ti.kernel
def fit_nodes_kernel(
    sums: F32Array3,  # (Hg, Wg, 13) `sum_model_kernel`'s, smoothed
    smooth: F32Array3,  # (Hg, Wg, 8)
    gains: F32Array3,  # (Hg, Wg, 3)
    share: f32,
    out_nodes: F32Array3,  # (Hg, Wg, 6) A and B
):
    for node in range(sums.shape[0] * sums.shape[1]):
        i, j = node // sums.shape[1], node % sums.shape[1]
        ambient = share * smooth[i, j, 6] / ti.max(smooth[i, j, 7], 1e-6)
        for k in ti.static(range(3)):
            # A straight line through what the channel is over what it should be.
            count, model, square = sums[i, j, 0] * (1.0 + _RIDGE), sums[i, j, 1 + k], sums[i, j, 4 + k]
            seen, product = sums[i, j, 7 + k] + _RIDGE * sums[i, j, 0] * ambient, sums[i, j, 10 + k]
            determinant = count * square - model * model
            factor, rest = 1.0, ambient
            if count > 1e-3 and determinant > 1e-3 * count * square:
                factor = ti.min(ti.max((count * product - model * seen) / determinant, _MIN_FACTOR), _MAX_FACTOR)
                rest = (seen - factor * model) / count
            out_nodes[i, j, k] = factor / gains[i, j, k]
            out_nodes[i, j, 3 + k] = rest / gains[i, j, k]
