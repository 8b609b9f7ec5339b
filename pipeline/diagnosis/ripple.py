"""Name why a surface measured from one colour photo is wavy.

Camera channel j of a tile of a few cycles is a mean, a fundamental and harmonics of the surface's own phase:

    I_j = DC_j (1 + Re sum_k q_jk exp(i k phi)),    q_j1 = contrast * exp(i d_j) where nothing is wrong.

Dividing by the mean takes reflectance, shading and gains away, so q shows what is wrong, and its change from tile to
tile shows why: a lens shifts a channel by pixels, so its phase goes with the local fringe frequency; a black level
weighs most where it is dark; motion moves the objects but not the wall; crosstalk is the same everywhere.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.diagnosis.channel_spectra import (
    CHANNELS,
    LEAST_RAD,
    MIN_TILES,
    KnownLight,
    RippleFinding,
    Tiles,
    clipping_ripple,
    expected_light,
    fit_tiles,
    mean_spectrum,
    ripple_by_harmonic,
    seen_ripple,
    smooth_phase,
    waves_of_spectrum,
)
from pipeline.diagnosis.ripple_causes import explain_fundamental, explain_harmonics
from pipeline.models import FloatArray, ImageArray
from tikernels.raw.linearization import Transfer, linear_values

#: Causes of bands.
BANDS = ("colours in turn and a rolling shutter", "a surface striped along the rows")
# Parts of a row that are compared: as many as leave each of them about 50 px of a small picture.
_PARTS = 10
# Steps are the picture's where they are known in this many of them.
_MIN_PARTS = 5
# A part of a row counts where it is lit by this share.
_MOSTLY = 0.8
# Nobody notices a smaller step: a camera's automatic white balance makes one of it from frame to frame.
_LEAST_STEP = 0.03
# The median of ten parts is off by a third of their scatter: at three times the scatter it is none of theirs.
_SCATTERS = 3.0
# Standard deviations of normal values that the median of their sizes is.
_SIGMAS_A_MEDIAN = 0.6745
# Rows, as a part of those that count, from which on they are bands. Surfaces have none of them (bust, ball, waves
# and painted planes, simulated), bands of 40 rows 0.6.
_LEAST_ROWS = 0.1
# How often means are taken of means.
_MEANS = 3
# The fewest cycles in a picture: the difference of two such means takes this many, and a few rows are left of it.
_MIN_CYCLES = _MEANS + 2
# Pixels that hold a phase, at least, about 70 x 70: fewer hold too few tiles.
_MIN_PIXELS = 5000
# A ripple below this part of one pixel's own noise is not what makes a surface wavy.
_NOISE_SHARE = 0.25
# Where a greater share of a channel's pixels is clipped, what is left of its wave shows nothing else.
_MAX_CLIPPED = 0.1


def find_bands(light: FloatArray, mask: npt.NDArray[np.bool_], period_px: float) -> RippleFinding | None:
    """Return bands of another colour balance along the rows, if there are any.

    Parameters
    ----------
    light : (H, W, 3)
        Linear.
    mask : (H, W) bool
        True where a phase was found.
    period_px : float
        Camera px per cycle: means over a whole one do not show the fringe.
    """
    side = max(1, round(period_px))
    if len(mask) < _MIN_CYCLES * side:
        return None
    ratios = _color_ratios(light, mask, side)
    steps = ratios[side:] - ratios[:-side]  # (rows, parts, 2)
    steps = steps[np.isfinite(steps).all(axis=2).sum(axis=1) >= _MIN_PARTS]
    if len(steps) < side:
        return None
    common = np.nanmedian(steps, axis=1)
    scatter = np.nanmedian(abs(steps - common[:, None]), axis=1) / _SIGMAS_A_MEDIAN
    banded = (abs(common) > np.maximum(_LEAST_STEP, _SCATTERS * scatter)).any(axis=1)
    if banded.mean() < _LEAST_ROWS:
        return None
    most = float(np.quantile(abs(common[banded]).max(axis=1), 0.95))
    return RippleFinding(
        BANDS,
        f"from rows to rows the colours' balance changes by up to {100 * np.expm1(most):.0f} %",
        {1: 0.0},  # a gain, which the balance undoes; what it does to the fringe's levels shows in the harmonics
        0.9,
        "take a global shutter, or expose for a whole number of the projector's colour cycles",
    )


def _color_ratios(light: FloatArray, mask: npt.NDArray[np.bool_], side: int) -> FloatArray:
    """Return the logarithms of red and blue over green, (rows, parts, 2), of means about every row; NaN: dark.

    The mean over `side` rows is taken three times: a fringe whose period is off by a seventh, as on a ball, keeps 0.002
    of its amplitude.
    """
    borders = np.linspace(0, mask.shape[1], _PARTS + 1).astype(int)
    shown = np.add.reduceat(mask, borders[:-1], axis=1, dtype=np.float64)[..., None]
    total = np.add.reduceat(light * mask[..., None], borders[:-1], axis=1)
    sums = np.concatenate([shown, total], axis=2)
    for _ in range(_MEANS):
        above = np.cumsum(np.concatenate([0 * sums[:1], sums]), axis=0)
        sums = above[side:] - above[:-side]
    means = sums[..., 1:]
    lit = (sums[..., 0] > _MOSTLY * side**_MEANS * np.diff(borders)) & (means.min(axis=2) > 0)
    means[~lit] = np.nan
    return np.asarray(np.log(means[..., ::2] / means[..., 1:2]))


@dataclass(frozen=True)
class Diagnosis:
    """Faults of a frame, the worst first."""

    findings: tuple[RippleFinding, ...]
    ripple_rad: dict[int, float]  # of all faults together, from the channels
    seen_rad: dict[int, float]  # by harmonic, in the phase that was handed in: what decoding has left of it
    limit_rad: float  # below this nothing is called a fault
    notes: tuple[str, ...] = ()


def diagnose(
    image: ImageArray,
    white_level: float,
    unwrapped_phase: npt.NDArray[np.float32],
    mask: npt.NDArray[np.bool_],
    known: KnownLight | None = None,
    transfer: Transfer = "linear",
    absolute: npt.NDArray[np.bool_] | None = None,
) -> Diagnosis:
    """Find out why a surface is wavy.

    Parameters
    ----------
    image : (H, W, 3) uint8, uint16 or float32
        Levels as they came, 0..white_level.
    white_level : float
        Full scale.
    unwrapped_phase : (H, W) float32
        rad, ripple and all; one order a surface.
    mask : (H, W) bool
        True where it holds.
    known : KnownLight, optional
        Light that the decoder undoes; None: nothing.
    transfer : {"linear", "srgb", "bt709"} or (N,) floats
        By which the decoder reads the levels.
    absolute : (H, W) bool, optional
        True where the orders are absolute, so that the code is known; None: nowhere.

    Returns
    -------
    Diagnosis
        No findings: fine. Where no surface is large and smooth enough, `limit_rad` is NaN.
    """
    signal = image.astype(np.float64) / white_level
    known = known or KnownLight()
    matrix = known.matrix
    clipped = (image >= white_level) | (image <= 0)
    # What is clipped is mostly not decoded.
    cut = image >= white_level
    spoilt = cut.any() and cut[mask | cut.any(axis=-1)].mean(axis=0).max() > _MAX_CLIPPED
    why = "too much is clipped to say anything: expose less" if spoilt else "too little smooth surface to say anything"
    nothing = Diagnosis((), {}, {}, np.nan, (why,))
    if np.count_nonzero(mask) < _MIN_PIXELS:
        return nothing
    # What the code does to a few cycles is known only where it is known which cycles they are.
    sure = np.zeros_like(mask) if absolute is None or known.code is None else mask & absolute
    coded = int(np.count_nonzero(sure)) >= _MIN_PIXELS
    phase, usable, period = smooth_phase(unwrapped_phase, sure if coded else mask)
    light, expected = linear_values(signal, transfer), expected_light(known, coded=coded)
    seen = fit_tiles(light, phase, usable, period, None, expected)
    if len(seen.mean) < MIN_TILES:
        return nothing
    seen_rad = seen_ripple(unwrapped_phase, phase, usable)
    limit = max(LEAST_RAD, _NOISE_SHARE * _pixel_noise(seen))
    bands = find_bands(light, mask, period)
    findings = [] if bands is None else [bands]
    tiles, keep = seen, None
    if clipped[usable].any():
        # The rest does without what lost its shape, and its neighbours: choosing pixels by their own value alone would
        # choose by their noise, and bend the fit.
        keep = ~np.stack([cv2.dilate(np.uint8(c), np.ones((3, 3))) > 0 for c in np.moveaxis(clipped, -1, 0)], -1)
        tiles = fit_tiles(light, phase, usable, period, keep, expected)
        lost = clipping_ripple(image >= white_level, image <= 0, usable, period, mean_spectrum(tiles), matrix)
        shares = clipped[usable].mean(axis=0)
        if max(lost.values()) > limit:
            findings.append(_clipping_finding(shares, lost))
        if shares.max() > _MAX_CLIPPED or len(tiles.mean) < MIN_TILES:
            return Diagnosis(tuple(findings), lost, seen_rad, limit, ("too much is clipped to say more",))

    other = other_transfer(transfer)
    found, tiles, fundamentals = explain_harmonics(
        tiles, matrix, limit, period, other,
        lambda: fit_tiles(linear_values(signal, other), phase, usable, period, keep, expected),
    )  # fmt: skip
    if bands is None:  # else levels that are cut short make harmonics of their own
        findings += found
    findings += explain_fundamental(tiles, fundamentals, matrix, limit)
    findings.sort(key=lambda finding: -max(finding.ripple_rad.values()))
    everything = ripple_by_harmonic(waves_of_spectrum(mean_spectrum(seen)), matrix)
    return Diagnosis(tuple(findings), everything, seen_rad, limit)


def _pixel_noise(tiles: Tiles) -> float:
    """Return the noise of one pixel's phase, rad."""
    noise = np.median(tiles.noise) / np.median(tiles.mean, axis=0)  # of the mean, by channel
    return float(np.sqrt(2 / 9 * np.sum(noise**2)) / np.median(abs(tiles.spectrum[..., 0])))


def _clipping_finding(shares: FloatArray, ripple_rad: dict[int, float]) -> RippleFinding:
    """Return the finding for the clipped share of each channel's pixels, (3,)."""
    share = ", ".join(f"{c} {100 * s:.1f} %" for c, s in zip(CHANNELS, shares, strict=True))
    advice = "expose less, or dim the projector"
    return RippleFinding(("clipping",), f"clipped pixels: {share}", ripple_rad, 0.99, advice)


def other_transfer(transfer: Transfer) -> str:
    """Return the transfer that levels may have instead of the one by which they are read."""
    return "srgb" if isinstance(transfer, str) and transfer == "linear" else "linear"
