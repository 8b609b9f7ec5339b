"""Causes of harmonics in the channels: the projector's response, or the camera's transfer.

Both put the same harmonics into every channel, the response before reflectance, ambient light and crosstalk, the
transfer after them. So each is undone in turn: the right one leaves nothing but what is known of the light. A Gaussian
blur of lens, pixels and focus takes exp(-s (k**2 - 1)) off the known k-th harmonic over the fundamental.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pipeline.diagnosis.channel_spectra import (
    PHASES,
    RobustFit,
    Tiles,
    ripple_by_harmonic,
    robust_fit,
    waves_of_spectrum,
)
from pipeline.diagnosis.ripple_finding import DECISIVE, MIN_TILES, SIGMAS, RippleFinding
from pipeline.models import FloatArray

#: What is said of harmonics that neither explains.
UNKNOWN = ("unknown harmonics",)
# Below this share of the harmonics' power that the better of both explains, neither is the cause.
_MIN_EXPLAINED = 0.7
# Lens, pixels and focus together usually blur by 0.7 px; from twice that on it is a fault. The steps are so fine that
# between two of them a second harmonic differs by 3 % of itself.
_MOST_BLUR_PX, _BLURS = 1.5, 31
# A leak that comes out negative by up to this part of a channel's own is noise's.
_LEAST_LEAK = 0.05
# Lags up to a shift of a pixel at 12 px a cycle, in steps of 5 mrad: what a step leaves of a fundamental the leaks take
# up, and spoil harmonics by as much.
_MOST_LAG_RAD, _LAGS = 0.6, 241


def own_harmonics(spectrum: npt.NDArray[np.complex128], weight: FloatArray, matrix: FloatArray) -> RobustFit:
    """RobustFit the harmonics (3, K - 1) of the unmixed channels, over their own fundamental and in its phase.

    Of tiles' spectra (T, 3, K). A response that knows nothing of the other channels makes them real: c_k of
    f(cos(phi)).
    """
    unmixed = np.linalg.inv(matrix) @ spectrum
    first, turns = unmixed[..., :1], np.arange(2, unmixed.shape[-1] + 1)
    return robust_fit(unmixed[..., 1:] * np.exp(-1j * turns * np.angle(first)) / abs(first), weight)


class _KnownHarmonics(NamedTuple):
    """Of the light that is expected, blurred so that it is nearest to a frame's."""

    harmonics: npt.NDArray[np.complex128]  # (3, K - 1) of the primaries, over their fundamental and in its phase
    response: int  # the number of the response


def known_harmonics(
    tiles: Tiles, own: npt.NDArray[np.complex128], matrix: FloatArray, period_px: float
) -> _KnownHarmonics:
    """Return what is expected of harmonics (3, K - 1), the frame's own, by the response and blur that come nearest."""
    turns = np.arange(2, own.shape[1] + 2)
    left = np.exp(-_blurs(period_px)[:, None, None] * (turns**2 - 1))
    best, least = _KnownHarmonics(np.zeros_like(own), 0), np.inf
    for number in range(tiles.expected.shape[-1]):
        sharp = own_harmonics(tiles.expected[..., number], tiles.weight, matrix).value[0]
        misfits = np.sum(abs(own - sharp * left) ** 2, axis=(1, 2))
        nearest = int(np.argmin(misfits))
        if misfits[nearest] < least:
            best, least = _KnownHarmonics(sharp * left[nearest], number), misfits[nearest]
    return best


def left_by_mixing(tiles: Tiles, matrix: FloatArray, response: int, period_px: float) -> npt.NDArray[np.complex128]:
    """Return what of the channels' harmonics no mixing and no lag make of the light that is expected, (3, K - 1).

    A crosstalk, or a lateral colour, that is not known mixes the known harmonics otherwise, or shifts them: that is no
    fault of their own. The leaks into each channel, none negative, and its lag are fitted to all of its spectrum.
    """
    seen = robust_fit(tiles.spectrum, tiles.weight).value[0]
    pure = np.linalg.inv(matrix) @ robust_fit(tiles.expected[..., response], tiles.weight).value[0]
    turns = np.arange(1, seen.shape[1] + 1)
    lags = np.linspace(-_MOST_LAG_RAD, _MOST_LAG_RAD, _LAGS)[:, None, None]
    best, least = seen, np.inf
    for blur in _blurs(period_px):
        known = pure * np.exp(-blur * (turns**2 - 1)) * np.exp(1j * turns * lags)  # (lags, 3, K)
        both, wanted = (np.concatenate([values.real, values.imag], axis=-1) for values in (known, seen))
        rows = wanted @ np.linalg.pinv(both)  # (lags, 3, 3)
        rest = seen - rows @ known
        misfits = np.sum(abs(rest) ** 2, axis=-1)  # (lags, 3)
        misfits[rows.min(axis=-1) < -_LEAST_LEAK * rows.max(axis=-1)] = np.inf
        nearest = np.argmin(misfits, axis=0)
        misfit = float(misfits[nearest, range(3)].sum())
        if misfit < least:
            best, least = rest[nearest, range(3)], misfit
    return np.asarray(best[:, 1:])


