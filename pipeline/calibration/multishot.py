"""Projector coordinates of every camera pixel of a scene that holds still, from captures of twelve pictures.

Black and white, and of columns and of rows five each: three steps of a sinusoid, and two digits of the number of its
cycle, as levels of grey. White and black make light a share of white, s, whatever the surface. Of three steps

    z = 2/3 sum of s_k exp(2 pi i k / 3) = c_1 exp(i phi) + c_2 exp(-2 i phi),

with c_n the harmonics of the projector's response: on average |z|^2 is c_1^2 + c_2^2 and z^3 is 3 c_1^2 c_2, which
determines both, and then phi. The mean of the steps gives the response's gamma, from which the digits' levels follow.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import gamma as gamma_function

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.calibration.captures import PictureSequence, full_scale
from pipeline.errors import CalibrationError
from pipeline.models import FloatArray, ImageArray

WHITE, BLACK = "00-white", "01-black"
#: The sinusoids' period, projector px.
FINE_PX = 16.0
_STEPS, _DIGITS = 3, 2
_AXES = ("column", "row")
# Digits' codes are spaced evenly in light if the projector's gamma is this.
_USUAL_GAMMA = 2.0
# Gammas of the projector and the camera together that are tried.
_GAMMAS = np.linspace(0.6, 4.0, 341)
# Turns of three iterations to a fixed point, which four reach.
_TURNS = 8
# Where something has moved since white and black were taken, shares of white are many times what they are elsewhere.
_MOST_SIZE = 1.5
# A pixel counts where the fringe's amplitude is at least this part of that of the best pixels.
_MIN_AMPLITUDE = 0.25
# And where it exceeds three times this, of 255 levels: it then stands out of rounding.
_MIN_LEVELS = 4.0
# The least first harmonic, as a share of white; in focus it is .4 to .5.
_MIN_CONTRAST = 0.08
# A cycle's number changes half a cycle from where the phase is 0: to this part of a cycle its digits are not blurred.
_SURE = 0.25
# A digit further than this part of the way to the next one's level is none.
_UNSURE = 0.4
# Greater shares of pixels between digits, or beyond the picture, and of cycles whose numbers do not follow each other
# are refused: in captures in order, of a scene that stands still, noise and depth steps make but a few per cent so.
_MAX_UNSURE, _MAX_TORN = 0.1, 0.3
# The rims of squares, half of this wide in px, are left out: what moves by half a pixel tears them.
_RIM_PX = 5
# The mean of the steps, as a share of white, is the same everywhere to this in three quarters of the pixels.
_MAX_UNEVEN = 0.06


@dataclass(frozen=True)
class ProjectorMap:
    """Projector coordinates of the light that every camera pixel sees."""

    position_px: FloatArray  # (H, W, 2) column, row; NaN where unknown
    channel_shift_px: FloatArray  # (3, H, W, 2) how R, G and B alone differ from their sum
    white: FloatArray  # (H, W, 3) the capture of all white, 0..1


def multishot_sequence(size_px: tuple[int, int]) -> PictureSequence:
    """Return the pictures from which every pixel's projector column and row are found."""
    names = [WHITE, BLACK]
    for axis in _AXES:
        for kind, count in (("digit", _DIGITS), ("fringe", _STEPS)):
            names += [f"{len(names) + k:02d}-{axis}-{kind}-{k}" for k in range(count)]
    return PictureSequence(kind="geometry", size_px=size_px, names=tuple(names))


def fringe_groups() -> list[list[str]]:
    """Return the names of the fringes that differ in their step only, group by group in the order of projection."""
    return [_names(axis, "fringe") for axis in _AXES]


def _names(axis: str, kind: str) -> list[str]:
    return [name for name in multishot_sequence((1, 1)).names if f"-{axis}-{kind}-" in name]


def multishot_codes(name: str, size_px: tuple[int, int]) -> FloatArray:
    """Return the (height, width, 3) projector codes, 0..1, of a picture of the sequence."""
    width, height = size_px
    if name in (WHITE, BLACK):
        return np.full((height, width, 3), float(name == WHITE))
    _, axis, kind, number = name.split("-")
    pixels = np.arange(width)[None] if axis == "column" else np.arange(height)[:, None]
    if kind == "fringe":
        cycles = pixels / FINE_PX + _begin(axis, size_px)
        codes = 0.5 + 0.5 * np.cos(2 * np.pi * (cycles - int(number) / _STEPS))
    else:
        levels = _levels(pixels.size)
        high, low = np.divmod(np.floor(pixels / FINE_PX + 0.5).astype(int), levels)
        # Every other row of numbers runs back, so that neighbours differ by one level of one digit.
        digit = high if number == "0" else np.where(high % 2 == 0, low, levels - 1 - low)
        codes = (digit / (levels - 1)) ** (1 / _USUAL_GAMMA)
    return np.asarray(np.broadcast_to(codes[..., None], (height, width, 3)))


