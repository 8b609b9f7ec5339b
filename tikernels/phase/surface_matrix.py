"""What a surface's colour makes of the crosstalk: a matrix, predicted from the colour and fitted to its pixels.

Of M, the crosstalk on white, entry ij belongs to the wavelengths where filter i and primary j meet, and is weighed by
the reflectance there:

    K_ij = M_ij exp(sum over k of L_ijk log rho_k),

rho_k the reflectance at three primaries, its logarithm linear between them. With the primaries alone (L_ijk = 1 for
j = k) that is M diag(rho), with the filters alone diag(rho) M; real ones lie between. rho follows from the surface's
mean colour, three numbers from three, and K is a prior for what its pixels say. The weights L are those of the rig, the
same on all surfaces, which are therefore fitted together; what else is wrong with K grows with the range of log rho.
Behind lasers K = M diag(rho) to 0.1 %; behind lamps and filters that overlap, up to a third of log rho is the filters'.
Given K, each pixel has two unknowns, brightness and phase, and one number is left over,

    z = c n,    n across K p and K p',

c the pixel less its ambient light, in units of noise. z depends on K, on the ambient light and on the harmonics of p
linearly, and so does the brightness, which has no harmonics 1 and 2 over the phase. A surface counts as one
measurement, good to a fraction of its light, however many pixels it has: what is wrong with the model is the same in
all of them.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

_Array = npt.NDArray[np.float64]
_Complexes = npt.NDArray[np.complex128]

#: Weights L, (3, 3, 3), of surfaces whose colour acts after the crosstalk, and before it.
BROAD = np.broadcast_to(np.eye(3)[:, None], (3, 3, 3))
NARROW = np.broadcast_to(np.eye(3), (3, 3, 3))
#: Between the two, where wavelengths are not known: what common filters and primaries come closest to.
BETWEEN = 0.15 * BROAD + 0.85 * NARROW


def band_weights(wavelengths_nm: npt.ArrayLike) -> _Array:
    """Return the weights L, (3, 3, 3), where wavelengths are known: the logarithm of reflectance is linear between.

    Parameters
    ----------
    wavelengths_nm : (3, 3)
        Where filter i and primary j meet; those of i = j, falling, are where the three reflectances stand.
    """
    seen = np.asarray(wavelengths_nm, np.float64)
    knots = np.diag(seen)[::-1]
    shares = [np.interp(seen, knots, own) for own in np.eye(3)[::-1]]
    return np.stack(shares, axis=-1)


# Newton's steps that find the reflectances, how far one goes at the most, and by how much they keep together.
_NEWTON, _NEWTON_STEP, _NEWTON_ENOUGH, _TOGETHER = 12, 0.7, 1e-4, 3e-4
# Standard deviations: of the filters' share in L, the same on all surfaces; of an entry's logarithm, as a fraction of
# the range of log rho; of the logarithm of a row's sum, since a surface of few cycles does not show its colour evenly.
_SHARE, _SPREAD, _ROW = 0.12, 0.14, 0.1
# Of the ambient light: this fraction of what is expected, and this of the surface's light.
_AMBIENT_FRACTION, _AMBIENT_SHARE = 0.3, 0.004
# Of the logarithm of the common light's blur.
_BLUR = 0.05
# Without ambient light a channel has at least this fraction of the brightest one's light.
_DIMMEST = 0.05
# A surface tells z to this fraction of its light, and the brightness' harmonics to that one.
_MISFIT, _BRIGHTNESS = 0.002, 0.006
# Residuals count in full up to this many of their median sizes.
_HUBER = 2.5
# Least that an entry changes to, and most, as fractions.
_LEAST, _MOST = -0.7, 1.5
# A step of Gauss and Newton in the phase goes no further than this, rad.
_PHASE_STEP = 0.2
_ROUNDS = 3
# Such steps at first, and then in every round.
_FIRST_TURNS, _TURNS = 3, 2
_COLUMNS = 12  # nine of K, three of the ambient light


def predict_matrices(colors: npt.ArrayLike, matrix: npt.ArrayLike, weights: npt.ArrayLike) -> _Array:
    """Return the matrices of surfaces of these colours, (N, 3, 3), the sum of each 3.

    Parameters
    ----------
    colors : (N, 3)
        What the camera sees of them under equally bright primaries.
    matrix : (3, 3)
        camera = matrix @ projector, on white.
    weights : (3, 3, 3)
        L; see the module.
    """
    seen, white, share = np.asarray(colors, np.float64), np.asarray(matrix, np.float64), np.asarray(weights)
    white = np.maximum(white, 1e-6 * white.sum(axis=1, keepdims=True))
    log_rho = np.log(np.maximum(seen, 1e-9) / white.sum(axis=1))
    for _ in range(_NEWTON):
        entries = white * np.exp(np.einsum("ijk,nk->nij", share, log_rho))
        rows = entries.sum(axis=2)
        off = np.log(rows / np.maximum(seen, 1e-9))
        slope = np.einsum("nij,ijk->nik", entries, share) / rows[..., None]
        gram = np.einsum("nik,nil->nkl", slope, slope) + _TOGETHER * np.eye(3)
        right = np.einsum("nik,ni->nk", slope, off) + _TOGETHER * (log_rho - log_rho.mean(axis=1, keepdims=True))
        step = np.linalg.solve(gram, right[..., None])[..., 0]
        log_rho = log_rho - np.clip(step, -_NEWTON_STEP, _NEWTON_STEP)
        if np.abs(step).max() < _NEWTON_ENOUGH:
            break
    entries = white * np.exp(np.einsum("ijk,nk->nij", share, log_rho))
    return np.asarray(3 * entries / entries.sum(axis=(1, 2), keepdims=True))


@dataclass(frozen=True, eq=False)
class PredictedMatrices:
    """The matrices of surfaces by their colours, and what their errors depend on."""

    matrices: _Array
    """(n, 3, 3), the sum of each 3; see `predict_matrices`."""
    by_share: _Array
    """(n, 3, 3, 6) derivative of each entry's logarithm by the filters' share in L of each entry off the diagonal."""
    spread: _Array
    """(n,) largest less smallest log reflectance at the primaries."""

    @classmethod
    def of(cls, colors: npt.ArrayLike, matrix: npt.ArrayLike, weights: npt.ArrayLike) -> "PredictedMatrices":
        """Predict the matrices of surfaces of these colours; the parameters are those of `predict_matrices`."""
        matrices, share = predict_matrices(colors, matrix, weights), np.asarray(weights, np.float64)
        log_rho = np.log(np.diagonal(matrices, axis1=1, axis2=2) / np.maximum(np.diag(np.asarray(matrix)), 1e-9))
        row, column = np.nonzero(~np.eye(3, dtype=bool))
        by_share = np.zeros((*matrices.shape, len(row)))
        by_share[:, row, column, np.arange(len(row))] = log_rho[:, row] - log_rho[:, column]
        # The colour stays what it is: the reflectances give way.
        parts = matrices / matrices.sum(axis=2, keepdims=True)
        more = np.einsum("nij,nije->nie", parts, by_share)
        change = np.linalg.solve(np.einsum("nij,ijk->nik", parts, share) + _TOGETHER * np.eye(3), more)
        return cls(matrices, by_share - np.einsum("ijk,nke->nije", share, change), np.ptp(log_rho, axis=1))


@dataclass(frozen=True, eq=False)
class SurfaceSamples:
    """Pixels of one surface, and what is known of each."""

    light: _Array  # (N, 3) the camera's, levels
    variance: _Array  # (N, 3) of the noise
    phase: _Array  # (N,) rad, where the fit begins
    around: _Array  # (N,) mean brightness around, levels
    contrast_doubt: float  # standard deviation of each one's contrast about the light's, as a fraction
    contrast: _Array | None = None  # (N,) of the first harmonic beside the light's, as a factor; None: as it is

    def waves(self, light: _Complexes, phase: _Array) -> tuple[_Array, _Array]:
        """Return each pixel's light and its derivative by the phase, (N, 3), given the pixels' phases."""
        return waves(light, phase, self.contrast)


@dataclass(frozen=True, eq=False)
class FittedMatrices:
    """What the pixels of all surfaces say."""

    matrices: _Array
    """(n, 3, 3) K, the sum of each 3."""
    ambient: _Array
    """(n, 3) levels."""
    light: _Complexes
    """(3, harmonics) of the projector's light over its mean."""
    misfit: _Array
    """(n,) what is left across the model beyond the noise, as a fraction of the surface's light."""
    constant_sigma: _Array
    """(n,) standard deviation of the constant that the matrix gives the surface's phase, rad."""
    mismatch: _Array
    """(n,) by how much the channels' fundamentals differ from those predicted, as a fraction; what all three have in
    common is left out."""
    cost: float
    """What speaks against all of it, in squares of standard deviations."""

    def only(self, surfaces: list[int]) -> "FittedMatrices":
        """Return what was found of some of the surfaces."""
        return FittedMatrices(
            self.matrices[surfaces],
            self.ambient[surfaces],
            self.light,
            self.misfit[surfaces],
            self.constant_sigma[surfaces],
            self.mismatch[surfaces],
            self.cost,
        )


