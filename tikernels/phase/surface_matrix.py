"""Effect of a surface's colour on the crosstalk: a matrix, predicted from the colour and fitted to its pixels.

Of M, the crosstalk on white, entry ij belongs to the wavelengths where filter i and primary j meet, and is weighed by
the reflectance there:

    K_ij = M_ij exp(sum over k of L_ijk log rho_k),

rho_k the reflectance at three primaries, its logarithm linear between them. With the primaries alone (L_ijk = 1 for
j = k) that is M diag(rho), with the filters alone diag(rho) M; real ones lie between. rho follows from the surface's
mean colour, three numbers from three, and K is a prior for what its pixels show, which is wrong by more the larger the
range of log rho is. The light is the same on all surfaces, which are therefore fitted together. Behind lasers K = M
diag(rho) to 0.1 %; behind lamps and filters that overlap, up to a third of log rho is the filters'. Given K, each pixel
has two unknowns, brightness and phase, and one number is left over,

    z = c n,    n across K p and K p',

c the pixel less its ambient light, in units of noise. z depends on K, on the ambient light and on the harmonics of p
linearly, and so does the brightness, which has no harmonics 1 and 2 over the phase. A surface counts as one
measurement, good to a fraction of its light, however many pixels it has: what is wrong with the model is the same in
all of them.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tikernels.phase.channel_template import HARMONICS
from tikernels.phase.frame_statistics import MEDIAN_SIZE
from tikernels.phase.phase_vector import SIGMAS, TINY
from tikernels.phase.surface_samples import ComparedSamples, SurfaceSamples, compare_samples

_Array = npt.NDArray[np.float64]
_Floats = npt.NDArray[np.floating]
_Complexes = npt.NDArray[np.complex128]

#: Weights L, (3, 3, 3), of surfaces whose colour acts before the crosstalk, and after it.
NARROW = np.stack([np.eye(3)] * 3)
BROAD = NARROW.swapaxes(0, 1)
#: Between the two, where wavelengths are not known: what common filters and primaries come closest to.
BETWEEN = NARROW + 0.15 * (BROAD - NARROW)


def band_weights(wavelengths_nm: npt.ArrayLike) -> _Array:
    """Return the weights L, (3, 3, 3), where wavelengths are known: the logarithm of reflectance is linear between.

    Parameters
    ----------
    wavelengths_nm : (3, 3)
        Wavelength where filter i and primary j meet; those of i = j, falling, are those of the three reflectances.
    """
    seen = np.asarray(wavelengths_nm, np.float64)
    knots = np.diag(seen)[::-1]
    shares = [np.interp(seen, knots, own) for own in np.eye(3)[::-1]]
    return np.stack(shares, axis=-1)


# Newton's method for the reflectances: most steps, the longest and the last step, and the weight of equal reflectances.
_NEWTON, _NEWTON_STEP, _NEWTON_ENOUGH, _TOGETHER = 12, 0.7, 1e-4, 3e-4
# Standard deviations: of an entry's logarithm, as a fraction of the range of log rho; of the logarithm of a row's sum,
# since a surface of few cycles does not show its colour evenly.
_SPREAD, _ROW = 0.14, 0.1
# Of the ambient light: this fraction of what is expected, and this of the surface's light.
_AMBIENT_FRACTION, _AMBIENT_SHARE = 0.3, 0.004
# Of the logarithm of the common light's blur.
_BLUR = 0.05
# Without ambient light a channel has at least this fraction of the brightest one's light.
_DIMMEST = 0.05
# Standard errors of a surface's z and of its brightness' harmonics, as fractions of its light.
_MISFIT, _BRIGHTNESS = 0.002, 0.006
# Of the contrast that red loses where light scatters under the surface. To first order the loss goes with the square of
# the way, and green and blue get half and a quarter as far, in skin.
_SCATTERED, _LOST = 0.3, np.array([1, 1 / 4, 1 / 16])
#: Twice the logarithm of a Bayes factor that is strong evidence (Kass and Raftery, Bayes factors, 1995).
PROOF = 6
# By how much an entry grows at most, as a fraction of its row.
_MOST = 0.5
# The brightness' harmonics count where its logarithm is this near to the median, and there are so many places.
_USUAL_BRIGHTNESS, _LEAST_BRIGHTNESS = 0.5, 30
# Places of the cycle that the phase's constant is the mean of.
_PHASES = 48
# In a video the last frames count as much as so many.
_MOST_FRAMES = 8
_COLUMNS = 12  # of a surface's own: nine of K, three of the ambient light


def predict_matrices(colors: npt.ArrayLike, matrix: npt.ArrayLike, weights: npt.ArrayLike) -> _Array:
    """Return the matrices of surfaces of these colours, (N, 3, 3), the sum of each 3.

    Parameters
    ----------
    colors : (N, 3)
        Colours that the camera sees under equally bright primaries.
    matrix : (3, 3)
        camera = matrix @ projector, on white.
    weights : (3, 3, 3)
        L; see the module.
    """
    seen, white, share = np.asarray(colors, np.float64), np.asarray(matrix, np.float64), np.asarray(weights)
    white = np.maximum(white, TINY)
    log_rho = np.log(np.maximum(seen, TINY) / white.sum(axis=1))
    for _ in range(_NEWTON):
        entries = white * np.exp(np.einsum("ijk,nk->nij", share, log_rho))
        rows = entries.sum(axis=2)
        off = np.log(rows / np.maximum(seen, TINY))
        slope = np.einsum("nij,ijk->nik", entries, share) / rows[..., None]
        gram = np.einsum("nik,nil->nkl", slope, slope) + _TOGETHER * np.eye(3)
        right = np.einsum("nik,ni->nk", slope, off) + _TOGETHER * (log_rho - log_rho.mean(axis=1, keepdims=True))
        step = np.linalg.solve(gram, right[..., None])[..., 0]
        log_rho = log_rho - np.clip(step, -_NEWTON_STEP, _NEWTON_STEP)
        if np.abs(step).max() < _NEWTON_ENOUGH:
            break
    entries = white * np.exp(np.einsum("ijk,nk->nij", share, log_rho))
    return _scaled(entries)


def _scaled(matrices: _Array) -> _Array:
    """Return matrices, (n, 3, 3), of which the sum of each is 3."""
    return np.asarray(3 * matrices / matrices.sum(axis=(1, 2), keepdims=True))


@dataclass(frozen=True, eq=False)
class PredictedMatrices:
    """The matrices of surfaces by their colours, and what their errors depend on."""

    matrices: _Array
    """(n, 3, 3), the sum of each 3; see `predict_matrices`."""
    spread: _Array
    """(n,) largest less smallest log reflectance at the primaries."""
    redness: _Array
    """(n,) log reflectance at the red primary less that at the blue one."""

    @classmethod
    def of(cls, colors: npt.ArrayLike, matrix: npt.ArrayLike, weights: npt.ArrayLike) -> "PredictedMatrices":
        """Predict the matrices of surfaces of these colours; the parameters are those of `predict_matrices`."""
        matrices = predict_matrices(colors, matrix, weights)
        log_rho = np.log(np.diagonal(matrices, axis1=1, axis2=2) / np.maximum(np.diag(np.asarray(matrix)), TINY))
        return cls(matrices, np.ptp(log_rho, axis=1), log_rho[:, 0] - log_rho[:, 2])


@dataclass(frozen=True, eq=False)
class FittedMatrices:
    """Matrices fitted to the pixels of all surfaces."""

    matrices: _Array
    """(n, 3, 3) K, the sum of each 3."""
    ambient: _Array
    """(n, 3) levels."""
    shared: _Array
    """(harmonics,) by how much the light's harmonics are not as predicted, as fractions."""
    light: _Complexes
    """(3, harmonics) of the projector's light over its mean."""
    misfit: _Array
    """(n,) what is left across the model beyond the noise, as a fraction of the surface's light."""
    constant_sigma: _Array
    """(n,) standard deviation of the constant that the matrix gives the surface's phase, rad; NaN if the light was
    fitted, too."""
    mismatch: _Array
    """(n,) by how much the channels' fundamentals differ from those predicted, as a fraction; what all three have in
    common is left out."""
    cost: float
    """Total misfit before the step, in squares of standard deviations."""
    frames: _Array
    """(n,) number of frames of a video that contributed."""

    def only(self, surfaces: list[int]) -> "FittedMatrices":
        """Return what was found of some of the surfaces."""
        own = ("matrices", "ambient", "misfit", "constant_sigma", "mismatch", "frames")
        return replace(self, **{name: getattr(self, name)[surfaces] for name in own})

    def after(self, before: "FittedMatrices") -> "FittedMatrices":
        """Return the mean with that of the frames before, where the first of these surfaces were seen, too."""
        known = len(before.matrices)
        matrices, ambient, frames = self.matrices.copy(), self.ambient.copy(), self.frames.copy()
        frames[:known] = np.minimum(before.frames + 1, _MOST_FRAMES)
        share = 1 / frames[:known, None]
        matrices[:known] = before.matrices + share[..., None] * (matrices[:known] - before.matrices)
        ambient[:known] = before.ambient + share * (ambient[:known] - before.ambient)
        return replace(self, matrices=matrices, ambient=ambient, frames=frames)


