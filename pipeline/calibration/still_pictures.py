"""Still pictures in footage of a slide show: runs of frames that differ by no more than their noise.

A free-running camera sees every picture in several frames, mixes two pictures in the frames between them, and films
whatever comes before and after. Each frame is compared with the two before it, at two scales: steps of a fringe differ
in pixels only, and the darkest fields by less than a pixel's noise, in means only. Noise is measured from the footage
itself, for each grey level, as the light's own noise grows with it.
"""

from collections import deque
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import product

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.errors import CalibrationError, FootageError
from pipeline.footage.footage import Footage, StoredFrame
from pipeline.models import FloatArray, ImageArray
from tikernels import runtime
from tikernels.raw.development import develop
from tikernels.raw.linearization import WHITE_LEVELS

FloatImage = npt.NDArray[np.float32]

# Cells of a frame whose means are compared: of 640x480 px they have 0.02 of a pixel's noise.
_CELLS = (8, 6)
# About so many pixels of a plane are read for means, which are then as good as a small camera's; and a quarter of them
# is compared.
_READ_PX = 640 * 480
# Grey levels for which noise is measured separately, and the values that a frame must have of one to count for it.
_LEVELS, _MIN_VALUES = 16, 5
# Noise at least, of full scale: of a pixel what rounding to 8 bits makes, of a cell what codecs leave of it.
_LEAST_PIXEL_NOISE, _LEAST_CELL_NOISE = 0.4 / 255, 0.1 / 255
# At least this part of all neighbours see the same picture: a board may be carried about most of the time.
_STILL_PART = 0.1
# A frame belongs to a picture while it differs by less than so many times the noise; more if light flickers.
_THRESHOLDS = (3.0, 4.5, 7.0, 10.0)
# Frames of a still picture, at least. Two may also be mixed ones of pictures that differ little.
_SHORTEST = (2, 3)


@dataclass(frozen=True)
class Changes:
    """The good frames of footage, and what changes from frame to frame."""

    numbers: list[int]
    sizes: FloatArray  # (frames, 2) of what differs from one and from two frames before, over its noise; inf: no frame
    variance: FloatArray  # (scales, grey levels) of what noise makes differ
    bad: str | None = None  # why the first frame that cannot be used cannot


@dataclass(frozen=True)
class Still:
    """A run of frames that show the same."""

    first: int  # numbers of frames
    last: int
    middle: int
    light: FloatArray  # (cells, 3) RGB, of full scale


def read_frame(source: Footage, number: int) -> StoredFrame:
    """Return a frame as it was stored.

    Raises
    ------
    FootageError
        It cannot be read.
    """
    with closing(source.frames(number, number + 1)) as frames:
        stored = next(frames)
    if not isinstance(stored, StoredFrame):
        raise FootageError(f"{source.name}: frame {number}: {stored.reason}")
    return stored


def developed(stored: StoredFrame) -> ImageArray:
    """Return a frame as RGB whose full scale is its type's, (H, W, 3) uint8, uint16 or float32.

    Mosaics of all pictures are interpolated the same way, whatever their stripes: the white picture divides the others.
    """
    # RGB of a complete type is taken as it is; a few frames of other kinds are no work for a GPU.
    if stored.format.rgb_dtype != stored.format.dtype and not runtime.is_started():
        runtime.init("cpu")
    image: ImageArray = runtime.to_host(develop(stored.planes, stored.format))
    return image


def single_picture(source: Footage, number: int) -> Still:
    """Return a frame that is the only one of its picture."""
    return Still(number, number, number, _light(read_frame(source, number)))


def measure_changes(source: Footage) -> Changes:
    """Compare every frame with the two before; frames are read one by one, and not kept.

    Raises
    ------
    CalibrationError
        There is no good frame.
    """
    numbers: list[int] = []
    squares: list[FloatArray] = []
    bad: str | None = None
    seen: deque[list[FloatImage]] = deque(maxlen=2)
    for stored in source.frames():
        if isinstance(stored, StoredFrame):
            samples = _samples(stored)
            found = [_compare(other, samples) for other in reversed(seen)]
            nothing = np.zeros((len(samples), 2, _LEVELS))
            squares.append(np.stack([*found, nothing, nothing][:2]).astype(np.float32))
            numbers.append(stored.number)
            seen.append(samples)
        else:
            bad = bad or stored.reason
    if not numbers:
        raise CalibrationError(f"{source.name} holds no frame that can be read: copy it again")
    both = np.stack(squares)
    variance = _noise_variance(both[:, 0])
    return Changes(numbers, _times_noise(both, variance), variance, bad)