def waves(light: _Complexes, phase: _Array, contrast: _Array | None = None) -> tuple[_Array, _Array]:
    """Return the projector's light and its derivative by the phase, (..., N, 3).

    Parameters
    ----------
    light : (3, harmonics) complex128
        From the first on.
    phase : (..., N)
        rad.
    contrast : (N,), optional
        By what blur multiplies the first harmonic; the nth by its power of n^2.
    """
    n = np.arange(1, light.shape[1] + 1)
    # Powers of the first: as many exponentials take several times as long.
    turns = np.cumprod(np.broadcast_to(np.exp(1j * phase)[..., None], (*phase.shape, light.shape[1])), axis=-1)
    if contrast is not None:
        turns *= contrast[:, None] ** n**2
    return 1 + (turns @ light.T).real, (turns * 1j * n @ light.T).real


def fit_matrices(
    samples: list[SurfaceSamples],
    prediction: PredictedMatrices,
    expected_ambient: _Array,
    ambient: _Array,
    light: _Complexes,
    leak: float,
    contrast: float,
    harmonic: float,
    *,
    fit_light: bool,
) -> FittedMatrices:
    """Fit the matrix of every surface, its ambient light, and the light that all have in common.

    Parameters
    ----------
    samples : list of SurfaceSamples
        By surface.
    prediction : PredictedMatrices
        By these surfaces' colours, without the ambient light that the fit begins with.
    expected_ambient, ambient : (n, 3)
        Ambient light that each surface is expected to send back, and where the fit begins, levels.
    light : (3, harmonics) complex128
        Of the projector's light over its mean, from the first on, as far as it is known.
    leak : float
        Standard deviation of an entry on white, as a fraction of its row.
    contrast : float
        Standard deviation of the light's contrast apart from what blur takes, as a fraction.
    harmonic : float
        How far a single harmonic of the light may be off, besides contrast and blur, as a fraction of the first:
        standard deviation.
    fit_light : bool
        Whether the surfaces tell the light, too; else it is as given.
    """
    count, harmonics, predicted = len(samples), light.shape[1], prediction.matrices
    expected, prior = _prior_of_surfaces(samples, prediction, expected_ambient, ambient, leak)
    known_light = _prior_of_light(light, contrast, harmonic) if fit_light else 1e12 * np.eye(harmonics)
    expected, prior = np.append(expected, np.zeros(harmonics)), _beside(prior, known_light)
    start = np.concatenate([np.zeros((count, 9)), ambient - expected_ambient], axis=1).ravel()
    state = np.concatenate([start, np.zeros(harmonics)])
    phases = [s.phase.copy() for s in samples]
    misfit, cost = np.zeros(count), 0.0
    for turn in range(_ROUNDS + 1):
        factors = 1 + state[_COLUMNS * count :]
        own = state[: _COLUMNS * count].reshape(count, _COLUMNS)
        gram, right, cost = np.zeros((len(state), len(state))), np.zeros(len(state)), 0.0
        for k, surface in enumerate(samples):
            matrix = predicted[k] * (1 + own[k, :9].reshape(3, 3))
            rest = surface.light - expected_ambient[k] - own[k, 9:]
            turns = _FIRST_TURNS if turn == 0 else _TURNS
            row = _Equations(surface, matrix, predicted[k], rest, light * factors, light, phases[k], turns)
            phases[k], misfit[k] = row.phase, row.misfit
            cost += row.cost
            place = _places(k, count, harmonics)
            gram[np.ix_(place, place)] += row.gram
            right[place] += row.right
        cost += float((state - expected) @ prior @ (state - expected))
        if turn < _ROUNDS:
            step = np.linalg.solve(gram + prior, right - prior @ (state - expected))
            state = state + step
            entries = state[: _COLUMNS * count].reshape(count, _COLUMNS)
            entries[:, :9] = np.clip(entries[:, :9], _LEAST, _MOST)
    own = state[: _COLUMNS * count].reshape(count, _COLUMNS)
    matrices = predicted * (1 + own[:, :9].reshape(count, 3, 3))
    fitted_light, besides = light * (1 + state[_COLUMNS * count :]), expected_ambient + own[:, 9:]
    covariance, constant = np.linalg.inv(gram + prior), np.empty(count)
    for k in range(count):
        slope = _constant_slope(samples[k], matrices[k], predicted[k], besides[k], fitted_light, light)
        place = _places(k, count, harmonics)
        constant[k] = np.sqrt(slope @ covariance[np.ix_(place, place)] @ slope)
    mismatch = _mismatch(matrices, predicted, light[:, 0])
    matrices = 3 * matrices / matrices.sum(axis=(1, 2), keepdims=True)
    return FittedMatrices(matrices, besides, fitted_light, misfit, constant, mismatch, cost)