class LightDoubt(NamedTuple):
    """Standard deviations of what is known of the light."""

    leak: float
    """Of a matrix entry on white, as a fraction of its row."""
    contrast: float
    """Of the light's contrast apart from what blur takes, as a fraction."""
    harmonic: float
    """Of a single harmonic, besides contrast and blur, as a fraction of the first."""


def waves(light: _Complexes, phase: _Array) -> tuple[_Array, _Array]:
    """Return the projector's light and its derivative by the phase, (3, N).

    Parameters
    ----------
    light : (3, harmonics) complex128
        From the first on.
    phase : (N,)
        rad.
    """
    turns, steep = _turns(light.shape[1], phase), light * np.arange(1, light.shape[1] + 1)
    both = np.concatenate([np.hstack([light.real, -light.imag]), np.hstack([-steep.imag, -steep.real])]) @ turns
    return 1 + both[:3], both[3:]


def _turns(harmonics: int, phase: _Array) -> _Array:
    """Return cosines, then sines, of n phase, (2 harmonics, N)."""
    turns = np.exp(1j * np.arange(1, harmonics + 1)[:, None] * phase)
    return np.concatenate([turns.real, turns.imag])


def fit_matrices(
    samples: SurfaceSamples,
    prediction: PredictedMatrices,
    expected_ambient: _Array,
    ambient: _Array,
    light: _Complexes,
    doubt: LightDoubt,
    before: FittedMatrices | None = None,
    *,
    fit_light: bool,
) -> FittedMatrices:
    """Fit the matrix of every surface, its ambient light, and the light that all have in common: one Newton step.

    Parameters
    ----------
    samples : SurfaceSamples
        Of n surfaces.
    prediction : PredictedMatrices
        By these surfaces' colours, without the ambient light that the fit begins with.
    expected_ambient, ambient : (n, 3)
        Ambient light that each surface is expected to send back, and that the prediction is without, levels.
    light : (3, harmonics) complex128
        Of the projector's light over its mean, from the first on, as far as it is known.
    doubt : LightDoubt
        Uncertainty of the light.
    before : FittedMatrices, optional
        Of the first of these surfaces, where the fit begins; None: with the prediction.
    fit_light : bool
        True to fit the light, too; else it stays as it was before.
    """
    count, harmonics, predicted = len(samples.light), light.shape[1], prediction.matrices
    expected, of_paint, of_skin = _priors_of_surfaces(samples, prediction, expected_ambient, ambient, doubt.leak)
    own, shared, usual = np.zeros((count, _COLUMNS)), np.zeros(harmonics), np.zeros(harmonics)
    own[:, 9:] = ambient - expected_ambient
    if before is not None:
        known, shared = len(before.matrices), before.shared
        own[:known, :9] = (before.matrices / predicted[:known] - 1).reshape(known, 9)
        own[:known, 9:] = before.ambient - expected_ambient[:known]
    if not fit_light:
        usual = shared
    prior_shared = _prior_of_light(light, doubt) if fit_light else np.eye(harmonics) / TINY

    def unpacked() -> tuple[_Array, _Array, _Complexes]:
        """Return the matrices, the ambient light and the projector's, given what is fitted of them."""
        entries = own[:, :9].reshape(predicted.shape)
        return predicted * (1 + entries), expected_ambient + own[:, 9:], light * (1 + shared)

    found = _equations(samples, *unpacked(), predicted, light)
    off, off_shared = expected - own, usual - shared
    cost = found.cost + float((off * _times(of_paint, off)).sum() + off_shared @ prior_shared @ off_shared)
    prior = of_paint
    if before is not None:  # what a first step corrects looks like light that scatters
        proof = _evidence(found, of_skin, off) - _evidence(found, of_paint, off) - PROOF
        prior = np.where((proof > 0)[:, None, None], of_skin, of_paint)
        cost -= float(np.maximum(proof, 0).sum())
    arrow = _Arrow.of(found.gram, prior, prior_shared)
    right = found.right[:, :_COLUMNS] + _times(prior, off)
    change, change_shared = arrow.solve(right, found.right[:, _COLUMNS:].sum(axis=0) + prior_shared @ off_shared)
    own, shared = own + change, shared + change_shared
    most = _MOST * predicted.sum(axis=2, keepdims=True) / np.maximum(predicted, TINY)
    own[:, :9] = np.minimum(own[:, :9], most.reshape(count, 9))
    matrices, besides, fitted_light = unpacked()
    constant = np.full(count, np.nan)
    if not fit_light:
        slope = _constant_slope(samples, matrices, besides, fitted_light, light)
        slope[:, :9] *= predicted.reshape(count, 9)
        constant = np.sqrt(arrow.variance(slope))
    mismatch = _mismatch(matrices, predicted, light[:, 0])
    return FittedMatrices(
        _scaled(matrices), besides, shared, fitted_light, found.misfit, constant, mismatch, cost, np.ones(count)
    )