def find_stills(source: Footage, changes: Changes) -> list[list[Still]]:
    """Return the still pictures in order of time, by each of several thresholds and shortest runs."""
    rules = list(product(_THRESHOLDS, _SHORTEST))
    found: list[list[Still]] = [[] for _ in rules]
    latest: list[list[FloatImage]] = [[] for _ in rules]
    # The runs that each frame is the middle of: so the footage is read once for all rules.
    middles: dict[int, list[tuple[int, list[int]]]] = {}
    for rule, (threshold, shortest) in enumerate(rules):
        for run in _runs(changes, threshold):
            if len(run) >= shortest:
                middles.setdefault(run[len(run) // 2], []).append((rule, run))
    for stored in source.frames(min(middles, default=0), max(middles, default=-1) + 1):
        if not isinstance(stored, StoredFrame) or stored.number not in middles:
            continue
        samples, light = _samples(stored), _light(stored)
        for rule, run in middles[stored.number]:
            before, stills = latest[rule], found[rule]
            if before and _times_noise(_compare(before, samples), changes.variance) <= rules[rule][0]:
                # The same picture, after a few frames that something has disturbed.
                stills[-1] = replace(stills[-1], last=run[-1])
            else:
                stills.append(Still(run[0], run[-1], stored.number, light))
                latest[rule] = samples
    return found


def _runs(changes: Changes, threshold: float) -> list[list[int]]:
    """Return the numbers of frames that show the same as the ones before, run by run."""
    runs: list[list[int]] = [[]]
    for number, (to_last, to_one_before) in zip(changes.numbers, changes.sizes, strict=True):
        # Small steps must not add up, as by a frame between two dark pictures.
        if to_last > threshold or (len(runs[-1]) > 1 and to_one_before > threshold):
            runs.append([])
        runs[-1].append(number)
    return runs


def _light(stored: StoredFrame) -> FloatArray:
    """Return the means of a frame's cells, (cells, 3) RGB, of full scale."""
    image = developed(stored)
    return np.asarray(_cell_means(image) / WHITE_LEVELS[image.dtype.name], np.float64)


def _cell_means(plane: ImageArray) -> FloatImage:
    """Return the means of a plane's cells, (cells, channels)."""
    step = max(round(np.sqrt(plane.shape[0] * plane.shape[1] / _READ_PX)), 1)
    thin = np.asarray(plane[::step, ::step], np.float32)
    means = cv2.resize(thin, _CELLS, interpolation=cv2.INTER_AREA)
    return np.asarray(means.reshape(_CELLS[0] * _CELLS[1], -1), np.float32)


def _samples(stored: StoredFrame) -> list[FloatImage]:
    """Return pixels of all planes of a frame, and the means of cells of each channel, of full scale."""
    planes: list[ImageArray] = list(stored.planes)
    if stored.format.layout == "bayer":
        planes = [planes[0][row::2, column::2] for row in (0, 1) for column in (0, 1)]
    white = np.float32(stored.format.white_level)
    pixels = []
    for plane in planes:
        step = max(round(2 * np.sqrt(plane.shape[0] * plane.shape[1] / _READ_PX)), 1)
        pixels.append(np.asarray(plane[::step, ::step], np.float32).ravel() / white)
    return [np.concatenate(pixels), *(channel / white for plane in planes for channel in _cell_means(plane).T)]


def _compare(before: list[FloatImage], after: list[FloatImage]) -> FloatArray:
    """Return the sum of squared differences and their number, (scales, 2, grey levels), by the level before."""
    found = np.zeros((len(before), 2, _LEVELS))
    for scale, (old, new) in enumerate(zip(before, after, strict=True)):
        level = np.clip(old * _LEVELS, 0, _LEVELS - 1).astype(int)
        found[scale, 0] = np.bincount(level, (new - old) ** 2, _LEVELS)
        found[scale, 1] = np.bincount(level, minlength=_LEVELS)
    return found


def _noise_variance(squares: FloatArray) -> FloatArray:
    """Return the variance of what neighbours in a still picture differ by, (scales, grey levels)."""
    sums, counts = squares[:, :, 0], squares[:, :, 1]
    means = np.where(counts >= _MIN_VALUES, sums / np.maximum(counts, 1), np.nan)
    means[:, np.isnan(means).all(axis=0)] = 0.0
    least = np.full((means.shape[1], 1), _LEAST_CELL_NOISE)
    least[0] = _LEAST_PIXEL_NOISE
    return np.asarray(np.maximum(np.nanquantile(means, _STILL_PART, axis=0), 2 * least**2), np.float64)


def _times_noise(squares: FloatArray, variance: FloatArray) -> FloatArray:
    """Return the RMS of differences over that of the noise, (...), of the scale where it is greatest."""
    expected = (squares[..., 1, :] * variance).sum(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.sqrt(squares[..., 0, :].sum(axis=-1) / expected)
    return np.asarray(np.where(expected > 0, ratio, np.inf).max(axis=-1), np.float64)