def _mismatch(matrices: _Array, predicted: _Array, fundamental: _Complexes) -> _Array:
    """Return how far the channels' fundamentals are from those predicted, apart from what all three share."""
    waves_of = [parts @ fundamental / parts.sum(axis=2) for parts in (matrices, predicted)]
    ratio = waves_of[0] / waves_of[1]
    deviation = np.abs(ratio / ratio.mean(axis=1, keepdims=True) - 1)
    return np.asarray(np.sqrt((deviation**2).sum(axis=1) / 2))


def _places(surface: int, count: int, harmonics: int) -> npt.NDArray[np.intp]:
    """Return where what one surface depends on stands among all that is fitted."""
    own = np.arange(_COLUMNS * surface, _COLUMNS * (surface + 1))
    return np.concatenate([own, np.arange(_COLUMNS * count, _COLUMNS * count + harmonics)])


def _constant_slope(
    surface: SurfaceSamples,
    matrix: _Array,
    predicted: _Array,
    ambient: _Array,
    light: _Complexes,
    known_light: _Complexes,
) -> _Array:
    """Return how the mean error of the phase over a cycle changes with what is fitted."""
    phase = np.linspace(-np.pi, np.pi, 96, endpoint=False)
    p, change = waves(light, phase)
    brightness = float(np.median((surface.light - ambient).sum(axis=1)) / matrix.sum())
    brightness = max(brightness, 1e-3 * float(surface.light.mean()))
    weight = 1 / np.sqrt(surface.variance.mean(axis=0))
    m, d = p @ matrix.T * weight, change @ matrix.T * weight
    across = d - (_dot(d, m) / _dot(m, m))[:, None] * m
    across /= _dot(across, across)[:, None]
    entries = weight[:, None] * predicted * p[:, None, :] * across[:, :, None]
    columns = [entries.reshape(-1, 9), weight * across / brightness]
    turns = np.exp(1j * np.arange(1, light.shape[1] + 1) * phase[:, None])
    for h in range(light.shape[1]):
        wave = (turns[:, h, None] * known_light[:, h]).real @ matrix.T * weight
        columns.append(_dot(wave, across)[:, None])
    return np.asarray(np.concatenate(columns, axis=1).mean(axis=0))


