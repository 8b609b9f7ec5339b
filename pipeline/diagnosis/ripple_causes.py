"""Causes of ripple: of harmonics in the channels, and of contrasts and phases that differ between them.

Projector response and camera transfer put the same harmonics into every channel, the response before reflectance,
ambient light and crosstalk, the transfer after them. So each is undone in turn: the right one leaves nothing but what
is known of the light. A Gaussian blur of lens, pixels and focus takes exp(-s (k**2 - 1)) off the known k-th harmonic
over the fundamental.

Contrasts and phases of the fundamentals differ by crosstalk, lenses, a black level, or motion. Each is a row of one
table: a linear change of the logarithms of the fundamentals, tile by tile. All rows are fitted to the same evidence and
compared by the squares that they leave, with a penalty for the numbers that they take.
"""

from collections.abc import Callable, Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pipeline.decoding.self_calibration import smallest_leaks
from pipeline.diagnosis.channel_spectra import (
    CHANNELS,
    DECISIVE,
    MIN_TILES,
    PHASES,
    SIGMAS,
    RippleFinding,
    RobustFit,
    Tiles,
    mean_spectrum,
    neighbours_median,
    ripple_by_harmonic,
    robust_fit,
    waves_of_spectrum,
)
from pipeline.models import FloatArray

#: Cause of harmonics that neither explains.
UNKNOWN = ("unknown harmonics",)
# Below this share of the harmonics' power that the better of both explains, neither is the cause.
_MIN_EXPLAINED = 0.7
# Lens, pixels and focus together usually blur by 0.7 px; from twice that on it is a fault. The steps are so fine that
# between two of them a second harmonic differs by 3 % of itself.
_MOST_BLUR_PX, _BLURS = 1.5, 31
# Variance of a leak of which nothing is known, over that of a spectrum: large, and no hindrance to a solution.
_UNKNOWN_LEAK = 1e-5
# A leak that comes out negative by up to this part of a channel's own is noise's.
_LEAST_LEAK = 0.05
# Lags up to a shift of a pixel at 12 px per cycle, in steps of 5 mrad: what a step leaves of a fundamental the leaks
# take up, and spoil harmonics by as much.
_MOST_LAG_RAD, _LAGS = 0.6, 241
# What is left of a cause (curvature, second order) is up to this share of it, and no second fault.
_LEAKAGE = 0.15
_BLACK = "subtract a frame of black from the same projector; if the ripple stays, refocus or calibrate the crosstalk"
_COLORS = "subtract a frame of black from the same projector; then calibrate the crosstalk with each colour alone"
_AT_REST = "photograph the scene at rest: if it stays, calibrate the lateral colour; if not, show all colours at once"
_MATRIX = "calibrate the crosstalk with three single-colour frames; 4:2:0 video looks like this too"


def own_harmonics(spectrum: npt.NDArray[np.complex128], weight: FloatArray, matrix: FloatArray) -> RobustFit:
    """Fit the harmonics (3, K - 1) of the unmixed channels, over their own fundamental and in its phase.

    Of tiles' spectra (T, 3, K). A response that knows nothing of the other channels makes them real: c_k of
    f(cos(phi)).
    """
    unmixed = np.linalg.inv(matrix) @ spectrum
    first, turns = unmixed[..., :1], np.arange(2, unmixed.shape[-1] + 1)
    return robust_fit(unmixed[..., 1:] * np.exp(-1j * turns * np.angle(first)) / abs(first), weight)


def left_by_mixing(
    spectrum: npt.NDArray[np.complex128], lights: npt.NDArray[np.complex128], period_px: float
) -> tuple[npt.NDArray[np.complex128], int]:
    """Return what no mixing, lag and blur of the projector's light explain of the channels' harmonics, (3, K - 1).

    A crosstalk, or a lateral colour, that is not known mixes the known harmonics otherwise, or shifts them: that is no
    fault of their own. The leaks into each channel and its lag are fitted to all of its spectrum (3, K) by each of the
    lights (R, 3, K); second, the number of the light that leaves the least.
    """
    turns = np.arange(1, spectrum.shape[1] + 1)
    lags = np.linspace(-_MOST_LAG_RAD, _MOST_LAG_RAD, _LAGS)[:, None, None]
    best, least, number = spectrum, np.inf, 0
    for k, blur in product(range(len(lights)), np.linspace(0, 2 * (np.pi * _MOST_BLUR_PX / period_px) ** 2, _BLURS)):
        known = lights[k] * np.exp(-blur * (turns**2 - 1)) * np.exp(1j * turns * lags)  # (lags, 3, K)
        both, wanted = (np.concatenate([values.real, values.imag], axis=-1) for values in (known, spectrum))
        # A leak that is alike from all primaries shows in every third harmonic only, which may be none.
        gram = both @ both.swapaxes(-1, -2) + _UNKNOWN_LEAK * np.eye(3)
        rest = spectrum - np.linalg.solve(gram, both @ wanted.T).swapaxes(-1, -2) @ known
        misfits = np.sum(abs(rest) ** 2, axis=-1)  # (lags, 3)
        nearest = np.argmin(misfits, axis=0)
        misfit = float(misfits[nearest, range(3)].sum())
        if misfit < least:
            best, least, number = rest[nearest, range(3)], misfit, k
    return np.asarray(best[:, 1:]), number