def _begin(axis: str, size_px: tuple[int, int]) -> float:
    """Return after which part of a cycle the fringes begin: pictures read with another size contradict their digits.

    Of 26 sizes that projectors have, 640x360 to 4096x2160, no two begin within a third of a cycle of each other along
    both axes, unless their digits differ in their levels.
    """
    width, height = size_px[0] - 1024, size_px[1] - 768
    return width / 16 + height / 9 if axis == "column" else width / 9 + height / 16


def _levels(length: int) -> int:
    """Return how many levels the digits of the cycles of so many projector px have."""
    return int(np.ceil(np.sqrt(np.floor((length - 1) / FINE_PX + 0.5) + 1)))


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
        Name for messages.
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
        seen = f"only {np.count_nonzero(known)} px see the fringes"
        raise CalibrationError(f"{where}: {seen}: look whether every capture shows its picture, sharp, on the board")
    position[~known], shift[:, ~known] = np.nan, np.nan
    return ProjectorMap(position, shift, white.astype(np.float64) / full)


def _decode_axis(
    captures: Mapping[str, ImageArray], axis: str, size_px: tuple[int, int], full: float, where: str
) -> tuple[FloatArray, FloatArray]:
    """Return the coordinate along one axis, (H, W) px, and what each channel adds to it, (3, H, W)."""
    length = size_px[0 if axis == "column" else 1]
    black = captures[BLACK].astype(np.float64)
    fringes, digits = ([captures[name] - black for name in _names(axis, kind)] for kind in ("fringe", "digit"))
    by_channel = np.maximum(captures[WHITE] - black, 1e-3 * full)
    white = by_channel.sum(axis=-1)
    shares = [fringe.sum(axis=-1) / white for fringe in fringes]
    seen = _vector(shares)
    amplitude = np.abs(seen) * white / full
    best = float(np.percentile(amplitude, 99))
    if best < _MIN_CONTRAST * np.percentile(white, 99) / full:
        raise CalibrationError(
            f"{where}: the fringes have at most {best * full / np.percentile(white, 99):.0%} of white's light: focus "
            "camera and projector on the board, and keep the order of the sequence"
        )
    valid = amplitude > max(_MIN_AMPLITUDE * best, 3 * _MIN_LEVELS / 255)
    if not valid.any():
        return np.full(valid.shape, np.nan), np.zeros((3, *valid.shape))
    turned = _first_harmonic(seen, valid)
    part = np.mod(np.angle(turned) / (2 * np.pi) - _begin(axis, size_px), 1.0)
    mean = np.asarray(sum(shares) / _STEPS)
    number, unsure = _cycle_numbers([digit.sum(axis=-1) / white for digit in digits], mean, part, valid, length)
    place = (number + part) * FINE_PX
    outside = (place < -1) | (place > length)
    if (
        np.count_nonzero((unsure | outside) & valid) > _MAX_UNSURE * np.count_nonzero(valid)
        or np.percentile(np.abs(mean - np.median(mean[valid]))[valid], 75) > _MAX_UNEVEN
        or _torn(place, part, valid) > _MAX_TORN
    ):
        given = "{}x{} is not the projector's size".format(*size_px)
        if place.shape[::-1] == tuple(size_px):
            given += " but the camera's: camera and projector are swapped"
        raise CalibrationError(
            f"{where}: the {axis} fringes contradict each other: captures are in the wrong order, something moved, or "
            + given
        )
    place[~valid | unsure | outside] = np.nan
    alone = [_vector([fringe[..., i] / by_channel[..., i] for fringe in fringes]) for i in range(3)]
    shift = [np.angle(_first_harmonic(channel, valid) * np.conj(turned)) * FINE_PX / (2 * np.pi) for channel in alone]
    return place, np.stack(shift)


def _vector(steps: list[FloatArray]) -> npt.NDArray[np.complex128]:
    """Return amplitude times exp(i phase) of a sinusoid's steps."""
    turned = sum(step * np.exp(2j * np.pi * k / _STEPS) for k, step in enumerate(steps))
    return np.asarray(turned, np.complex128) * (2 / _STEPS)


