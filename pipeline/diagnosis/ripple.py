"""Name why a surface measured from one colour photo is wavy.

Camera channel j of a tile of a few cycles is a mean, a fundamental and harmonics of the surface's own phase:

    I_j = DC_j (1 + Re sum_k q_jk exp(i k phi)),    q_j1 = contrast * exp(i d_j) where nothing is wrong.

Dividing by the mean takes reflectance, shading and gains away, so q says what is wrong, and its change from tile to
tile says why: a lens shifts a channel by pixels, so its phase goes with the local fringe frequency; a black level
weighs most where it is dark; motion moves the objects but not the wall; crosstalk is the same everywhere.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.diagnosis.channel_spectra import (
    OVERLAP,
    PHASES,
    RobustFit,
    Tiles,
    channel_waves,
    clipping_ripple,
    fit_tiles,
    mean_spectrum,
    neighbours_median,
    ripple_by_harmonic,
    robust_fit,
    seen_ripple,
    smooth_phase,
)
from pipeline.models import FloatArray, ImageArray
from tikernels.raw.linearization import Transfer, linear_values

_Complexes = npt.NDArray[np.complex128]
_Bools = npt.NDArray[np.bool_]

_CHANNELS = "RGB"
_MIN_TILES, _MIN_PIXELS = 20, 5000
# A ripple below a quarter of one pixel's own noise is not what makes a surface wavy, and one below 3 mrad (0.02 mm on a
# rig with 0.14 rad a mm) nobody sees; and a fault must stand out of its own error.
_NOISE_SHARE, _LEAST_RIPPLE_RAD, _SIGMAS = 0.25, 0.003, 5.0
# Chi square by which one explanation beats another: three standard deviations.
_DECISIVE = 9.0
# Contrast and phase leak into each other a little (curvature, second order): up to this share is not a second fault.
_LEAKAGE = 0.15
# Where more of a channel's pixels are clipped, what is left of its wave tells nothing else.
_MAX_CLIPPED = 0.1


@dataclass(frozen=True)
class RippleFinding:
    """One thing that is wrong, or the smallest set of things that this frame cannot tell apart."""

    causes: tuple[str, ...]
    size: str  # in the fault's own unit
    ripple_rad: dict[int, float]  # by harmonic of the phase: what it does to a balanced, plain arctangent
    confidence: float  # 0..1 that the cause is one of `causes`
    advice: str


@dataclass(frozen=True)
class Diagnosis:
    """What is wrong with a frame, the worst first."""

    findings: tuple[RippleFinding, ...]
    ripple_rad: dict[int, float]  # of all faults together, from the channels
    seen_rad: dict[int, float]  # by harmonic, in the phase that was handed in: what decoding has left of it
    limit_rad: float  # below this nothing is called a fault
    notes: tuple[str, ...] = ()


def diagnose(
    image: ImageArray,
    white_level: float,
    unwrapped_phase: npt.NDArray[np.float32],
    mask: _Bools,
    crosstalk_matrix: FloatArray | None = None,
    transfer: Transfer = "linear",
    response: FloatArray | None = None,
    projector_lag_rad: FloatArray | None = None,
) -> Diagnosis:
    """Say why a surface is wavy.

    Parameters
    ----------
    image : (H, W, 3) uint8, uint16 or float32
        Levels as they came, 0..white_level.
    white_level : float
        Full scale.
    unwrapped_phase : (H, W) float32
        rad, ripple and all; one order a surface.
    mask : (H, W) bool
        Where it holds.
    crosstalk_matrix : (3, 3), optional
        What the decoder undoes; None: nothing.
    transfer : {"linear", "srgb", "bt709"} or (N,) floats
        What the decoder takes the levels for.
    response : (3, N), optional
        Light of the projector's codes, 0..1, which the decoder undoes; None: nothing, or the pattern has undone it.
    projector_lag_rad : (3,), optional
        By how much the projector's lateral colour delays R, G and B, which the decoder undoes.

    Returns
    -------
    Diagnosis
        No findings: fine. Where no surface is large and smooth enough, `limit_rad` is NaN.
    """
    signal = image.astype(np.float64) / white_level
    matrix = np.eye(3) if crosstalk_matrix is None else np.asarray(crosstalk_matrix, np.float64)
    matrix = matrix / matrix.sum(axis=1, keepdims=True)  # balanced channels are grey whatever the rows' sums
    clipped = (image >= white_level) | (image <= 0)
    spoilt = mask.any() and clipped[mask].mean(axis=0).max() > _MAX_CLIPPED
    why = "too much is clipped to say anything: expose less" if spoilt else "too little smooth surface to say anything"
    nothing = Diagnosis((), {}, {}, np.nan, (why,))
    if np.count_nonzero(mask) < _MIN_PIXELS:
        return nothing
    phase, usable, period = smooth_phase(unwrapped_phase, mask)
    light = linear_values(signal, transfer)
    seen = fit_tiles(light, phase, usable, period)
    if len(seen.mean) < _MIN_TILES:
        return nothing
    noise = np.median(seen.noise) / np.median(seen.mean, axis=0)  # of the mean, by channel
    pixel_noise = np.sqrt(2 / 9 * np.sum(noise**2)) / np.median(abs(seen.spectrum[..., 0]))  # rad
    limit = max(_LEAST_RIPPLE_RAD, _NOISE_SHARE * pixel_noise)

    findings, tiles, keep = [], seen, None
    if clipped[usable].any():
        # The rest of the diagnosis does without what lost its shape. Neighbours go too: choosing pixels by their own
        # value alone would choose by their noise, and bend the fit.
        keep = ~np.stack([cv2.dilate(np.uint8(c), np.ones((3, 3))) > 0 for c in np.moveaxis(clipped, -1, 0)], -1)
        tiles = fit_tiles(light, phase, usable, period, keep)
        lost = clipping_ripple(image >= white_level, image <= 0, usable, period, mean_spectrum(tiles), matrix)
        if max(lost.values()) > limit:
            share = ", ".join(
                f"{c} {100 * s:.1f} %" for c, s in zip(_CHANNELS, clipped[usable].mean(axis=0), strict=True)
            )
            advice = "expose less, or dim the projector"
            findings.append(RippleFinding(("clipping",), f"clipped pixels: {share}", lost, 0.99, advice))
        if clipped[usable].mean(axis=0).max() > _MAX_CLIPPED or len(tiles.mean) < _MIN_TILES:
            seen_rad = seen_ripple(unwrapped_phase, phase, usable)
            return Diagnosis(tuple(findings), lost, seen_rad, float(limit), ("too much is clipped to say more",))

    other = other_transfer(transfer)

    def read_otherwise() -> Tiles:
        return fit_tiles(linear_values(signal, other), phase, usable, period, keep)

    found, tiles, contrast = explain_harmonics(tiles, matrix, limit, other, read_otherwise, response)
    lag = np.zeros(3) if projector_lag_rad is None else projector_lag_rad
    findings += found + explain_fundamental(tiles, contrast, matrix, limit, lag)
    findings.sort(key=lambda finding: -max(finding.ripple_rad.values()))
    color = np.median(tiles.mean, axis=0)
    note = "channels' means R : G : B = " + " : ".join(f"{v / color[1]:.2f}" for v in color)
    note += ": surface colour, light or white balance; harmless, the balance undoes it"
    everything = ripple_by_harmonic(channel_waves(mean_spectrum(seen)), matrix)
    return Diagnosis(tuple(findings), everything, seen_ripple(unwrapped_phase, phase, usable), float(limit), (note,))


def other_transfer(transfer: Transfer) -> str:
    """Return what levels that were taken for this may be instead."""
    return "srgb" if isinstance(transfer, str) and transfer == "linear" else "linear"


def ideal(matrix: FloatArray, contrast: Any = 1.0) -> _Complexes:
    """Return the (3,) fundamentals that the camera sees of a pattern whose channels have this contrast."""
    return np.asarray(matrix @ (contrast * np.exp(1j * PHASES)))


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

    Both put the same harmonics into every channel, the response before reflectance, ambient light and crosstalk, the
    transfer after them. So undo each in turn: the right one leaves nothing. Returns the findings, the tiles without
    a wrong transfer, and how the response has changed each channel's contrast.
    """
    fit = own_harmonics(tiles, matrix)
    own, floor, power = fit.value[0], np.sum(fit.error**2), np.sum(abs(fit.value) ** 2)
    contrast = np.median(abs(tiles.spectrum[..., 0]))
    turns = np.arange(1, own.shape[1] + 2)

    def size_of(harmonics: _Complexes) -> dict[int, float]:
        pure = np.hstack([np.ones((3, 1)), harmonics]) * contrast * np.exp(1j * turns * PHASES[:, None])
        return ripple_by_harmonic(channel_waves(matrix @ pure), matrix)

    size = size_of(own)
    # Harmonics that the decoder undoes are no fault, and neither are none: what is known need not be in the pattern.
    undone = [(np.zeros(own.shape), np.ones(3))]
    if response is not None:
        undone.append(response_harmonics(response, own.shape[1] + 1))
    for known, change in undone:
        unknown = np.sum(abs(own - known) ** 2)
        if max(size_of(own - known).values()) < limit or unknown < _SIGMAS**2 * floor / own.size:
            return [], tiles, change
    # ((1 + cos) / 2)**gamma has c_(k+1) / c_k = (gamma - k) / (gamma + k + 1), and 2 c_1 / c_0 = 2 gamma / (gamma + 1).
    second = np.clip(own[:, 0].real, -0.45, 0.8)
    gamma = (1 + 2 * second) / (1 - second)
    predicted = np.cumprod((gamma[:, None] - turns[:-1]) / (gamma[:, None] + turns[:-1] + 1), axis=1)
    otherwise = read_otherwise()
    left = {"response": np.sum(abs(own - predicted) ** 2)}
    if len(otherwise.mean) >= _MIN_TILES:
        left["transfer"] = np.sum(abs(own_harmonics(otherwise, matrix).value) ** 2)
    best = min(left.values())
    explained = 1 - best / power
    if explained < 0.7:
        advice = "look at the camera's picture profile (contrast, sharpening) and at interreflections"
        found = RippleFinding(("unknown harmonics",), "neither a power law nor a transfer", size, 0.5, advice)
        return [found], tiles, np.ones(3)
    words = {
        "response": (
            f"projector gamma R {gamma[0]:.2f}, G {gamma[1]:.2f}, B {gamma[2]:.2f}",
            "calibrate the response, or equalise",
        ),
        "transfer": (
            f"levels that look {'sRGB-coded' if other == 'srgb' else 'linear already'}",
            f"decode with transfer={other!r}",
        ),
    }
    causes = tuple(name for name, value in left.items() if value < 4 * best + _DECISIVE * floor)
    sizes, advice = (" or ".join(words[cause][i] for cause in causes) for i in (0, 1))
    finding = RippleFinding(causes, sizes, size, float(min(explained, 0.99)), advice)
    if causes == ("transfer",):
        return [finding], otherwise, np.ones(3)
    return [finding], tiles, 2 * gamma / (gamma + 1)