def residuals(surface: SurfaceSamples, matrix: _Array, ambient: _Array, light: _Complexes) -> _Array:
    """Return z of a surface's pixels, (..., N), in standard deviations, given matrices, ambient light and the light.

    The matrices are (..., 3, 3): NumPy takes as long for two as for one.
    """
    weight = 1 / np.sqrt(surface.variance)
    seen = (surface.light - ambient) * weight
    found = _across(surface, seen, matrix, weight, light, surface.phase, _FIRST_TURNS)
    return np.asarray(found.residual / np.sqrt(_contrast_variance(surface, matrix, weight, light, found)))


def _contrast_variance(
    surface: SurfaceSamples, matrix: _Array, weight: _Array, light: _Complexes, found: "_Across"
) -> _Array | float:
    """Return the variance of z where a pixel's contrast is not quite the light's."""
    if surface.contrast_doubt == 0:
        return 1.0
    swing = (surface.waves(light, found.phase)[0] - 1) @ matrix.swapaxes(-1, -2) * weight
    return np.asarray(1 + (surface.contrast_doubt * found.brightness * _dot(swing, found.normal)) ** 2)


class _Across(NamedTuple):
    """Pixels beside their model, in units of noise."""

    phase: _Array  # (..., N) rad, what fits best
    brightness: _Array  # (..., N) likewise
    light: _Array  # (..., N, 3) K p
    change: _Array  # (..., N, 3) its derivative by the phase
    normal: _Array  # (..., N, 3) n
    residual: _Array  # (..., N) z


