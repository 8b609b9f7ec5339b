"""Causes of ripple: of harmonics in the channels, and of contrasts and phases that differ between them.

Projector response and camera transfer put the same harmonics into every channel, the response before reflectance,
ambient light and crosstalk, the transfer after them. So each is undone in turn: the right one leaves nothing but what
is known of the light. A Gaussian blur of lens, pixels and focus takes exp(-s (k**2 - 1)) off the known k-th harmonic
over the fundamental.

Contrasts and phases of the fundamentals differ by crosstalk, lenses, a black level, or motion.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pipeline.diagnosis.channel_spectra import (
    CHANNELS,
    DECISIVE,
    MIN_TILES,
    OVERLAP,
    PHASES,
    SIGMAS,
    RippleFinding,
    RobustFit,
    Tiles,
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
# A leak that comes out negative by up to this part of a channel's own is noise's.
_LEAST_LEAK = 0.05
# Lags up to a shift of a pixel at 12 px per cycle, in steps of 5 mrad: what a step leaves of a fundamental the leaks
# take up, and spoil harmonics by as much.
_MOST_LAG_RAD, _LAGS = 0.6, 241
# Contrast and phase leak into each other a little (curvature, second order): up to this share is not a second fault.
_LEAKAGE = 0.15
# The phase, rad, by which crosstalk may turn all channels alike is sought within this, in so fine steps (5 mrad) that
# none changes a leak by a hundredth.
_MAX_TURN_RAD, _TURNS = 0.3, 121


def own_harmonics(spectrum: npt.NDArray[np.complex128], weight: FloatArray, matrix: FloatArray) -> RobustFit:
    """Fit the harmonics (3, K - 1) of the unmixed channels, over their own fundamental and in its phase.

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


def explain_fundamental(
    tiles: Tiles, expected: npt.NDArray[np.complex128], matrix: FloatArray, limit: float
) -> list[RippleFinding]:
    """Name what makes the channels' contrasts or phases differ from the fundamentals (T, 3) that are expected."""
    most_contrast = np.median(abs(expected @ np.linalg.inv(matrix).T))
    expected = expected / most_contrast
    relative = tiles.spectrum[..., 0] / expected
    loss = -np.log(abs(relative))  # (T, 3) of contrast; what is common to the channels makes no ripple
    lag = np.angle(relative * np.conj(relative[:, 1:2]))[:, ::2]  # (T, 2) of R and B against G, rad
    losses = robust_fit(loss - loss.mean(axis=1, keepdims=True), tiles.weight)
    lags = robust_fit(lag, tiles.weight)
    mean_loss, mean_lag = losses.value[0], lags.value[0]
    scale = np.median(abs(relative))

    def ripple_of(change: Any) -> dict[int, float]:
        return ripple_by_harmonic(waves_of_spectrum((scale * ideal(matrix) * change)[:, None]), matrix)

    def ripple_of_lag(lags: Any) -> dict[int, float]:
        return ripple_of(np.exp(1j * np.array([lags[0], 0, lags[1]])))

    by_loss, by_lag = ripple_of(np.exp(-mean_loss)), ripple_of_lag(mean_lag)
    worst_loss, worst_lag = max(by_loss.values()), max(by_lag.values())
    lossy = worst_loss > max(limit, SIGMAS / 3 * losses.error.max(), _LEAKAGE * worst_lag)
    lagging = worst_lag > max(limit, SIGMAS / 2 * lags.error.max(), _LEAKAGE * worst_loss)
    if lossy and lagging:
        crosstalk = explain_both(scale / most_contrast, expected.mean(axis=0), mean_loss, mean_lag, ripple_of)
        if crosstalk:
            # It is the same everywhere, so that what is left in a part of the picture is something else.
            rest = lag - np.median(lag, axis=0)
            return [
                crosstalk,
                *explain_part(tiles, rest, max(limit, _LEAKAGE * max(worst_loss, worst_lag)), ripple_of_lag),
            ]
    findings = [explain_loss(tiles, loss, mean_loss, by_loss, limit)] if lossy else []
    if lagging:
        # Of more than the mean it is what changes over the picture that is to be explained.
        part = explain_part(tiles, lag - np.median(lag, axis=0), worst_lag, ripple_of_lag)
        if part:
            return findings + part
        return [*findings, explain_lag(tiles, lag, neighbours_median(lag, tiles.place), by_lag)]
    return findings + explain_part(tiles, lag, max(limit, _LEAKAGE * worst_loss), ripple_of_lag)


def explain_part(
    tiles: Tiles, lag: FloatArray, limit: float, ripple_of_lag: Callable[[Any], dict[int, float]]
) -> list[RippleFinding]:
    """Explain phases that are right in the mean: by motion in a part of the picture, or by lateral colour.

    A lens's lateral colour changes sign over the picture. The medians of neighbouring tiles show either.
    """
    local = neighbours_median(lag, tiles.place)
    strength = np.hypot(*local.T)
    size = ripple_of_lag(local[np.argsort(strength)[int(0.95 * len(strength))]])
    # What is chosen for being large has twice the noise.
    return [explain_lag(tiles, lag, local, size)] if max(size.values()) > 2 * limit else []