def _blurs(period_px: float) -> FloatArray:
    return np.linspace(0, 2 * (np.pi * _MOST_BLUR_PX / period_px) ** 2, _BLURS)


def explain_harmonics(
    tiles: Tiles,
    matrix: FloatArray,
    limit: float,
    period_px: float,
    other: str,
    read_otherwise: Callable[[], Tiles],
) -> tuple[list[RippleFinding], Tiles, npt.NDArray[np.complex128]]:
    """Tell the projector's response from the camera's transfer.

    Parameters
    ----------
    tiles : Tiles
        Spectra of the light as the decoder reads it, and of the light that is expected.
    matrix : (3, 3)
        Crosstalk that the decoder undoes, the sum of each row one.
    limit : float
        Ripple below it is no fault, rad.
    period_px : float
        Camera px a cycle.
    other : str
        The transfer that the levels may have instead.
    read_otherwise : callable
        Returns the tiles of the light as that transfer gives it.

    Returns
    -------
    list of RippleFinding
        One, or none.
    Tiles
        Without a wrong transfer.
    (T, 3) complex128
        The fundamentals that are expected of these tiles, the response that was found in them.
    """
    fit = own_harmonics(tiles.spectrum, tiles.weight, matrix)
    own, floor = fit.value[0], np.sum(fit.error**2)
    contrast = np.median(abs(tiles.spectrum[..., 0]))
    turns = np.arange(1, own.shape[1] + 2)
    known, number = known_harmonics(tiles, own, matrix, period_px)
    fundamental = contrast * np.exp(1j * PHASES[:, None])

    def size_of(harmonics: npt.NDArray[np.complex128]) -> dict[int, float]:
        return ripple_by_harmonic(waves_of_spectrum(np.hstack([matrix @ fundamental, harmonics])), matrix)

    size = size_of(matrix @ ((own - known) * contrast * np.exp(1j * turns[1:] * PHASES[:, None])))
    power = np.sum(abs(own - known) ** 2)  # of what is not known
    expected = tiles.expected[:, :, 0, number]
    if max(size.values()) < limit or power < SIGMAS**2 * floor / own.size:
        return [], tiles, expected
    if max(size_of(left_by_mixing(tiles, matrix, number, period_px)).values()) < limit:
        return [], tiles, expected
    # ((1 + cos) / 2)**gamma has c_(k+1) / c_k = (gamma - k) / (gamma + k + 1), and 2 c_1 / c_0 = 2 gamma / (gamma + 1).
    second = np.clip(own[:, 0].real, -0.45, 0.8)
    gamma = (1 + 2 * second) / (1 - second)
    predicted = np.cumprod((gamma[:, None] - turns[:-1]) / (gamma[:, None] + turns[:-1] + 1), axis=1)
    otherwise = read_otherwise()
    left = {"response": np.sum(abs(own - predicted) ** 2)}
    if len(otherwise.mean) >= MIN_TILES:
        own_otherwise = own_harmonics(otherwise.spectrum, otherwise.weight, matrix).value[0]
        known_otherwise = known_harmonics(otherwise, own_otherwise, matrix, period_px)
        left["transfer"] = np.sum(abs(own_otherwise - known_otherwise.harmonics) ** 2)
    best = min(left.values())
    explained = 1 - best / power
    if explained < _MIN_EXPLAINED:
        advice = "look at the camera's picture profile (contrast, sharpening) and at interreflections"
        found = RippleFinding(UNKNOWN, "neither a power law nor a transfer", size, 0.5, advice)
        return [found], tiles, expected
    words = _words(gamma, other)
    causes = tuple(name for name, value in left.items() if value < 4 * best + DECISIVE * floor)
    sizes, advice = (" or ".join(words[cause][i] for cause in causes) for i in (0, 1))
    finding = RippleFinding(causes, sizes, size, float(min(explained, 0.99)), advice)
    if causes == ("transfer",):
        return [finding], otherwise, otherwise.expected[:, :, 0, known_otherwise.response]
    # Each primary's contrast as the response that was found makes it.
    unmixed = expected @ np.linalg.inv(matrix).T
    change = 2 * gamma / (gamma + 1) / np.median(abs(unmixed), axis=0)
    return [finding], tiles, (change * unmixed) @ matrix.T


def _words(gamma: FloatArray, other: str) -> dict[str, tuple[str, str]]:
    """Say of each cause how large it is, and what to do."""
    return {
        "response": (
            f"projector gamma R {gamma[0]:.2f}, G {gamma[1]:.2f}, B {gamma[2]:.2f}",
            "calibrate the response, or equalise",
        ),
        "transfer": (
            f"levels that look {'sRGB-coded' if other == 'srgb' else 'linear already'}",
            f"decode with transfer={other!r}",
        ),
    }