def _across(
    surface: SurfaceSamples, seen: _Array, matrix: _Array, weight: _Array, light: _Complexes, phase: _Array, turns: int
) -> _Across:
    """Find the phase and the brightness of pixels, and what these leave over."""
    turned = matrix.swapaxes(-1, -2)
    for turn in range(turns + 1):
        p, change = surface.waves(light, phase)
        m, d = p @ turned * weight, change @ turned * weight
        square = _dot(m, m)
        brightness = np.maximum(_dot(seen, m) / square, 1e-9)
        if turn < turns:
            across = d - (_dot(d, m) / square)[..., None] * m
            step = _dot(seen, across) / (brightness * _dot(across, across))
            phase = phase + np.clip(step, -_PHASE_STEP, _PHASE_STEP)
    normal = m[..., (1, 2, 0)] * d[..., (2, 0, 1)] - m[..., (2, 0, 1)] * d[..., (1, 2, 0)]
    normal /= np.sqrt(_dot(normal, normal))[..., None]
    return _Across(phase, brightness, m, d, normal, _dot(seen, normal))


def _prior_of_surfaces(
    samples: list[SurfaceSamples], prediction: PredictedMatrices, expected_ambient: _Array, ambient: _Array, leak: float
) -> tuple[_Array, _Array]:
    """Return the mean, (12 n,), and the inverse covariance, (12 n, 12 n), of what is fitted before pixels are seen.

    A channel with more ambient light has as much less in its row of K: the mean light is known.
    """
    size, common = _COLUMNS * len(samples), prediction.by_share.shape[-1]
    # Independent errors: the filters' shares; of every surface its entries, rows, contrasts and ambient light.
    causes = np.zeros((size, common + size + 6 * len(samples)))
    sigma, expected = [np.full(common, _SHARE)], np.zeros((len(samples), _COLUMNS))
    for k, surface in enumerate(samples):
        predicted, level = prediction.matrices[k], surface.light.mean(axis=0)
        seen = np.maximum(level - ambient[k], _DIMMEST * level.max())
        own = causes[_COLUMNS * k : _COLUMNS * (k + 1)]
        entries, rows, lost, dimmed = np.split(own[:, common + 18 * k : common + 18 * (k + 1)], [9, 12, 15], axis=1)
        own[:9, :common] = prediction.by_share[k].reshape(9, common)
        entries[:9] = np.eye(9)
        rows[:9] = np.repeat(np.eye(3), 3, axis=0)
        # Less contrast looks like more crosstalk: the three primaries together have next to none.
        even = predicted.sum(axis=1, keepdims=True) / (3 * np.maximum(predicted, 1e-9))
        lost[:9] = (even - 1).reshape(9, 1) * rows[:9]
        dimmed[:9], dimmed[9:] = -rows[:9] / seen, np.eye(3)
        expected[k, :9] = np.repeat((ambient[k] - expected_ambient[k]) / seen, 3)
        leaks = leak * predicted.sum(axis=1, keepdims=True) / np.maximum(predicted, 1e-9)
        sigma += [
            np.hypot(_SPREAD * prediction.spread[k], leaks).ravel(),
            np.full(3, _ROW),
            np.full(3, surface.contrast_doubt),
            _AMBIENT_FRACTION * expected_ambient[k] + _AMBIENT_SHARE * level.mean(),
        ]
    scaled = causes * np.concatenate(sigma)
    return expected.ravel(), np.linalg.inv(scaled @ scaled.T)


def _prior_of_light(light: _Complexes, contrast: float, harmonic: float) -> _Array:
    """Return one over the covariance of the harmonics, as fractions."""
    n, size_of = np.arange(1, light.shape[1] + 1), np.abs(light).mean(axis=0)
    single = harmonic * size_of[0] / np.maximum(size_of, 1e-4)
    return np.asarray(np.linalg.inv(contrast**2 + _BLUR**2 * np.outer(n**2, n**2) + np.diag(single**2)))


