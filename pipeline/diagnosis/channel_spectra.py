"""Spectra of a colour frame's channels against its own fringe phase, tile by tile, and the ripple they make.

They are compared with what is known of the rig's light. The pattern's codes 1 - m + m cos(phi), whose modulation m is
the code's, go through the projector's response f and the crosstalk M:

    I_j(phi) = sum_k M_jk f_k(1 - m(phi - l_k) + m(phi - l_k) cos(phi + p_k - l_k)),

l_k the lag of primary k by the projector's lateral colour. The spectra of this light hold the response's harmonics, and
the effect of the code on contrasts and phases of a few cycles; neither is a fault.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.calibration import Calibration
from pipeline.contrast_code import CYCLES, ContrastCode
from pipeline.models import CodeName, FloatArray
from pipeline.pattern import CHANNEL_PHASES
from pipeline.robust import robust_sigma
from pipeline.settings import DecodeSettings

CHANNELS = "RGB"
#: Tiles at least: fewer have no scatter that shows how sure a cause is.
MIN_TILES = 20
#: A fault must exceed its own standard error by this factor: noise does so once in two million times.
SIGMAS = 5.0
#: Nobody sees a smaller error of the phase, rad: 0.02 mm on a rig with 0.14 rad per mm.
LEAST_RAD = 0.003
#: Chi square by which one explanation beats another: three standard deviations.
DECISIVE = 9.0
# Samples per cycle: between them the light's twelfth harmonic is off by 0.2 % of its own, which is little to begin
# with.
_SAMPLES = 128
#: A response that changes nothing.
LINEAR = np.array([[0.0, 1.0]] * 3)
PHASES = np.array(CHANNEL_PHASES)
#: Harmonics of the phase at which the ripples of a three-channel arctangent are.
RIPPLE_HARMONICS = (1, 2, 3, 6)
# Cycles per tile: enough to distinguish harmonics from a slowly changing mean, few enough to follow a surface.
_TILE_CYCLES = 3
#: Tiles start every half a tile along both axes, so that only one in four is independent of the others.
OVERLAP = 2
# Six slopes that the mean and the fundamental may have in a tile: 1, u, v, uv, u**2, v**2.
_SLOPES = 6


@dataclass(frozen=True)
class RippleFinding:
    """One thing that is wrong, or the smallest set of things that this frame cannot distinguish."""

    causes: tuple[str, ...]
    size: str  # in the fault's own unit
    ripple_rad: dict[int, float]  # by harmonic of the phase: what it does to a balanced, plain arctangent
    confidence: float  # 0..1 that the cause is one of `causes`
    advice: str


@dataclass(frozen=True, eq=False)
class KnownLight:
    """Light as settings and calibration describe it, which decoding undoes.

    Attributes
    ----------
    crosstalk_matrix : (3, 3) or None
        None: nothing is undone.
    responses : tuple of (3, N)
        Light of the projector's codes, 0..1; any of them may be the one that the pattern's codes go through.
    lag_rad : (3,) or None
        By how much the projector's lateral colour delays R, G and B.
    code : {"contrast", "contrast2"} or None
        The pattern's.
    """

    crosstalk_matrix: FloatArray | None = None
    responses: tuple[FloatArray, ...] = (LINEAR,)
    lag_rad: FloatArray | None = None
    code: CodeName | None = None

    @classmethod
    def of(cls, settings: DecodeSettings, calibration: Calibration, code: CodeName | None) -> "KnownLight":
        """Return what settings and calibration state, which the settings overrule, and the code of the decoder."""
        given = settings.crosstalk_matrix
        return cls(
            calibration.crosstalk_matrix if given is None else given,
            tuple(calibration.responses() or [LINEAR]),
            calibration.projector_lag_rad(),
            code,
        )

    @property
    def matrix(self) -> FloatArray:
        """The crosstalk, the sum of each row one: balanced channels are grey whatever the rows' sums."""
        matrix = np.eye(3) if self.crosstalk_matrix is None else np.asarray(self.crosstalk_matrix, np.float64)
        return np.asarray(matrix / matrix.sum(axis=1, keepdims=True))


#: Light (N, 3, responses) of the channels at unwrapped phases (N,), rad, for each response that it may go through.
ExpectedLight = Callable[[FloatArray], npt.NDArray[np.float64]]