class _Arrow(NamedTuple):
    """Equations in which a surface's own unknowns meet only those that all share."""

    own: _Array  # (n, 12, 12) the inverse of a surface's own equations
    beside: _Array  # (n, 12, shared)
    rest: _Array  # (shared, shared) the inverse of what the shared ones have once their own are solved

    @classmethod
    def of(cls, gram: _Array, prior: _Array, prior_shared: _Array) -> "_Arrow":
        own, beside = np.linalg.inv(gram[:, :_COLUMNS, :_COLUMNS] + prior), gram[:, :_COLUMNS, _COLUMNS:]
        corner = gram[:, _COLUMNS:, _COLUMNS:] - beside.swapaxes(1, 2) @ own @ beside
        return cls(np.asarray(own), beside, np.asarray(np.linalg.inv(prior_shared + corner.sum(axis=0))))

    def solve(self, right: _Array, right_shared: _Array) -> tuple[_Array, _Array]:
        """Return the own unknowns, (n, 12), and the shared ones."""
        alone = (right[:, None] @ self.own)[:, 0]
        shared = self.rest @ (right_shared - (alone[:, None] @ self.beside).sum(axis=(0, 1)))
        return alone - ((self.beside @ shared)[:, None] @ self.own)[:, 0], shared

    def variance(self, slope: _Array) -> _Array:
        """Return that of what changes with the unknowns by these slopes, (n, 12 + shared)."""
        alone = (slope[:, None, :_COLUMNS] @ self.own)[:, 0]
        rest = slope[:, _COLUMNS:] - (alone[:, None] @ self.beside)[:, 0]
        return np.asarray((alone * slope[:, :_COLUMNS]).sum(axis=1) + (rest @ self.rest * rest).sum(axis=1))