def _beside(first: _Array, second: _Array) -> _Array:
    """Return the matrix that has two others on its diagonal."""
    nothing = np.zeros((len(first), len(second)))
    return np.block([[first, nothing], [nothing.T, second]])


class _Equations:
    """Normal equations of one surface: how z and the brightness change with all that is fitted."""

    def __init__(
        self,
        surface: SurfaceSamples,
        matrix: _Array,
        predicted: _Array,
        rest: _Array,
        light: _Complexes,
        known_light: _Complexes,
        phase: _Array,
        turns: int,
    ) -> None:
        weight = 1 / np.sqrt(surface.variance)
        found = _across(surface, rest * weight, matrix, weight, light, phase, turns)
        phase, brightness, m, d, normal, z = found
        self.phase, p = phase, surface.waves(light, phase)[0]
        level = np.sqrt((_dot(m, m) * brightness**2).mean())
        # The columns: nine entries of K, as fractions; three of ambient light; the harmonics, as fractions.
        size = 9 + 3 + light.shape[1]
        of_z, of_brightness = np.empty((len(z), size)), np.empty((len(z), size))
        bright = m - (_dot(m, d) / _dot(d, d))[:, None] * d
        bright /= _dot(bright, bright)[:, None]
        entries = weight[:, :, None] * predicted * p[:, None, :]
        of_z[:, :9] = (brightness[:, None, None] * entries * normal[:, :, None]).reshape(-1, 9)
        of_brightness[:, :9] = (entries * bright[:, :, None]).reshape(-1, 9)
        of_z[:, 9:12] = weight * normal
        of_brightness[:, 9:12] = weight * bright / brightness[:, None]
        for h in range(light.shape[1]):
            turning = np.exp(1j * (h + 1) * phase)
            if surface.contrast is not None:
                turning *= surface.contrast ** (h + 1) ** 2
            wave = (turning[:, None] * known_light[:, h]).real @ matrix.T * weight
            of_z[:, 12 + h] = brightness * _dot(wave, normal)
            of_brightness[:, 12 + h] = _dot(wave, bright)
        usual = _HUBER * 1.48 * np.median(np.abs(z)) + 1e-12
        trust = np.minimum(1.0, usual / np.maximum(np.abs(z), 1e-12))
        variance = _contrast_variance(surface, matrix, weight, light, found)
        trust = trust / variance
        total = trust.sum()
        scatter = np.sqrt((trust * z * z).sum() / total)
        self.misfit = float(np.sqrt(max((trust * (z * z - variance)).sum() / total, 0)) / level)
        count = total**2 / (trust**2).sum()
        information = 1 / ((_MISFIT * level) ** 2 + 4 * scatter**2 / count) / total
        weighted = of_z * trust[:, None]
        self.gram, self.right = information * weighted.T @ of_z, information * weighted.T @ z
        self.cost = float(information * (trust * z * z).sum())
        self._add_brightness(np.log(brightness / surface.around), of_brightness)

    def _add_brightness(self, log_brightness: _Array, columns: _Array) -> None:
        """Add that the brightness has no harmonics 1 and 2 over the phase."""
        rest = log_brightness - np.median(log_brightness)
        usual = np.abs(rest) < 0.5
        if np.count_nonzero(usual) < 50:
            return
        turns = np.stack([np.cos(self.phase), np.sin(self.phase), np.cos(2 * self.phase), np.sin(2 * self.phase)])
        turns = (turns - turns[:, usual].mean(axis=1, keepdims=True))[:, usual]
        rest, columns = rest[usual] - rest[usual].mean(), (columns - columns.mean(axis=0))[usual]
        inverse = np.linalg.inv(turns @ turns.T + 1e-3 * len(rest) * np.eye(4))
        seen, change = inverse @ (turns @ rest), inverse @ (turns @ columns)
        by_chance = 3 * max(float(rest.std()), 0.01) * np.sqrt(2 / len(rest))
        information = 1 / (_BRIGHTNESS**2 + by_chance**2)
        self.gram += information * change.T @ change
        self.right += information * change.T @ seen
        self.cost += float(information * seen @ seen)


def _dot(a: _Array, b: _Array) -> _Array:
    return np.asarray(np.einsum("...i,...i->...", a, b))