def _left_of(tiles: Tiles, matrix: FloatArray, period_px: float) -> tuple[npt.NDArray[np.complex128], int]:
    """Return what no mixing explains of the light that is expected of these tiles, over the primaries' contrast."""
    unmix, spectrum = np.linalg.inv(matrix), mean_spectrum(tiles)
    lights = unmix @ np.moveaxis(robust_fit(tiles.expected, tiles.weight).value[0], -1, 0)
    rest, number = left_by_mixing(spectrum, lights, period_px)
    return rest / np.median(abs(unmix @ spectrum[:, 0])), number


def explain_harmonics(
    tiles: Tiles,
    matrix: FloatArray,
    limit: float,
    period_px: float,
    other: str,
    read_otherwise: Callable[[], Tiles],
) -> tuple[list[RippleFinding], Tiles, npt.NDArray[np.complex128]]:
    """Distinguish the projector's response from the camera's transfer.

    Parameters
    ----------
    tiles : Tiles
        Spectra of the light as the decoder reads it, and of the light that is expected.
    matrix : (3, 3)
        Crosstalk that the decoder undoes, the sum of each row one.
    limit : float
        Ripple below it is no fault, rad.
    period_px : float
        Camera px per cycle.
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
    own, contrast = fit.value[0], np.median(abs(tiles.spectrum[..., 0] @ np.linalg.inv(matrix).T))
    rest, number = _left_of(tiles, matrix, period_px)
    pattern = np.exp(1j * PHASES[:, None] * np.arange(1, own.shape[1] + 2))
    size = ripple_by_harmonic(waves_of_spectrum(contrast * np.hstack([matrix @ pattern[:, :1], rest])), matrix)
    power, floor = np.sum(abs(rest) ** 2), np.sum(fit.error**2)
    expected = tiles.expected[:, :, 0, number]
    if max(size.values()) < limit or power < SIGMAS**2 * floor / own.size:
        return [], tiles, expected
    # ((1 + cos) / 2)**gamma has c_(k+1) / c_k = (gamma - k) / (gamma + k + 1), and 2 c_1 / c_0 = 2 gamma / (gamma + 1).
    second, turns = np.clip(own[:, :1].real, -0.45, 0.8), np.arange(1, own.shape[1] + 1)
    gamma = (1 + 2 * second) / (1 - second)
    power_law = np.cumprod(np.hstack([gamma**0, (gamma - turns) / (gamma + turns + 1)]), axis=1) * pattern
    otherwise, left = read_otherwise(), {}
    left["response"] = left_by_mixing(mean_spectrum(tiles), power_law[None], period_px)[0] / contrast
    if len(otherwise.mean) >= MIN_TILES:
        left["transfer"], number = _left_of(otherwise, matrix, period_px)
    squares = {cause: np.sum(abs(rest) ** 2) for cause, rest in left.items()}
    best = min(squares.values())
    explained = 1 - best / power
    if explained < _MIN_EXPLAINED:
        advice = "look at the camera's picture profile (contrast, sharpening) and at interreflections"
        found = RippleFinding(UNKNOWN, "neither a power law nor a transfer", size, 0.5, advice)
        return [found], tiles, expected
    words = _words(gamma[:, 0], other)
    causes = tuple(cause for cause, value in squares.items() if value < 4 * best + DECISIVE * floor)
    sizes, advice = (" or ".join(words[cause][i] for cause in causes) for i in (0, 1))
    finding = RippleFinding(causes, sizes, size, float(min(explained, 0.99)), advice)
    if causes == ("transfer",):
        return [finding], otherwise, otherwise.expected[:, :, 0, number]
    # Each primary's contrast as the response that was found makes it.
    unmixed = expected @ np.linalg.inv(matrix).T
    change = (2 * gamma / (gamma + 1))[:, 0] / np.median(abs(unmixed), axis=0)
    return [finding], tiles, (change * unmixed) @ matrix.T


def _words(gamma: FloatArray, other: str) -> dict[str, tuple[str, str]]:
    """Return for each cause its size, and what to do."""
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


def ideal(matrix: FloatArray, contrast: Any = 1.0) -> npt.NDArray[np.complex128]:
    """Return the (3,) fundamentals that the camera sees of a pattern whose channels have this contrast."""
    return np.asarray(matrix @ (contrast * np.exp(1j * PHASES)))


class Explanation(NamedTuple):
    """A row of the table of causes: something that changes the channels' fundamentals in a way of its own."""

    causes: tuple[str, ...]
    #: (n, T or 1, 3): what n numbers add to the logarithms of the fundamentals, of the contrast and i times the phase.
    shapes: npt.NDArray[Any]
    words: Callable[[FloatArray], str]
    advice: str
    chosen: int = 0  # how many more numbers were chosen from the tiles themselves