def _evidence(found: "_Equations", prior: _Array, off: _Array) -> _Array:
    """Return twice the logarithm of how likely a prior makes what each surface shows, (n,), up to a constant."""
    pull, gram = _times(prior, off), found.gram[:, :_COLUMNS, :_COLUMNS] + prior
    right = found.right[:, :_COLUMNS] + pull
    volume = np.linalg.slogdet(prior).logabsdet - np.linalg.slogdet(gram).logabsdet
    solved = _times(np.asarray(np.linalg.inv(gram)), right)
    return np.asarray((right * solved - off * pull).sum(axis=1) + volume)


def _times(matrices: _Array, vectors: _Array) -> _Array:
    """Return products of (n, 12, 12) and (n, 12)."""
    return np.asarray((matrices @ vectors[..., None])[..., 0])


def _mismatch(matrices: _Array, predicted: _Array, fundamental: _Complexes) -> _Array:
    """Return how far the channels' fundamentals are from those predicted, apart from what all three share."""
    waves_of = [parts @ fundamental / parts.sum(axis=2) for parts in (matrices, predicted)]
    ratio = waves_of[0] / waves_of[1]
    deviation = np.abs(ratio / ratio.mean(axis=1, keepdims=True) - 1)
    return np.asarray(np.sqrt((deviation**2).sum(axis=1) / 2))


