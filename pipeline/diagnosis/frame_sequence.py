"""Faults that only a sequence of frames shows: a beat with the projector's colour cycle, and motion between its fields.

A projector with a colour wheel, or with sequential LEDs, shows red, green and blue one after another. If the exposure
is no whole number of its cycles, each frame catches another share of each colour, which beats from frame to frame: in
every part of the image alike, where an object that passes changes the colours of some parts only. And what moves is
in another place in each colour: the channels' phases differ by the speed times the time between two fields, which one
frame cannot distinguish from lateral colour. Lateral colour stays where it is, so the change of the one with the other,
tile by tile, is motion.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from pipeline.calibration.model import Geometry
from pipeline.diagnosis.channel_spectra import (
    LEAST_RAD,
    OVERLAP,
    PHASES,
    SIGMAS,
    RippleFinding,
    fit_tiles,
    ripple_by_harmonic,
    robust_fit,
    smooth_phase,
    tile_side,
    waves_of_spectrum,
)
from pipeline.models import FloatArray, ImageArray

#: Frames at least: fewer show nothing.
MIN_FRAMES = 12
# Tiles that stay in view, at least, to distinguish a beat or a motion from what passes.
_MIN_TILES = 8
# Pixels with a phase, at least, for a frame to show fringes.
_MIN_PIXELS = 1000
# A peak of a spectrum of noise exceeds its mean by this factor once in a thousand sequences.
_PEAK = 12.0
# A beat has one strength everywhere; its weaker quarter of tiles stays above this part of the median.
_EVEN = 0.5
# A beat of a smaller part of the colours is not worth a word.
_LEAST_BEAT = 0.01
# Speeds that vary by less, rad per frame, do not distinguish motion from lateral colour.
_LEAST_SPEED_RAD = 0.01
# Tiles of all frames together, at least, whose speed varies by more.
_MIN_MOVING = 20
# The object's depth where the axes of camera and projector do not meet, mm.
_USUAL_DEPTH_MM = 1000.0


@dataclass(frozen=True)
class SequenceDiagnosis:
    """Unwanted changes from frame to frame."""

    findings: tuple[RippleFinding, ...]
    notes: tuple[str, ...]  # what these frames cannot show, and why


def diagnose_sequence(
    images: Sequence[ImageArray],
    white_level: float,
    unwrapped_phases: Sequence[npt.NDArray[np.float32]],
    masks: Sequence[npt.NDArray[np.bool_]],
    geometry: Geometry | None = None,
    crosstalk_matrix: FloatArray | None = None,
) -> SequenceDiagnosis:
    """Find unwanted changes from frame to frame.

    Parameters
    ----------
    images : sequence of (H, W, 3)
        At least twelve frames one after another, at even intervals, linear light, levels.
    white_level : float
        Full scale.
    unwrapped_phases : sequence of (H, W) float32
        rad; any order a surface.
    masks : sequence of (H, W) bool
        True where they hold.
    geometry : Geometry, optional
        The rig; with it the depth bias is given in mm.
    crosstalk_matrix : (3, 3), optional
        camera = matrix @ projector; without it, leaks between neighbouring colours feign a tenth of the time more.

    Returns
    -------
    SequenceDiagnosis
        Neither findings nor notes: fine.
    """
    if len(images) < MIN_FRAMES:
        return SequenceDiagnosis((), (f"{len(images)} frames show nothing, at least {MIN_FRAMES} are needed",))
    lit = [mask & np.isfinite(phase) for mask, phase in zip(masks, unwrapped_phases, strict=True)]
    dark = [k for k, mask in enumerate(lit) if np.count_nonzero(mask) < _MIN_PIXELS]
    if dark:
        return SequenceDiagnosis((), (f"frame {dark[0]} shows no fringes: give frames in a row that all do",))
    matrix = np.eye(3) if crosstalk_matrix is None else crosstalk_matrix
    ratios, lags, speeds = _follow(images, white_level, unwrapped_phases, lit, matrix)
    notes, found = [], []
    steady = np.isfinite(ratios).all(axis=(0, 2))
    if np.count_nonzero(steady) < _MIN_TILES:
        notes.append("too little surface stays in view to show a beat of the colours")
    else:
        found.append(_beat(ratios[:, steady]))
    motion = _motion(lags, speeds, geometry)
    if isinstance(motion, str):
        notes.append(motion)
    else:
        found.append(motion)
    return SequenceDiagnosis(tuple(finding for finding in found if finding is not None), tuple(notes))


def _follow(
    images: Sequence[ImageArray],
    white_level: float,
    unwrapped_phases: Sequence[npt.NDArray[np.float32]],
    lit: Sequence[npt.NDArray[np.bool_]],
    matrix: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Follow the tiles of one grid from frame to frame; NaN where a tile holds no smooth surface.

    Returns, by frame and tile, the logarithms of red and blue over green, (F, T, 2); the phases of green and blue less
    red's, (F, T, 2) rad; and the speed, (F, T) rad per frame, up to half a cycle per frame.
    """
    unmix = np.linalg.inv(matrix / matrix.sum(axis=1, keepdims=True))
    phase, usable, period = smooth_phase(unwrapped_phases[0], lit[0])
    side = tile_side(period)
    grid = np.maximum(1 + (np.array(lit[0].shape) - side) // (side // OVERLAP), 0)
    ratios = np.full((len(images), *grid, 2), np.nan)
    lags, steps = ratios.copy(), np.full((len(images) + 1, *grid), np.nan)
    for k, image in enumerate(images):
        before, held = phase, usable
        phase, usable, _ = smooth_phase(unwrapped_phases[k], lit[k])
        tiles = fit_tiles(image.astype(np.float64) / white_level, phase, usable, period)
        if not len(tiles.mean):
            continue
        at = tuple(tiles.place.T)
        ratios[(k, *at)] = np.log(np.maximum(tiles.mean[:, ::2], 1e-6) / np.maximum(tiles.mean[:, 1:2], 1e-6))
        turned = tiles.spectrum[..., 0] @ unmix.T * np.exp(-1j * PHASES)
        lags[(k, *at)] = np.angle(turned[:, 1:] * np.conj(turned[:, :1]))
        # Modulo whole cycles: every frame's regions have orders of their own.
        change = np.where(usable & held, np.exp(1j * (phase - before)), 0)
        for place in tiles.place if k else ():
            top, left = place * (side // OVERLAP)
            moved = change[top : top + side, left : left + side].sum()
            if abs(moved) > side**2 / 2:
                steps[(k, *place)] = np.angle(moved)
    flat = (len(images), -1)
    speeds = np.array([(a + b) / 2 for a, b in pairwise(steps)])
    return ratios.reshape(*flat, 2), lags.reshape(*flat, 2), speeds.reshape(flat)


def _beat(ratios: FloatArray) -> RippleFinding | None:
    """Find a line in the spectra of the colours' ratios, (F, T, 2)."""
    count = len(ratios)
    frames, columns = np.arange(count), ratios.reshape(count, -1)
    drift = np.polynomial.polynomial.polyfit(frames, columns, 2)
    rest = (columns - np.polynomial.polynomial.polyval(frames, drift).T).reshape(ratios.shape)
    window = np.hanning(count)
    power = np.abs(np.fft.rfft(rest * window[:, None, None], axis=0)) ** 2  # (frequency, T, 2)
    typical = np.median(power.sum(axis=2), axis=1)[2:]
    peak = int(np.argmax(typical))
    # A line fills three bins of a Hann window's spectrum.
    others = np.delete(typical, np.arange(max(peak - 2, 0), min(peak + 3, len(typical))))
    line = power[peak + 1 : peak + 4].sum(axis=0).max(axis=1)
    weak, amplitude = 2 * np.sqrt(np.quantile(line, (0.25, 0.5)) / (count * (window**2).sum()))
    if (
        len(others) == 0
        or typical[peak] < _PEAK * np.mean(others)
        or amplitude < _LEAST_BEAT
        or weak < _EVEN * amplitude
    ):
        return None
    rate = (peak + 2) / count
    return RippleFinding(
        causes=("colour-cycle beat",),
        size=f"the colours beat by {amplitude:.1%}, {rate:.3f} times per frame",
        ripple_rad={1: 0.0},  # a gain, which the balance undoes
        confidence=0.95,
        advice="the balance undoes a gain, but levels that the projector makes of pulses are cut short, too: expose "
        "for a whole number of its colour cycles, or let it trigger the camera",
    )


def _motion(lags: FloatArray, speeds: FloatArray, geometry: Geometry | None) -> RippleFinding | str | None:
    """Compare the phase from colour to colour with the phase from frame to frame; a string: why that shows nothing."""
    known = np.isfinite(speeds) & np.isfinite(lags).all(axis=2)
    followed = known.sum(axis=0) >= MIN_FRAMES // 2
    if np.count_nonzero(followed) < _MIN_TILES:
        return "too little surface stays in view to distinguish motion between colour fields from lateral colour"
    known, lags, speeds = known[:, followed], lags[:, followed], speeds[:, followed]
    worst_speed = float(np.quantile(np.abs(speeds[known]), 0.99))
    # A difference between a tile's colours that is there at all times is lateral colour.
    seen = known.sum(axis=0)
    speed = speeds - np.where(known, speeds, 0).sum(axis=0) / seen
    lag = lags - np.where(known[..., None], lags, 0).sum(axis=0) / seen[:, None]
    speed, lag = speed[known], lag[known]
    if np.count_nonzero(np.abs(speed) > _LEAST_SPEED_RAD) < _MIN_MOVING:
        return (
            "nothing changes its speed, which alone distinguishes motion between colour fields from lateral colour: "
            "move the object to and fro"
        )
    fit = robust_fit(lag, np.ones(len(lag)), speed[:, None])
    green, blue = fit.value[0]
    bias = abs(green + blue) / 3 * worst_speed  # the decoded phase is that of the channels' mean time
    if np.all(np.abs(fit.value[0]) < SIGMAS * fit.error[0]) or bias < LEAST_RAD:
        return None
    text = f"{bias:.3f} rad"
    if geometry is not None:
        text += f" ({bias / geometry.rad_per_mm(geometry.working_distance_mm() or _USUAL_DEPTH_MM):.2f} mm)"
    lagging = np.exp(1j * (PHASES + worst_speed * np.array([0, green, blue])))
    surest = float(np.max(np.abs(fit.value[0]) / np.maximum(fit.error[0], 1e-12)))
    return RippleFinding(
        causes=("motion between colour fields",),
        size=f"green {green:+.3f} and blue {blue:+.3f} frames after red: up to {text} of bias from red's time",
        ripple_rad=ripple_by_harmonic(waves_of_spectrum(lagging[:, None]), np.eye(3)),
        confidence=min(0.99, 1 - float(np.exp(-surest / 5))),
        advice="show all colours at once, or a faster cycle; what is left when nothing moves is lateral colour",
    )