def _first_harmonic(seen: npt.NDArray[np.complex128], valid: npt.NDArray[np.bool_]) -> npt.NDArray[np.complex128]:
    """Return exp(i phi) from `_vector`, in which the response's second harmonic is; see the module."""
    size = np.abs(seen)
    usual = valid & (size < _MOST_SIZE * np.median(size[valid]))
    unit = seen / np.sqrt(np.mean(size[usual] ** 2))
    # Of a mean |z|^2 of 1 follows c_1^2 = 1 - c_2^2.
    skew = float(np.mean(unit[usual] ** 3).real) / 3
    second = skew
    for _ in range(_TURNS):
        second = skew / max(1 - second**2, 0.5)
    turned = unit / np.maximum(np.abs(unit), 1e-9)
    for _ in range(_TURNS):
        turned = unit - second * np.conj(turned) ** 2
        turned = turned / np.maximum(np.abs(turned), 1e-9)
    return np.asarray(turned)


def _cycle_numbers(
    light: list[FloatArray], mean: FloatArray, part: FloatArray, valid: npt.NDArray[np.bool_], length: int
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Return the number of every pixel's cycle, (H, W), and where it is doubtful.

    Parameters
    ----------
    light : list of (H, W)
        The digits, the higher one first, as shares of white.
    mean : (H, W)
        Of the steps, as a share of white.
    part : (H, W)
        Of the cycle, 0 to 1.
    valid : (H, W) bool
        Pixels that count.
    length : int
        The projector's, px.
    """
    levels = _levels(length)
    # Of light = code^gamma a sinusoid's mean is Gamma(gamma + 1/2) / (sqrt(pi) Gamma(gamma + 1)).
    means = [gamma_function(gamma + 0.5) / (np.sqrt(np.pi) * gamma_function(gamma + 1)) for gamma in _GAMMAS]
    gamma = float(np.interp(-np.median(mean[valid]), -np.array(means), _GAMMAS))
    expected = (np.arange(levels) / (levels - 1)) ** (gamma / _USUAL_GAMMA)
    sure = valid & (np.abs(part - 0.5) > 0.5 - _SURE)
    expected = _seen_levels(np.concatenate([share[sure] for share in light]), expected)
    unsure = np.zeros(valid.shape, bool)
    digits = []
    for share in light:
        digit = np.searchsorted((expected[1:] + expected[:-1]) / 2, share)
        to_next = np.gradient(expected)[digit]
        unsure |= sure & (np.abs(share - expected[digit]) > _UNSURE * to_next)
        digits.append(digit)
    high, low = digits
    number = high * levels + np.where(high % 2 == 0, low, levels - 1 - low)
    number = np.where(part > 0.5, number - 1, number)
    # Pixels whose digits are blurred continue from the nearest that are not.
    sure &= ~unsure
    if not sure.any():
        return number.astype(np.float64), valid
    _, nearest = cv2.distanceTransformWithLabels(
        (~sure).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    place = np.zeros(nearest.max() + 1)
    place[nearest[sure]] = (number + part)[sure]
    return np.rint(place[nearest] - part), unsure


def _seen_levels(shares: FloatArray, expected: FloatArray) -> FloatArray:
    """Return the digits' levels as they are seen: stray light and the camera's curve move them a little."""
    for _ in range(_TURNS):
        digit = np.searchsorted((expected[1:] + expected[:-1]) / 2, shares)
        there = np.unique(digit)
        off = [float(np.median(shares[digit == number])) - expected[number] for number in there]
        expected = expected + np.interp(np.arange(len(expected)), there, off)
    return expected


def _torn(place: FloatArray, part: FloatArray, valid: npt.NDArray[np.bool_]) -> float:
    """Return how often the place leaps where the phase continues, for every cycle that neighbouring pixels pass."""
    inside = cv2.erode(valid.astype(np.uint8), np.ones((_RIM_PX, _RIM_PX))) > 0
    leaps, cycles = 0.0, 1.0
    for axis in (0, 1):
        both = np.minimum(*(np.delete(inside, end, axis) for end in (0, -1)))
        step = np.diff(part, axis=axis)[both]
        step -= np.rint(step)
        leaps += float(np.count_nonzero(np.abs(np.diff(place, axis=axis)[both] / FINE_PX - step) > 0.5))
        cycles += float(np.abs(step).sum())
    return leaps / cycles