def explanations(tiles: Tiles, lag: FloatArray) -> list[Explanation]:
    """Return the table of causes for tiles whose red and blue lag behind green by (T, 2) rad; first: nothing."""
    f, across = tiles.frequency[:, None], tiles.across[:, None]
    two, fields = np.eye(3)[::2, None], np.array([[[-1j, 0, 1j]]])
    strength = np.hypot(*neighbours_median(lag, tiles.place).T)
    moving = (strength > 0.5 * np.quantile(strength, 0.95))[:, None]
    ends = np.array([[1, 1], [across.min(), across.max()]])
    more = ("projector amplitude", "projector defocus", "camera defocus", "even crosstalk")
    lens, motion = ("lateral colour of the camera",), ("motion between colour fields",)
    to = "R {:+.2f} to {:+.2f} px, B {:+.2f} to {:+.2f} px of G across the picture"

    def lost(n: FloatArray) -> str:
        parts = zip(CHANNELS, np.expm1(np.array([n[0], 0, n[1]]) - max(0, *n)), strict=True)
        return "contrasts against the best channel: " + ", ".join(f"{name} {100 * part:+.0f} %" for name, part in parts)

    def speed(n: FloatArray, times: Any = 1) -> str:
        return f"{abs(n[0]) * np.median(times):.3f} rad a field"

    table = [Explanation((), np.empty((0, 1, 3)), lambda n: "", "")]
    for own, name in zip(np.eye(3), CHANNELS, strict=True):
        table += _one_contrast(tiles, own, name)
    return [
        *table,
        _black_level(tiles, np.ones(3), "all channels"),
        Explanation(more, two, lost, _COLORS),
        Explanation(lens, 1j * f * two, lambda n: "R {:+.2f} px, B {:+.2f} px of G".format(*-n), _AT_REST),
        Explanation(
            lens,
            1j * f * np.concatenate([two + 0 * across, across * two]),
            lambda n: to.format(*(-n.reshape(2, 2).T @ ends).ravel()),
            _AT_REST,
        ),
        Explanation(
            ("lateral colour of the projector",),
            1j * two,
            lambda n: "R {:+.3f} rad, B {:+.3f} rad from G".format(*n),
            _AT_REST,
        ),
        # One speed: from red to green as from green to blue.
        Explanation(motion, fields, speed, _AT_REST, 1),
        Explanation(motion, f * fields, lambda n: speed(n, f), _AT_REST, 1),
        Explanation(motion, np.stack([f, f * across]) * fields, lambda n: speed(n, f), _AT_REST, 2),
        Explanation(motion, 1j * moving * two, lambda n: f"{speed(n)} in a part of the picture", _AT_REST, 4),
        Explanation(("crosstalk",), np.concatenate([two, 1j * two]), lambda n: "", _MATRIX),
    ]


def _black_level(tiles: Tiles, own: FloatArray, name: str) -> Explanation:
    """Return the row of light that is added to some channels (3,): it weighs most where it is dark."""
    size = "{:+.3f} of full scale added to " + name
    return Explanation(
        ("black level", "coloured ambient light"), -own / tiles.mean[None], lambda n: size.format(*n), _BLACK
    )


def _one_contrast(tiles: Tiles, own: FloatArray, name: str) -> list[Explanation]:
    """Return the rows of what changes the contrast of one channel (3,)."""
    causes = ("projector amplitude", "projector defocus", "even crosstalk", "coloured ambient light")

    def percent(n: FloatArray) -> str:
        return f"{name}'s modulation {100 * np.expm1(n[0]):+.1f} %"

    def blurred(n: FloatArray) -> str:  # a channel that is sharper than the others shows that they are blurred
        return f"{name if n[0] < 0 else CHANNELS.replace(name, '')} blurred by {np.sqrt(abs(n[0])):.2f} px"

    return [
        Explanation(causes, own[None, None], percent, _BLACK),
        _black_level(tiles, own, name),
        Explanation(("camera defocus",), (tiles.frequency[:, None] ** 2 / 2 * own)[None], blurred, _BLACK),
    ]


