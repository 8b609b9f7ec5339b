"""Projector coordinates of every camera pixel of a scene that holds still, from captures of many pictures.

Sinusoids along columns and rows, each at three periods: the coarsest spans the projector, and every finer one is
unwrapped by the one before. Six steps at the finest cancel the harmonics of the projector's response up to the fourth,
and four elsewhere are enough to choose the right cycle.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.calibration.captures import PictureSequence, full_scale
from pipeline.errors import CalibrationError
from pipeline.models import FloatArray, ImageArray

WHITE, BLACK = "00-white", "01-black"
#: The finest period, projector px.
FINE_PX = 16.0
# Between a period and the next finer one: the coarser phase need only be known to a sixteenth of a cycle.
_RATIO = 8
_STEPS = {"coarse": 4, "middle": 4, "fine": 6}
_AXES = ("column", "row")
# A pixel counts where the fine fringe's amplitude is at least this part of that of the best pixels.
_MIN_AMPLITUDE = 0.25
# And where it exceeds three times this, of 255 levels: it then stands out of rounding.
_MIN_LEVELS = 4.0
# Between two periods the phases may disagree by this part of a cycle before the choice of the cycle becomes unsafe.
_UNSURE = 0.3
# A greater share of pixels with an unsafe cycle is refused: in captures in order, of a scene that stands still, noise
# and depth steps make but a few per cent of the pixels so.
_MAX_UNSURE = 0.1
# What captures out of order add to the fine fringes, over their amplitude, beyond which they are refused.
_MAX_UNEVEN = 0.12


@dataclass(frozen=True)
class ProjectorMap:
    """Projector coordinates of the light that every camera pixel sees."""

    position_px: FloatArray  # (H, W, 2) column, row; NaN where unknown
    channel_shift_px: FloatArray  # (3, H, W, 2) what R, G and B alone say more than their sum
    white: FloatArray  # (H, W, 3) the capture of all white, 0..1


def multishot_sequence(size_px: tuple[int, int]) -> PictureSequence:
    """Return the pictures from which every pixel's projector column and row are found."""
    names = [WHITE, BLACK]
    for axis in _AXES:
        for level, steps in _STEPS.items():
            names += [f"{len(names) + step:02d}-{axis}-{level}-{step}" for step in range(steps)]
    return PictureSequence(kind="geometry", size_px=size_px, names=tuple(names))


def fringe_groups() -> list[list[str]]:
    """Return the names of the fringes that differ in their step only, group by group in the order of projection."""
    names = multishot_sequence((1, 1)).names
    return [[name for name in names if f"-{axis}-{level}-" in name] for axis in _AXES for level in _STEPS]


def multishot_codes(name: str, size_px: tuple[int, int]) -> FloatArray:
    """Return the (height, width, 3) projector codes, 0..1, of a picture of the sequence."""
    width, height = size_px
    if name in (WHITE, BLACK):
        return np.full((height, width, 3), float(name == WHITE))
    _, axis, level, step = name.split("-")
    pixels = np.arange(width)[None] if axis == "column" else np.arange(height)[:, None]
    angle = 2 * np.pi * (pixels / _period(level, axis, size_px) - int(step) / _STEPS[level])
    return np.asarray(np.broadcast_to((0.5 + 0.5 * np.cos(angle))[..., None], (height, width, 3)))


def decode_multishot(
    captures: Mapping[str, ImageArray],
    size_px: tuple[int, int],
    where: str = "captures",
    white_level: float | None = None,
) -> ProjectorMap:
    """Find every pixel's projector column and row.

    Parameters
    ----------
    captures : mapping from name to (H, W, 3) uint8, uint16 or float32
        The captures of `multishot_sequence`, of a scene that held still, in linear light or nearly so.
    size_px : (width, height)
        The projector's.
    where : str
        What errors call these captures.
    white_level : float, optional
        Full scale; None: the type's.

    Raises
    ------
    CalibrationError
        The captures are out of order, saturated, or show no fringes.
    """
    white, black = captures[WHITE], captures[BLACK]
    full = full_scale(white, white_level)
    lit = (white.astype(np.float64) - black) / full
    if np.median(lit) < -0.01 or np.percentile(lit, 99) < 0.04:
        raise CalibrationError(
            f"{where}: {WHITE} is hardly brighter than {BLACK}: keep the order of the sequence, and expose longer (or "
            "give the white level, where 16-bit files hold fewer bits)"
        )
    if (white >= 0.99 * full).any(axis=-1).mean() > 0.02:
        raise CalibrationError(f"{where}: {WHITE} is over-exposed: expose shorter")
    position = np.full((*white.shape[:2], 2), np.nan)
    shift = np.full((3, *white.shape[:2], 2), np.nan)
    for k, axis in enumerate(_AXES):
        position[..., k], shift[..., k] = _decode_axis(captures, axis, size_px, full, where)
    known = ~np.isnan(position).any(axis=-1)
    if np.count_nonzero(known) < 1000:
        raise CalibrationError(f"{where}: hardly a pixel sees the fringes: focus, and point the projector at the board")
    position[~known], shift[:, ~known] = np.nan, np.nan
    return ProjectorMap(position, shift, white.astype(np.float64) / full)