def _constant_slope(
    samples: SurfaceSamples, matrices: _Array, ambient: _Array, light: _Complexes, known_light: _Complexes
) -> _Array:
    """Return how the mean error of the phase over a cycle changes with what is fitted, (n, 12 + harmonics)."""
    phases = np.linspace(-np.pi, np.pi, _PHASES, endpoint=False)
    (p, change), turns = waves(light, phases), _turns(light.shape[1], phases)
    brightness = (_middle(samples.light.sum(axis=1))[:, 0] - ambient.sum(axis=1)) / matrices.sum(axis=(1, 2))
    brightness = np.maximum(brightness, _DIMMEST * samples.light.mean(axis=(1, 2)))[:, None, None]
    weight = 1 / np.sqrt(samples.variance.mean(axis=2, keepdims=True))
    m, d = matrices @ p * weight, matrices @ change * weight
    across = d - _dot(d, m) / _dot(m, m) * m
    across /= _dot(across, across) * brightness
    return np.asarray(_columns(matrices, p, weight * across, brightness, turns, known_light).mean(axis=2))


def _columns(
    matrices: _Array, p: _Floats, direction: _Floats, brightness: _Floats, turns: _Floats, known_light: _Complexes
) -> _Floats:
    """Return how light changes in a direction, (n, 12 + harmonics, S), with all that is fitted.

    Nine entries of K; three of ambient light; the harmonics, as fractions.
    """
    bright = brightness * direction
    entries = bright[:, :, None] * p[..., None, :, :]
    through, harmonics = matrices.swapaxes(1, 2).astype(p.dtype) @ bright, known_light.shape[1]
    cosines, sines = known_light.real.T.astype(p.dtype) @ through, known_light.imag.T.astype(p.dtype) @ through
    wave = cosines * turns[..., :harmonics, :] - sines * turns[..., harmonics:, :]
    return np.concatenate([entries.reshape(len(matrices), -1, p.shape[-1]), direction, wave], axis=1)