def expected_light(known: KnownLight, *, coded: bool) -> ExpectedLight:
    """Return the light of a rig's channels by phase; `coded`: phases are absolute, and modulation follows the code."""
    cycles = np.arange((CYCLES if coded else 1) * _SAMPLES) / _SAMPLES
    lag = np.zeros(3) if known.lag_rad is None else known.lag_rad
    place = cycles[:, None] - lag / (2 * np.pi)
    modulation: Any = 0.5
    if coded and known.code is not None:
        code = ContrastCode.named(known.code)
        # A tile holds many cells of "contrast2": their mean is expected, and how they differ is among its noise.
        mean = (code.contrasts / (1 + code.contrasts)).mean()
        modulation = code.modulation(place) if known.code == "contrast" else mean
    codes = 1 - modulation + modulation * np.cos(2 * np.pi * place + PHASES)
    primaries = [
        [np.interp(codes[:, k], np.linspace(0, 1, len(row)), row) for k, row in enumerate(response)]
        for response in known.responses
    ]
    channels, period = known.matrix @ np.array(primaries), None if coded else 1.0

    def at(phase: FloatArray) -> npt.NDArray[np.float64]:
        turns = phase / (2 * np.pi)
        light = [[np.interp(turns, cycles, row, period=period) for row in rows] for rows in channels]
        return np.asarray(light).transpose(2, 1, 0)

    return at


class Tiles(NamedTuple):
    """Spectra of T tiles against the phase."""

    mean: FloatArray  # (T, 3) of full scale
    spectrum: npt.NDArray[np.complex128]  # (T, 3, K) harmonics 1..K over the mean, their common phase taken out
    noise: FloatArray  # (T,) residual, of full scale
    frequency: FloatArray  # (T,) rad per px
    place: npt.NDArray[np.int64]  # (T, 2) row, column of the tile
    across: FloatArray  # (T,) distance from the image's centre across the stripes, in half diagonals
    weight: FloatArray  # (T,) inverse variance of the contrasts
    expected: npt.NDArray[np.complex128]  # (T, 3, K, R) spectra of the light that is expected, by response


class RobustFit(NamedTuple):
    """Result of `robust_fit`, (N, ...) for N shapes."""

    value: Any  # real or complex, as the values
    error: Any  # standard deviation
    squares: float  # sum of the squared residuals, outliers cut


def smooth_phase(
    unwrapped_phase: npt.NDArray[np.float32], mask: npt.NDArray[np.bool_]
) -> tuple[FloatArray, npt.NDArray[np.bool_], float]:
    """Return a phase without ripple (H, W), where it holds (H, W), and the period in px.

    A ripple repeats every cycle or faster: a Gaussian of 0.75 cycles leaves 2e-5 of it. What smoothing does to the
    surface is slow and common to the channels, so it cancels from their ratios.
    """
    valid = np.asarray(mask, bool) & np.isfinite(unwrapped_phase)
    filled = np.where(valid, unwrapped_phase, 0.0).astype(np.float64)
    down = np.median(np.diff(filled, axis=0)[valid[1:] & valid[:-1]])
    right = np.median(np.diff(filled, axis=1)[valid[:, 1:] & valid[:, :-1]])
    period = float(2 * np.pi / max(np.hypot(down, right), 1e-3))
    rows, columns = np.indices(filled.shape)
    plane = down * rows + right * columns
    for _ in range(2):  # the second time without the steps that the first has shown
        weight = cv2.GaussianBlur(valid.astype(np.float32), (0, 0), 0.75 * period)
        rest = np.where(valid, filled - plane, 0.0).astype(np.float32)
        smooth = plane + cv2.GaussianBlur(rest, (0, 0), 0.75 * period) / np.maximum(weight, 1e-9)
        # No relevant ripple reaches a radian: what does is a step, or a wrong order.
        step = valid & (abs(filled - smooth) > 1.0)
        valid &= cv2.dilate(np.uint8(step), np.ones((3, 3))) == 0
    # Beside a straight edge, where the smoothing is one-sided, the weight is half; 0.6 cycles further in it is 0.8.
    return smooth, valid & (weight > 0.8), period


def tile_side(period: float) -> int:
    """Return the side of a tile in px; tiles start every half a side, `place` counts those steps."""
    return max(16, round(_TILE_CYCLES * period))