def explain_fundamental(
    tiles: Tiles, response_contrast: FloatArray, matrix: FloatArray, limit: float, lag_rad: FloatArray
) -> list[RippleFinding]:
    """Name what makes the channels' contrasts differ, or their phases, from what is known of the rig."""
    expected = ideal(matrix, response_contrast / response_contrast.mean() * np.exp(-1j * lag_rad))
    relative = tiles.spectrum[..., 0] / expected
    loss = -np.log(abs(relative))  # (T, 3) of contrast; what is common to the channels makes no ripple
    lag = np.angle(relative * np.conj(relative[:, 1:2]))[:, ::2]  # (T, 2) of R and B against G, rad
    losses = robust_fit(loss - loss.mean(axis=1, keepdims=True), tiles.weight)
    lags = robust_fit(lag, tiles.weight)
    mean_loss, mean_lag = losses.value[0], lags.value[0]
    # Motion may be in a part of the picture only, and a lens's lateral colour changes sign over it: the medians of
    # neighbouring tiles show it where the mean does not.
    local = neighbours_median(lag, tiles.place)
    strength = np.hypot(*local.T)
    most = local[np.argsort(strength)[int(0.95 * len(strength))]]
    scale = np.median(abs(relative))

    def ripple_of(change: Any) -> dict[int, float]:
        return ripple_by_harmonic(channel_waves((scale * ideal(matrix) * change)[:, None]), matrix)

    def ripple_of_lag(lags: Any) -> dict[int, float]:
        return ripple_of(np.exp(1j * np.array([lags[0], 0, lags[1]])))

    by_loss, by_lag = ripple_of(np.exp(-mean_loss)), ripple_of_lag(mean_lag)
    worst_loss, worst_lag = max(by_loss.values()), max(by_lag.values())
    lossy = worst_loss > max(limit, _SIGMAS / 3 * losses.error.max(), _LEAKAGE * worst_lag)
    lagging = worst_lag > max(limit, _SIGMAS / 2 * lags.error.max(), _LEAKAGE * worst_loss)
    if lossy and lagging:
        crosstalk = explain_both(scale / response_contrast.mean(), expected, mean_loss, mean_lag, ripple_of)
        if crosstalk:
            return [crosstalk]
    by_most = ripple_of_lag(most)
    if not lagging and max(by_most.values()) > max(2 * limit, 2 * _LEAKAGE * worst_loss):
        by_lag, lagging = by_most, True
    findings = [explain_loss(tiles, loss, mean_loss, by_loss, limit)] if lossy else []
    return findings + ([explain_lag(tiles, lag, local, by_lag)] if lagging else [])