def _priors_of_surfaces(
    samples: SurfaceSamples, prediction: PredictedMatrices, expected_ambient: _Array, ambient: _Array, leak: float
) -> tuple[_Array, _Array, _Array]:
    """Return the mean, (n, 12), and the inverse covariance, (n, 12, 12), of a surface's own before pixels are seen.

    The covariance of paint, and of what light scatters under. A channel with more ambient light has as much less in
    its row of K: the mean light is known.
    """
    predicted, level = prediction.matrices, samples.light.mean(axis=2, dtype=np.float64)
    count = len(predicted)
    seen = np.maximum(level - ambient, _DIMMEST * level.max(axis=1, keepdims=True))
    # Independent errors: of every surface its entries, rows, contrasts and ambient light; and how it scatters.
    causes, rows = np.zeros((count, _COLUMNS, 19)), np.repeat(np.eye(3), 3, axis=0)
    causes[:, :9, :9] = np.eye(9)
    causes[:, :9, 9:12] = rows
    # Less contrast looks like more crosstalk: the three primaries together have next to none.
    even = predicted.mean(axis=1, keepdims=True) / np.maximum(predicted, TINY)
    causes[:, :9, 12:15] = (even - 1).reshape(count, 9, 1) * rows
    causes[:, :9, 15:18], causes[:, 9:, 15:18] = -rows / seen[:, None], np.eye(3)
    # What a primary loses of its contrast is light without a fringe, a third from each.
    even = (predicted @ _LOST)[..., None] / 3 / np.maximum(predicted, TINY)
    causes[:, :9, 18] = (even - _LOST).reshape(count, 9)
    expected = np.zeros((count, _COLUMNS))
    expected[:, :9] = (ambient - expected_ambient) / seen @ rows.T
    leaks = leak * predicted.sum(axis=1, keepdims=True) / np.maximum(predicted, TINY)
    sigma = np.zeros((count, 19))
    sigma[:, :9] = np.hypot(_SPREAD * prediction.spread[:, None, None], leaks).reshape(count, 9)
    sigma[:, 9:12], sigma[:, 12:15] = _ROW, samples.contrast_doubt
    sigma[:, 15:18] = _AMBIENT_FRACTION * expected_ambient + _AMBIENT_SHARE * level.mean(axis=1, keepdims=True)
    sigma[:, 18] = _SCATTERED * np.clip(prediction.redness, 0, 1)
    scaled = causes * sigma[:, None]
    of_paint, of_skin = (np.linalg.inv(one @ one.swapaxes(1, 2)) for one in (scaled[..., :18], scaled))
    return expected, np.asarray(of_paint), np.asarray(of_skin)


def _prior_of_light(light: _Complexes, doubt: LightDoubt) -> _Array:
    """Return one over the covariance of the harmonics, as fractions."""
    n, size_of = np.arange(1, light.shape[1] + 1), np.abs(light).mean(axis=0)
    single = doubt.harmonic * size_of[0] / np.maximum(size_of, 1e-4)
    return np.asarray(np.linalg.inv(doubt.contrast**2 + _BLUR**2 * np.outer(n**2, n**2) + np.diag(single**2)))


class _Equations(NamedTuple):
    """Normal equations of every surface: the changes of z and the brightness with all that is fitted."""

    gram: _Array  # (n, 12 + harmonics, 12 + harmonics)
    right: _Array  # (n, 12 + harmonics)
    misfit: _Array  # (n,) see `FittedMatrices`
    cost: float