def _period(level: str, axis: str, size_px: tuple[int, int]) -> float:
    """Return a level's period in px.

    The coarsest spans the projector, so that every place has a phase of its own; and only just, so that read with
    another projector's size the periods contradict each other.
    """
    length = size_px[0 if axis == "column" else 1]
    if level == "fine":
        return FINE_PX
    if level == "middle":
        return FINE_PX * _RATIO
    return max(FINE_PX * _RATIO, 1.02 * length)


def _decode_axis(
    captures: Mapping[str, ImageArray], axis: str, size_px: tuple[int, int], full: float, where: str
) -> tuple[FloatArray, FloatArray]:
    """Return the coordinate along one axis, (H, W) px, and what each channel adds to it, (3, H, W)."""
    length = size_px[0 if axis == "column" else 1]
    vectors = {level: _phase_vector(captures, axis, level, full) for level in _STEPS}
    fine = vectors["fine"].sum(axis=-1)
    amplitude = np.abs(fine)
    valid = amplitude > max(_MIN_AMPLITUDE * float(np.percentile(amplitude, 99)), 3 * _MIN_LEVELS / 255)
    coarse = np.abs(vectors["coarse"].sum(axis=-1))
    if np.percentile(amplitude, 99) < 0.2 * np.percentile(coarse, 99):
        raise CalibrationError(f"{where}: the fine fringes are washed out: focus camera and projector on the board")
    # Half a period of room before the first pixel, so that noise there does not turn the coarse phase round.
    period = _period("coarse", axis, size_px)
    place = np.mod(np.angle(vectors["coarse"].sum(axis=-1)) / (2 * np.pi), 1.0) * period
    place = np.where(place > length + 0.25 * (period - length), place - period, place)
    unsure = np.zeros(place.shape, np.bool_)
    for level in ("middle", "fine"):
        period = _period(level, axis, size_px)
        part = np.angle(vectors[level].sum(axis=-1)) / (2 * np.pi)
        cycles = np.rint(place / period - part)
        unsure |= np.abs(place / period - part - cycles) > _UNSURE
        place = (cycles + part) * period
    outside = (place < -1) | (place > length)
    if np.count_nonzero((unsure | outside) & valid) > _MAX_UNSURE * np.count_nonzero(valid) or (
        valid.any() and _unevenness(captures, axis, full, fine, valid) > _MAX_UNEVEN
    ):
        given = "{}x{} is not the projector's size".format(*size_px)
        if place.shape[::-1] == tuple(size_px):
            given += " but the camera's: camera and projector are swapped"
        raise CalibrationError(
            f"{where}: the {axis} fringes contradict each other: captures are in the wrong order, something moved, or "
            + given
        )
    place[~valid | unsure | outside] = np.nan
    with np.errstate(invalid="ignore", divide="ignore"):
        alone = np.angle(vectors["fine"] * np.conj(fine / amplitude)[..., None]) * FINE_PX / (2 * np.pi)
    return place, np.moveaxis(alone, -1, 0)


def _unevenness(
    captures: Mapping[str, ImageArray],
    axis: str,
    full: float,
    fine: npt.NDArray[np.complex128],
    valid: npt.NDArray[np.bool_],
) -> float:
    """Return what captures out of order add to the fine fringes, over their amplitude.

    In order, the second harmonic is the response's and in phase with the first (up to a twentieth of it, which a fourth
    adds), and the third is a thirtieth of the first at most. Two steps of one parity that change places
    leave the third as it is, two of different parity neither. The result is what a quarter of the pixels exceed, as a
    black picture in place of one step bends only those that are bright there.
    """
    amplitude = np.maximum(np.abs(fine), 1e-9)
    second, third = (_phase_vector(captures, axis, "fine", full, harmonic).sum(axis=-1) for harmonic in (2, 3))
    across = np.abs((second * np.conj(fine / amplitude) ** 2).imag)
    return max(float(np.percentile((part / amplitude)[valid], 75)) for part in (across, np.abs(third) / 2))


def _phase_vector(
    captures: Mapping[str, ImageArray], axis: str, level: str, full: float, harmonic: int = 1
) -> npt.NDArray[np.complex128]:
    """Return amplitude times exp(i phase) of each channel, (H, W, 3); or of a harmonic."""
    steps = _STEPS[level]
    names = [name for name in multishot_sequence((1, 1)).names if f"-{axis}-{level}-" in name]
    total = sum(captures[name] * np.exp(2j * np.pi * harmonic * step / steps) for step, name in enumerate(names))
    return np.asarray(total, np.complex128) * (2 / steps / full)