def explain_loss(
    tiles: Tiles, loss: FloatArray, mean_loss: FloatArray, size: dict[int, float], limit: float
) -> RippleFinding:
    """Contrast alone: one channel's, by its way over the picture, or several channels'."""
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
    blurred = "".join(_CHANNELS[j] for j in two) if more else _CHANNELS[channel]
    causes, sizes = [], []
    if "contrast" in possible:
        causes += ["projector amplitude", "projector defocus"] + (
            [] if more else ["even crosstalk", "coloured ambient light"]
        )
        sizes.append(f"{_CHANNELS[channel]}'s modulation {100 * (1 / (1 + fits['contrast'].value[0]) - 1):+.1f} %")
    if "camera blur" in possible:
        causes.append("camera defocus")
        sizes.append(f"{blurred} blurred by {np.sqrt(abs(fits['camera blur'].value[0])):.2f} px")
    if "offset" in possible:
        causes += [name for name in ("black level", "coloured ambient light") if name not in causes]
        sizes.append(f"{fits['offset'].value[0]:+.3f} of full scale added to {_CHANNELS[channel]}")
    return RippleFinding(
        tuple(causes),
        " or ".join(sizes),
        size,
        confidence,
        "subtract a frame of black from the same projector; if the ripple stays, refocus or calibrate the crosstalk",
    )