def explain_loss(
    tiles: Tiles, loss: FloatArray, mean_loss: FloatArray, size: dict[int, float], limit: float
) -> RippleFinding:
    """Explain contrasts alone: of one channel, by how it changes over the image, or of several channels."""
    others = np.array([[1, 2], [0, 2], [0, 1]])
    disagreement = abs(mean_loss[others[:, 0]] - mean_loss[others[:, 1]])
    channel = int(np.argmin(disagreement))
    two = others[channel]
    if disagreement[channel] > max(3 * limit, _LEAKAGE * np.ptp(mean_loss)):
        return explain_losses(tiles, loss, mean_loss, size)
    # 1 / contrast = mean / amplitude: what is added to the mean weighs most where the amplitude is small.
    excess = np.exp(loss[:, channel] - loss[:, two].mean(axis=1)) - 1
    true_mean = tiles.mean[:, channel] * np.exp(loss[:, two].mean(axis=1) - loss[:, channel])
    shapes = {
        "contrast": np.ones_like(excess),  # projector amplitude, projector defocus, even leak
        "offset": 1 / true_mean,  # black level; ambient light too where the surface's colour is the same everywhere
        "camera blur": tiles.frequency**2 / 2,  # 1 / exp(-sigma**2 f**2 / 2)
    }
    fits = {name: robust_fit(excess, tiles.weight, shape[:, None]) for name, shape in shapes.items()}
    possible, confidence = decide({name: fit.squares for name, fit in fits.items()}, len(excess) / OVERLAP**2)
    more = mean_loss[channel] < 0  # more contrast than the others have: then those two are blurred, as by demosaicing
    blurred = "".join(CHANNELS[j] for j in two) if more else CHANNELS[channel]
    causes, sizes = [], []
    if "contrast" in possible:
        causes += ["projector amplitude", "projector defocus"] + (
            [] if more else ["even crosstalk", "coloured ambient light"]
        )
        sizes.append(f"{CHANNELS[channel]}'s modulation {100 * (1 / (1 + fits['contrast'].value[0]) - 1):+.1f} %")
    if "camera blur" in possible:
        causes.append("camera defocus")
        sizes.append(f"{blurred} blurred by {np.sqrt(abs(fits['camera blur'].value[0])):.2f} px")
    if "offset" in possible:
        causes += [name for name in ("black level", "coloured ambient light") if name not in causes]
        sizes.append(f"{fits['offset'].value[0]:+.3f} of full scale added to {CHANNELS[channel]}")
    return RippleFinding(
        tuple(causes),
        " or ".join(sizes),
        size,
        confidence,
        "subtract a frame of black from the same projector; if the ripple stays, refocus or calibrate the crosstalk",
    )


def explain_losses(tiles: Tiles, loss: FloatArray, mean_loss: FloatArray, size: dict[int, float]) -> RippleFinding:
    """Explain contrasts of several channels: by a black level that they share, or each by itself."""
    inverse = np.exp(loss)  # of the contrast: 1 + black / mean where that alone is wrong
    true_mean = tiles.mean / inverse
    excess = inverse - inverse.mean(axis=1, keepdims=True)
    shape = 1 / true_mean - np.mean(1 / true_mean, axis=1, keepdims=True)
    level = robust_fit(excess.ravel(), np.repeat(tiles.weight, 3), shape.reshape(-1, 1))
    each = robust_fit(excess, tiles.weight)
    possible, confidence = decide({"level": level.squares, "each": each.squares}, 2 * len(excess) / OVERLAP**2)
    text = ", ".join(
        f"{c} {100 * (np.exp(-m) - 1):+.0f} %" for c, m in zip(CHANNELS, mean_loss - mean_loss.min(), strict=True)
    )
    causes, sizes = [], []
    if "level" in possible:
        causes += ["black level", "coloured ambient light"]
        sizes.append(f"{level.value[0]:+.3f} of full scale added to all channels")
    if "each" in possible:
        causes += ["projector amplitude", "projector defocus", "camera defocus", "even crosstalk"]
        sizes.append(f"contrasts against the best channel: {text}")
    return RippleFinding(
        tuple(causes),
        " or ".join(sizes),
        size,
        0.8 * confidence,
        "subtract a frame of black from the same projector; then calibrate the crosstalk with each colour alone",
    )


