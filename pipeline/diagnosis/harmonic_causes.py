"""Causes of harmonics in the channels: the projector's response, or the camera's transfer.

Both put the same harmonics into every channel, the response before reflectance, ambient light and crosstalk, the
transfer after them. So each is undone in turn: the right one leaves nothing.
"""

from collections.abc import Callable

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

# Below this share of the harmonics' power that the better of both explains, neither is the cause.
_MIN_EXPLAINED = 0.7


def own_harmonics(tiles: Tiles, matrix: FloatArray) -> RobustFit:
    """RobustFit the harmonics (3, K - 1) of the unmixed channels, over their own fundamental and in its phase.

    A response that knows nothing of the other channels makes them real: c_k of f(cos(phi)).
    """
    unmixed = np.linalg.inv(matrix) @ tiles.spectrum
    first, turns = unmixed[..., :1], np.arange(2, unmixed.shape[-1] + 1)
    return robust_fit(unmixed[..., 1:] * np.exp(-1j * turns * np.angle(first)) / abs(first), tiles.weight)


def response_harmonics(response: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Return what a response (3, N) makes of a cosine of codes.

    The harmonics 2..count over the fundamental, (3, count - 1), and the contrast, (3,), one where it is linear.
    """
    codes = 0.5 + 0.5 * np.cos(2 * np.pi * np.arange(256) / 256)
    light = [np.interp(codes, np.linspace(0, 1, len(row)), row) for row in response]
    waves = np.fft.rfft(light, axis=1).real[:, : count + 1]
    return waves[:, 2:] / waves[:, 1:2], 2 * waves[:, 1] / waves[:, 0]


def explain_harmonics(
    tiles: Tiles,
    matrix: FloatArray,
    limit: float,
    other: str,
    read_otherwise: Callable[[], Tiles],
    response: FloatArray | None = None,
) -> tuple[list[RippleFinding], Tiles, FloatArray]:
    """Tell the projector's response from the camera's transfer.

    Parameters
    ----------
    tiles : Tiles
        Spectra of the light as the decoder reads it.
    matrix : (3, 3)
        Crosstalk that the decoder undoes, the sum of each row one.
    limit : float
        Ripple below it is no fault, rad.
    other : str
        The transfer that the levels may have instead.
    read_otherwise : callable
        Returns the tiles of the light as that transfer gives it.
    response : (3, N), optional
        Light of the projector's codes, 0..1, which the decoder undoes.

    Returns
    -------
    list of RippleFinding
        One, or none.
    Tiles
        Without a wrong transfer.
    (3,) float64
        By what factor the response has changed each channel's contrast.
    """
    fit = own_harmonics(tiles, matrix)
    own, floor, power = fit.value[0], np.sum(fit.error**2), np.sum(abs(fit.value) ** 2)
    contrast = np.median(abs(tiles.spectrum[..., 0]))
    turns = np.arange(1, own.shape[1] + 2)

    def size_of(harmonics: npt.NDArray[np.complex128]) -> dict[int, float]:
        pure = np.hstack([np.ones((3, 1)), harmonics]) * contrast * np.exp(1j * turns * PHASES[:, None])
        return ripple_by_harmonic(waves_of_spectrum(matrix @ pure), matrix)

    size = size_of(own)
    # Harmonics that the decoder undoes are no fault, and neither are none: what is known need not be in the pattern.
    undone = [(np.zeros(own.shape), np.ones(3))]
    if response is not None:
        undone.append(response_harmonics(response, own.shape[1] + 1))
    for known, change in undone:
        unknown = np.sum(abs(own - known) ** 2)
        if max(size_of(own - known).values()) < limit or unknown < SIGMAS**2 * floor / own.size:
            return [], tiles, change
    # ((1 + cos) / 2)**gamma has c_(k+1) / c_k = (gamma - k) / (gamma + k + 1), and 2 c_1 / c_0 = 2 gamma / (gamma + 1).
    second = np.clip(own[:, 0].real, -0.45, 0.8)
    gamma = (1 + 2 * second) / (1 - second)
    predicted = np.cumprod((gamma[:, None] - turns[:-1]) / (gamma[:, None] + turns[:-1] + 1), axis=1)
    otherwise = read_otherwise()
    left = {"response": np.sum(abs(own - predicted) ** 2)}
    if len(otherwise.mean) >= MIN_TILES:
        left["transfer"] = np.sum(abs(own_harmonics(otherwise, matrix).value) ** 2)
    best = min(left.values())
    explained = 1 - best / power
    if explained < _MIN_EXPLAINED:
        advice = "look at the camera's picture profile (contrast, sharpening) and at interreflections"
        found = RippleFinding(("unknown harmonics",), "neither a power law nor a transfer", size, 0.5, advice)
        return [found], tiles, np.ones(3)
    words = _words(gamma, other)
    causes = tuple(name for name, value in left.items() if value < 4 * best + DECISIVE * floor)
    sizes, advice = (" or ".join(words[cause][i] for cause in causes) for i in (0, 1))
    finding = RippleFinding(causes, sizes, size, float(min(explained, 0.99)), advice)
    if causes == ("transfer",):
        return [finding], otherwise, np.ones(3)
    return [finding], tiles, 2 * gamma / (gamma + 1)


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