def explain_losses(tiles: Tiles, loss: FloatArray, mean_loss: FloatArray, size: dict[int, float]) -> RippleFinding:
    """Contrast of more than one channel: a black level that all of them share, or several contrasts."""
    inverse = np.exp(loss)  # of the contrast: 1 + black / mean where that alone is wrong
    true_mean = tiles.mean / inverse
    excess = inverse - inverse.mean(axis=1, keepdims=True)
    shape = 1 / true_mean - np.mean(1 / true_mean, axis=1, keepdims=True)
    level = robust_fit(excess.ravel(), np.repeat(tiles.weight, 3), shape.reshape(-1, 1))
    each = robust_fit(excess, tiles.weight)
    possible, confidence = decide({"level": level.squares, "each": each.squares}, 2 * len(excess) / OVERLAP**2)
    text = ", ".join(
        f"{c} {100 * (np.exp(-m) - 1):+.0f} %" for c, m in zip(_CHANNELS, mean_loss - mean_loss.min(), strict=True)
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
    """Phase alone: by its way over the picture."""
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
    possible = {name for name in possible if np.any(abs(fits[name].value) > _SIGMAS * fits[name].error)}
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
    expected: _Complexes,
    loss: FloatArray,
    lag: FloatArray,
    ripple_of: Callable[[Any], dict[int, float]],
) -> RippleFinding | None:
    """Contrast and phase: crosstalk, if a matrix without negative entries can do it.

    A row of it, its sum one, puts a channel's fundamental into the triangle of exp(i d_k), its entries the barycentric
    coordinates. Ambient light shrinks all three towards the centre and a common phase turns them, both unknown: taken
    is the least crosstalk, the largest scale at which all three are inside.
    """
    change = np.exp(-loss + 1j * np.array([lag[0], 0, lag[1]]))
    seen = expected * change
    corners = np.exp(1j * PHASES)
    solve = np.linalg.inv(np.stack([np.ones(3), corners.real, corners.imag]))
    best_scale, best = 0.0, np.eye(3)
    for turn in np.linspace(-0.3, 0.3, 121):
        turned = seen * np.exp(1j * turn)
        rise = (solve @ np.stack([np.zeros(3), turned.real, turned.imag])).T  # entries are 1/3 + scale * rise
        scale = np.min(-1 / 3 / np.minimum(rise, -1e-9))
        if scale > best_scale:
            best_scale, best = scale, 1 / 3 + scale * rise
    # A pattern's contrast is at most one: what lies outside even then, no leak can have made.
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
    possible = {name for name, value in chi.items() if value < least + _DECISIVE}
    beaten = [value - least for name, value in chi.items() if name not in possible]
    return possible, 0.99 if not beaten else float(1 - 0.5 * np.exp(-min(beaten) / 2))