def explain_lag(tiles: Tiles, lag: FloatArray, local: FloatArray, size: dict[int, float]) -> RippleFinding:
    """Explain phases alone, by how they change over the image."""
    strength = np.hypot(*local.T)
    moving = strength > 0.5 * np.quantile(strength, 0.95)
    one, f = np.ones_like(tiles.frequency), tiles.frequency
    shapes = {
        "constant": one[:, None],  # the projector's lens; motion of everything
        "shift": f[:, None],  # the camera's lens
        "magnification": np.stack([f, f * tiles.across], axis=1),
        "part": np.where(moving, one, 0.0)[:, None],  # the rest stands still
    }
    fits = {name: robust_fit(lag, tiles.weight, shape) for name, shape in shapes.items()}
    # Two channels a parameter; which tiles move was chosen from the data, and costs as much as two parameters.
    parameters = {"constant": 1, "shift": 1, "magnification": 2, "part": 3}
    count = lag.size / OVERLAP**2
    penalty = {name: 2 * n * np.log(count) for name, n in parameters.items()}
    possible, confidence = decide({name: fit.squares for name, fit in fits.items()}, count, penalty)
    lags = np.median(lag[moving], axis=0)
    steady = abs(lags.sum()) < 0.2 * np.ptp(lags) and lags[0] * lags[1] < 0  # R to G as G to B: one speed
    possible = {name for name in possible if np.any(abs(fits[name].value) > SIGMAS * fits[name].error)}
    causes, sizes = [], []
    if possible & {"shift", "magnification"}:
        causes.append("lateral colour of the camera")
        if "shift" in possible:
            sizes.append("R {:+.2f} px, B {:+.2f} px of G".format(*-fits["shift"].value[0]))
        else:
            r, b = (-fits["magnification"].value.T @ [[1, 1], [tiles.across.min(), tiles.across.max()]]).tolist()
            sizes.append("R {:+.2f} to {:+.2f} px, B {:+.2f} to {:+.2f} px of G across the picture".format(*r, *b))
    if "constant" in possible:
        causes.append("lateral colour of the projector")
        sizes.append("R {:+.3f} rad, B {:+.3f} rad from G".format(*fits["constant"].value[0]))
    if steady or "part" in possible or not possible:
        causes.append("motion between colour fields")
        sizes.append(
            f"{np.ptp(lags) / 2:.3f} rad a field" + (" in a part of the picture" if possible <= {"part"} else "")
        )
    return RippleFinding(
        tuple(causes),
        " or ".join(sizes),
        size,
        confidence if possible else 0.5,
        "photograph the scene at rest: if it stays, calibrate the lateral colour; if not, show all colours at once",
    )


def explain_both(
    contrast: float,
    expected: npt.NDArray[np.complex128],
    loss: FloatArray,
    lag: FloatArray,
    ripple_of: Callable[[Any], dict[int, float]],
) -> RippleFinding | None:
    """Explain contrasts and phases together by crosstalk, if a matrix without negative entries can make them.

    A row of it, its sum one, puts a channel's fundamental into the triangle of exp(i d_k), its entries the barycentric
    coordinates. Ambient light shrinks all three towards the centre and a common phase turns them, both unknown: so
    the least crosstalk is found, at the largest scale at which all three are inside.
    """
    change = np.exp(-loss + 1j * np.array([lag[0], 0, lag[1]]))
    seen = expected * change
    corners = np.exp(1j * PHASES)
    solve = np.linalg.inv(np.stack([np.ones(3), corners.real, corners.imag]))
    best_scale, best = 0.0, np.eye(3)
    for turn in np.linspace(-_MAX_TURN_RAD, _MAX_TURN_RAD, _TURNS):
        turned = seen * np.exp(1j * turn)
        rise = (solve @ np.stack([np.zeros(3), turned.real, turned.imag])).T  # entries are 1/3 + scale * rise
        scale = np.min(-1 / 3 / np.minimum(rise, -1e-9))
        if scale > best_scale:
            best_scale, best = scale, 1 / 3 + scale * rise
    # No contrast is above the pattern's own: what lies outside even then, no leak can have made.
    if contrast > 1.02 * best_scale:
        return None
    rows = "; ".join(" ".join(f"{entry:.2f}" for entry in row) for row in best)
    return RippleFinding(
        ("crosstalk",),
        f"at least [{rows}], rows' sums one",
        ripple_of(change),
        0.9,
        "calibrate the crosstalk with three single-colour frames; 4:2:0 video looks like this too",
    )


def decide(squares: dict[str, float], count: float, penalty: dict[str, float] | None = None) -> tuple[set[str], float]:
    """Return the explanations that fit as well as the best, and how surely the rest do not.

    squares holds each one's sum of squares, penalty what its parameters cost.
    """
    best = min(squares.values())
    chi = {name: count * (value / best - 1) + (penalty[name] if penalty else 0.0) for name, value in squares.items()}
    least = min(chi.values())
    possible = {name for name, value in chi.items() if value < least + DECISIVE}
    beaten = [value - least for name, value in chi.items() if name not in possible]
    return possible, 0.99 if not beaten else float(1 - 0.5 * np.exp(-min(beaten) / 2))