def _evidence(change: npt.NDArray[Any], count: int) -> FloatArray:
    """Return what of changes (..., T or 1, 3) makes a ripple, (..., 6 T): not what all channels have in common."""
    change = np.broadcast_to(change, (*change.shape[:-2], count, 3))
    change = change - change.mean(axis=-1, keepdims=True)
    return np.concatenate([change.real, change.imag], axis=-1).reshape(*change.shape[:-2], 6 * count)


def explain_fundamental(
    tiles: Tiles, expected: npt.NDArray[np.complex128], matrix: FloatArray, limit: float
) -> list[RippleFinding]:
    """Name what makes the channels' contrasts or phases differ from the fundamentals (T, 3) that are expected.

    The row of the table is taken that fits best, with those that fit as well, and then of what it leaves, until that
    makes no ripple.
    """
    most_contrast = np.median(abs(expected @ np.linalg.inv(matrix).T))
    expected = expected / most_contrast
    relative = tiles.spectrum[..., 0] / expected
    scale, count = np.median(abs(relative)), len(relative)
    evidence = _evidence(np.log(abs(relative)) + 1j * np.angle(relative * np.conj(relative[:, 1:2])), count)
    findings: list[RippleFinding] = []
    while True:
        phases = evidence.reshape(count, 2, 3)[:, 1]
        table = explanations(tiles, phases[:, ::2] - phases[:, 1:2])
        fits = [robust_fit(evidence, np.repeat(tiles.weight, 6), _evidence(row.shapes, count).T) for row in table]
        changes = [np.tensordot(fit.value, row.shapes, 1) for fit, row in zip(fits, table, strict=True)]
        leaks = least_crosstalk(expected.mean(axis=0) * np.exp(changes[-1][0]), scale / most_contrast)
        if leaks is None:  # no matrix makes this change
            table, fits = table[:-1], fits[:-1]
        penalty = [2 * (len(row.shapes) + row.chosen) * np.log(count) for row in table]
        possible, confidence = decide([fit.squares for fit in fits], count, penalty)
        best, causes = possible[0], dict.fromkeys(cause for k in possible for cause in table[k].causes)
        explained = _evidence(changes[best], count)
        strong = np.argsort(np.linalg.norm(explained.reshape(count, 6), axis=1))[int(0.95 * count)]
        wave = scale * ideal(matrix) * np.exp(np.broadcast_to(changes[best], (count, 3))[strong])
        ripple_rad = ripple_by_harmonic(waves_of_spectrum(wave[:, None]), matrix)
        # What was chosen for being large has twice the noise.
        least = 2 * limit if table[best].chosen else limit
        if not all(table[k].causes for k in possible) or max(ripple_rad.values()) < least:
            return findings
        size = " or ".join(table[k].words(fits[k].value) or str(leaks) for k in possible)
        findings.append(RippleFinding(tuple(causes), size, ripple_rad, confidence, table[best].advice))
        limit, evidence = max(limit, _LEAKAGE * max(ripple_rad.values())), evidence - explained


def least_crosstalk(seen: npt.NDArray[np.complex128], contrast: float) -> str | None:
    """Return the least crosstalk that makes fundamentals (3,) of a pattern of full contrast, None: none does.

    Ambient light shrinks all three alike, and a common phase turns them, both unknown.
    """
    turned = seen * np.exp(-1j * np.angle(seen @ np.exp(-1j * PHASES)))
    # No contrast is above the pattern's own: leaks that are negative even then, no light has made.
    if (1 + 2 * contrast * (turned[:, None] * np.exp(-1j * PHASES)).real).min() < -3 * _LEAST_LEAK:
        return None
    rows = "; ".join(" ".join(f"{abs(entry):.2f}" for entry in row) for row in smallest_leaks(turned))
    return f"at least [{rows}], rows' sums one"


def decide(squares: Sequence[float], count: float, penalty: Sequence[float]) -> tuple[list[int], float]:
    """Return which explanations fit as well as the best, the best first, and how surely the others do not.

    squares holds each one's sum of squares, penalty what its parameters cost.
    """
    chi = count * (np.array(squares) / min(squares) - 1) + np.array(penalty)
    chi -= chi.min()
    possible = [int(k) for k in np.argsort(chi) if chi[k] < DECISIVE]
    return possible, float(1 - 0.5 * np.exp(-np.min(chi[chi >= DECISIVE], initial=10) / 2))