def _equations(
    samples: SurfaceSamples,
    matrices: _Array,
    ambient: _Array,
    light: _Complexes,
    predicted: _Array,
    known_light: _Complexes,
) -> _Equations:
    found = compare_samples(samples, matrices, ambient, light)
    z, brightness, variance = found.residual, found.brightness, found.variance
    level = np.sqrt(found.square.mean(axis=2))
    of_z, of_brightness = (
        _columns(matrices, found.waves, direction, brightness, found.turns, known_light)
        for direction in (found.across, found.along)
    )
    size = np.abs(z)
    # Residuals count in full up to two standard deviations.
    usual = 2 / MEDIAN_SIZE * _middle(size) + np.float32(TINY)
    trust = usual / np.maximum(size, usual) / variance
    total, scatter = trust.sum(axis=2), (trust * z * z).sum(axis=2)
    left = (scatter - (trust * variance).sum(axis=2)) / total
    count = samples.share[:, None] * total**2 / (trust**2).sum(axis=2)
    information = 1 / ((_MISFIT * level) ** 2 + 4 * scatter / total / count) / total
    weighted = (information.astype(np.float32)[..., None] * trust) * of_z
    gram, right = ((weighted @ values.swapaxes(1, 2)).astype(np.float64) for values in (of_z, z))
    right = right[..., 0]
    change, seen, sure = _waves_of_brightness(samples, found, of_brightness)
    gram += (sure[:, None, None] * change.swapaxes(1, 2)) @ change
    right += sure[:, None] * (seen[:, None] @ change)[:, 0]
    cost = float((information * scatter).sum() + (sure[:, None] * seen**2).sum())
    # Entries are fractions of what is predicted.
    scale = np.ones(right.shape)
    scale[:, :9] = predicted.reshape(-1, 9)
    gram *= scale[:, :, None] * scale[:, None]
    return _Equations(gram, scale * right, np.sqrt(np.maximum(left, 0))[:, 0] / level[:, 0], cost)


def _waves_of_brightness(
    samples: SurfaceSamples, found: ComparedSamples, columns: _Floats
) -> tuple[_Array, _Array, _Array]:
    """Return harmonics 1 and 2 of the brightness over the phase, which has none.

    How they change with what is fitted, (n, 4, 12 + harmonics), what they are, (n, 4), and how sure that is, (n,).
    """
    rest = np.log(found.brightness / samples.around[:, None])
    rest -= _middle(rest)
    usual = (np.abs(rest) < _USUAL_BRIGHTNESS).astype(rest.dtype)
    count = usual.sum(axis=2)
    share = usual / np.maximum(count, 1)[..., None]
    turns = found.turns[:, [0, 1, HARMONICS, HARMONICS + 1]]
    turns = (turns - turns @ share.swapaxes(1, 2)) * usual
    rest -= (rest * share).sum(axis=2, keepdims=True)
    # A little more than zero also where no place is usual.
    gram = turns @ turns.swapaxes(1, 2) + np.float32(1e-3) * (1 + count)[..., None] * np.eye(4, dtype=np.float32)
    # The turns' means are zero: columns and rest need not lose theirs.
    both = np.linalg.solve(gram, turns @ np.concatenate([columns, rest], axis=1).swapaxes(1, 2)).astype(np.float64)
    count = samples.share * count[:, 0]
    chance = SIGMAS * np.maximum(np.sqrt((rest**2 * share).sum(axis=(1, 2))), 0.01) * np.sqrt(2 / np.maximum(count, 1))
    sure = np.where(count < _LEAST_BRIGHTNESS, 0, 1 / (_BRIGHTNESS**2 + chance**2))
    return both[..., :-1], both[..., -1], sure


def _middle(values: _Floats) -> _Floats:
    """Return the median over the last axis, which stays with length one; several times as fast as `np.median`."""
    middle = values.shape[-1] // 2
    return np.asarray(np.partition(values, middle, axis=-1)[..., middle : middle + 1])


def _dot(a: _Array, b: _Array) -> _Array:
    """Return products of three channels, (..., 1, N)."""
    return np.asarray(a[..., :1, :] * b[..., :1, :] + a[..., 1:2, :] * b[..., 1:2, :] + a[..., 2:, :] * b[..., 2:, :])