def fit_tiles(
    light: FloatArray,
    phase: FloatArray,
    usable: npt.NDArray[np.bool_],
    period: float,
    keep: npt.NDArray[np.bool_] | None = None,
    expected: ExpectedLight | None = None,
) -> Tiles:
    """Regress every channel on the phase in tiles: mean and fundamental may change quadratically over a tile.

    light (H, W, 3) and phase (H, W) where usable (H, W), channel by channel only where keep (H, W, 3); and the same of
    the light that is expected at that phase.
    """
    side = tile_side(period)
    orders = np.arange(2, int(np.clip(period / 2 - 1, 2, 6)) + 1)  # short of half a cycle a pixel
    v, u = (np.indices((side, side)).reshape(2, -1) + 0.5) / side * 2 - 1
    slopes = np.stack([np.ones_like(u), u, v, u * v, u * u - 1 / 3, v * v - 1 / 3], axis=1)
    shape = np.array(usable.shape)
    results = []
    for corner in np.ndindex(*np.maximum(1 + (shape - side) // (side // OVERLAP), 0)):
        top, left = np.array(corner) * (side // OVERLAP)
        tile = np.s_[top : top + side, left : left + side]
        inside = usable[tile].ravel()
        if inside.mean() < 0.75:
            continue
        wave = np.exp(1j * phase[tile].ravel())[:, None]
        basis = np.hstack([slopes, slopes * wave.real, slopes * wave.imag, (wave**orders).real, (wave**orders).imag])
        values = light[tile].reshape(-1, 3, 1)
        if expected is not None:
            values = np.concatenate([values, expected(phase[tile].ravel())], axis=2)
        if keep is None or keep[tile].all():
            means, spectra, square, variance = _fit_channels(basis[inside], values[inside])
        else:
            kept = [inside & keep[tile][..., j].ravel() for j in range(3)]
            if min(chosen.mean() for chosen in kept) < 0.3:
                continue
            fits = [_fit_channels(basis[chosen], values[chosen, j : j + 1]) for j, chosen in enumerate(kept)]
            means, spectra, square, variance = (np.concatenate(parts) for parts in zip(*fits, strict=True))
        mean, square, variance = means[:, 0], square[:, 0], variance[:, 0]
        if mean.min() <= 0:
            continue
        spectra = _in_its_phase(spectra)
        changes: Any = np.gradient(phase[tile])
        slope = np.array([np.median(change[usable[tile]]) for change in changes])
        frequency = float(np.hypot(slope[0], slope[1]))
        centre = np.array([top, left]) + side / 2 - shape / 2
        across = 2 * slope @ centre / frequency / np.hypot(*shape)
        weight = 1 / max(variance.sum(), 1e-12)
        spread = np.sqrt(square.mean())
        results.append((mean, spectra[..., 0], spread, frequency, corner, across, weight, spectra[..., 1:]))
    if not results:
        none, places = np.empty(0), np.empty((0, 2), np.int64)
        spectra = np.empty((0, 3, 2, 1), complex)
        return Tiles(np.empty((0, 3)), spectra[..., 0], none, none, places, none, none, spectra)
    tiles = Tiles(*(np.array(values) for values in zip(*results, strict=True)))
    # What fits much worse than its fellows holds an edge or fine detail; what is much less certain is of no use.
    good = (tiles.noise <= 2 * np.median(tiles.noise)) & (tiles.weight >= 0.1 * np.median(tiles.weight))
    return Tiles._make(values[good] for values in tiles)


def _in_its_phase(spectra: npt.NDArray[np.complex128]) -> npt.NDArray[np.complex128]:
    """Return spectra (3, K, R), the phase that is common to the fundamentals of three channels taken out of each."""
    common = np.angle(np.exp(-1j * PHASES) @ spectra[:, 0])
    return np.asarray(spectra * np.exp(-1j * np.outer(np.arange(1, spectra.shape[1] + 1), common)))


def _fit_channels(basis: FloatArray, values: FloatArray) -> tuple[Any, Any, Any, Any]:
    """Return of each channel mean, spectrum over the mean, residual's and the relative fundamental's variance.

    Of values (N, C, R), R lights in each channel, by a basis (N, B): (C, R), and the spectrum (C, K, R).
    """
    inverse = np.linalg.inv(basis.T @ basis + 1e-9 * len(basis) * np.eye(basis.shape[1]))
    flat = values.reshape(len(values), -1)
    solution = inverse @ (basis.T @ flat)
    square = np.mean((flat - basis @ solution) ** 2, axis=0).reshape(values.shape[1:])
    solution = solution.reshape(-1, *values.shape[1:])
    mean, c, s = solution[0], _SLOPES, 2 * _SLOPES
    higher = solution[3 * _SLOPES :].reshape(2, -1, *values.shape[1:])
    spectrum = np.concatenate([(solution[c] - 1j * solution[s])[None], higher[0] - 1j * higher[1]]) / mean
    variance = square * (inverse[c, c] + inverse[s, s]) / mean**2
    return mean, spectrum.swapaxes(0, 1), square, variance


def robust_fit(values: Any, weight: FloatArray, shapes: FloatArray | None = None) -> RobustFit:
    """Fit values (T, ...), real or complex, by shapes (T, N), None: a constant; outliers are weighed down.

    The scatter of the tiles, not the noise of the pixels, gives the errors: it holds what no model knows. A residual
    that a part of the picture has by itself counts up to ten times the scatter.
    """
    if np.iscomplexobj(values):
        real, imaginary = robust_fit(values.real, weight, shapes), robust_fit(values.imag, weight, shapes)
        return RobustFit(
            real.value + 1j * imaginary.value, np.hypot(real.error, imaginary.error), real.squares + imaginary.squares
        )
    shapes = np.ones((len(values), 1)) if shapes is None else shapes
    weight = weight / weight.mean()
    fitted, errors, squares = [], [], 0.0
    for column in values.reshape(len(values), -1).T:
        trust = weight
        for _ in range(8):
            covariance = np.linalg.inv((shapes.T * trust) @ shapes)
            fitted_column = covariance @ (shapes.T * trust) @ column
            residual = abs(column - shapes @ fitted_column) * np.sqrt(weight)
            scale = robust_sigma(residual) + 1e-12
            trust = weight / np.maximum(1.0, residual / (2 * scale))
        fitted.append(fitted_column)
        errors.append(OVERLAP * scale * np.sqrt(np.diag(covariance)))
        squares += np.sum(np.minimum(residual, 10 * scale) ** 2)
    to = (-1, *values.shape[1:])
    return RobustFit(np.array(fitted).T.reshape(to), np.array(errors).T.reshape(to), float(squares))


def mean_spectrum(tiles: Tiles) -> npt.NDArray[np.complex128]:
    """Return the (3, K) spectrum of the whole image."""
    return np.asarray(robust_fit(tiles.spectrum, tiles.weight).value[0])


def neighbours_median(values: FloatArray, place: npt.NDArray[np.int64]) -> FloatArray:
    """Return the (T, ...) medians over every tile and those around it."""
    near = np.abs(place[:, None] - place[None]).max(axis=-1) <= 1
    return np.array([np.median(values[row], axis=0) for row in near])


def waves_of_spectrum(spectrum: npt.NDArray[np.complex128]) -> FloatArray:
    """Return (3, 256) one cycle of the channels, their means one."""
    turns = np.outer(np.arange(1, spectrum.shape[1] + 1), np.arange(256) * 2 * np.pi / 256)
    return np.asarray(1 + (spectrum @ np.exp(1j * turns)).real)


def ripple_by_harmonic(waves: FloatArray, matrix: FloatArray) -> dict[int, float]:
    """Return the phase error's amplitude by harmonic of a plain arctangent on balanced channels, rad."""
    phase = np.arange(waves.shape[1]) * 2 * np.pi / waves.shape[1]
    vector = np.exp(-1j * PHASES) @ np.linalg.solve(matrix, waves)  # proportional to exp(i phase)
    error = np.fft.rfft(np.angle(vector * np.exp(-1j * phase))) / len(phase)
    return {k: float(2 * abs(error[k])) for k in RIPPLE_HARMONICS}


def clipping_ripple(
    too_bright: npt.NDArray[np.bool_],
    too_dark: npt.NDArray[np.bool_],
    usable: npt.NDArray[np.bool_],
    period: float,
    spectrum: npt.NDArray[np.complex128],
    matrix: FloatArray,
) -> dict[int, float]:
    """Return the ripple by harmonic from clipping the waves, exceeded in a twentieth of the places."""
    size = (2 * round(period),) * 2
    weight = np.maximum(cv2.blur(np.float64(usable), size), 1e-9)[..., None]
    bright, dark = (
        (cv2.blur(np.float64(cut & usable[..., None]), size) / weight)[:: round(period), :: round(period)]
        for cut in (too_bright, too_dark)
    )
    waves = waves_of_spectrum(spectrum)
    clean = ripple_by_harmonic(waves, matrix)
    ripples = []
    for place in np.argwhere(usable[:: round(period), :: round(period)]):
        shares = list(zip(waves, dark[tuple(place)], bright[tuple(place)], strict=True))
        cut = np.stack(
            [np.clip(wave, np.quantile(wave, low), np.quantile(wave, 1 - high)) for wave, low, high in shares]
        )
        cut_ripple = ripple_by_harmonic(cut / cut.mean(axis=1, keepdims=True), matrix)
        ripples.append([abs(cut_ripple[k] - clean[k]) for k in RIPPLE_HARMONICS])
    return dict(zip(RIPPLE_HARMONICS, np.quantile(ripples, 0.95, axis=0).tolist(), strict=True))


def seen_ripple(
    unwrapped_phase: npt.NDArray[np.float32], phase: FloatArray, usable: npt.NDArray[np.bool_]
) -> dict[int, float]:
    """Return the ripple's amplitude by harmonic in the phase that was handed in, rad."""
    rest, wave = (unwrapped_phase - phase)[usable], np.exp(-1j * phase[usable])
    return {k: float(2 * abs(np.mean((rest - rest.mean()) * wave**k))) for k in RIPPLE_HARMONICS}
