"""Find and undo repeated chroma: RGB that a library made of 4:2:0 or 4:2:2 by using each sample for two pixels.

OpenCV's and FFmpeg's fast conversions do so, which costs 0.26 rad and turns the direction of the phase. Nothing is
lost, so it can be undone: R - G and B - G are the same in every pair of neighbours, up to rounding, and change between
pairs. Luma is what is smooth across both steps, which shows its weights of red and blue, and with them the samples. Its
levels were whole ones, of 256 as in JPEG or of 220 as in video, which shows where the samples sat.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from tikernels import runtime
from tikernels.raw.chroma_upsampling import convert_chroma
from tikernels.raw.pixel_format import LUMA_WEIGHTS, Matrix, PixelFormat, Siting

# Lines of a frame that are looked at in each direction: 1 % of its pixels and 0.1 ms show it.
_LINES = 48
# Chroma is repeated where it changes this many times less, squared, in most pairs than between them; luma is not.
_CHANGES = 8.0
# Fewer pairs show nothing; and the mean squared change, levels of 8 bits, that rounding makes.
_FEWEST, _ROUNDING = 12, 1.0
# Of 256 levels a seventh is missing where luma had 220; noise leaves out a few.
_GAPS = 0.07

Levels = npt.NDArray[Any]
_Changes = npt.NDArray[np.float32]


@dataclass(frozen=True)
class RepeatedChroma:
    """Repetition of chroma in an RGB frame."""

    pixels: tuple[int, int]  # across and down, 1 or 2: for how many each sample is used
    origin: tuple[int, int]  # see `PixelFormat`
    matrix: Matrix
    siting: Siting

    def __str__(self) -> str:
        return {(2, 2): "2x2 pixels", (2, 1): "two pixels of a row", (1, 2): "two pixels of a column"}[self.pixels]


def find_repeated_chroma(image: Levels, white: float) -> RepeatedChroma | None:
    """Return how chroma is repeated in an RGB frame; None: it is not, or too little of it changes to show it.

    Parameters
    ----------
    image : (H, W, 3) array
        Encoded levels.
    white : float
        Full scale, levels.
    """
    height, width = image.shape[:2]
    across = _pairs(image[:: max(1, height // _LINES)].swapaxes(0, 1), white)
    down = _pairs(image[:, :: max(1, width // _LINES)], white)
    if across is None and down is None:
        return None
    pixels = (1 if across is None else 2, 1 if down is None else 2)
    origin = (0 if across is None else across[0], 0 if down is None else down[0])
    misfit = sum((found[1] for found in (across, down) if found is not None), np.zeros(len(LUMA_WEIGHTS)))
    matrix = list(LUMA_WEIGHTS)[int(np.argmin(misfit))]
    return RepeatedChroma(pixels, origin, matrix, _siting(image[:: max(1, height // _LINES)], white, matrix))


def undo_repeated_chroma(image: Levels, white: float, found: RepeatedChroma) -> Levels:
    """Return an RGB frame with chroma interpolated between its samples, as `convert_chroma` does; of the same type."""
    rgb = white * runtime.to_host(convert_chroma(*repeated_samples(image, white, found)))
    return (rgb if image.dtype.kind == "f" else np.rint(rgb)).astype(image.dtype)


def repeated_samples(
    image: Levels, white: float, found: RepeatedChroma
) -> tuple[tuple[npt.NDArray[np.uint16], ...], PixelFormat]:
    """Return the luma and the chroma samples, of 16 bits, of which an RGB frame was made, and how they are stored."""
    (across, down), (left, above) = found.pixels, found.origin
    format = PixelFormat(
        "yuv",
        16,
        subsampling=found.pixels,
        origin=found.origin,
        siting=found.siting,
        matrix=found.matrix,
        full_range=True,
    )
    height, width = image.shape[:2]
    planes = luma_and_chroma(image, white, found.matrix)
    rows, columns = format.plane_shapes(height, width)[1]
    # Each sample is the mean of its pixels that are there, or rather of those that no end of the scale has cut.
    size = (rows * down, columns * across)
    channels = cv2.split(image)
    uncut = (np.minimum.reduce(channels) > 0) & (np.maximum.reduce(channels) < white)
    uncut_weight = 1e-3 + uncut.astype(np.float32)

    def sums(plane: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        padded = np.zeros(size, np.float32)
        padded[above : above + height, left : left + width] = plane
        return np.asarray(sum(padded[y::down, x::across] for y in range(down) for x in range(across)))

    weights = sums(uncut_weight)
    parts = (planes[0], *(sums(uncut_weight * plane) / weights for plane in planes[1:]))
    return tuple(np.rint(np.clip(part, 0, format.white_level)).astype(np.uint16) for part in parts), format


def luma_and_chroma(image: Levels, white: float, matrix: Matrix) -> Sequence[npt.NDArray[np.float32]]:
    """Return Y, Cb and Cr of an RGB frame, (H, W) each, in full range of 16 bits."""
    red, blue = LUMA_WEIGHTS[matrix]
    luma = np.array([red, 1 - red - blue, blue])
    blue_chroma, red_chroma = (np.array([0, 0, 1]) - luma) / (1 - blue), (np.array([1, 0, 0]) - luma) / (1 - red)
    ycc = 65535 / white * np.array([luma, blue_chroma / 2, red_chroma / 2])
    return cv2.split(cv2.transform(image.astype(np.float32), np.column_stack([ycc, [0, 2**15, 2**15]])))


@np.errstate(invalid="ignore")  # of infinities, which are no levels
def _pairs(lines: Levels, white: float) -> tuple[int, npt.NDArray[np.float64]] | None:
    """Return where pairs begin along the first axis, 0 or 1, and how little each matrix fits; None: there are none."""
    if len(lines) < 2 * _FEWEST:
        return None
    levels = np.ascontiguousarray(np.moveaxis(lines, 2, 0), np.float32) * np.float32(255 / white)
    uncut = (levels.min(axis=0) > 0) & (levels.max(axis=0) < 254.99)  # full scale may be rounded
    levels[::2] -= levels[1]
    both = uncut[1:] & uncut[:-1]
    change = np.diff(levels, axis=1) * both
    red, green, blue = (change**2).sum(axis=2) / np.maximum(both.sum(axis=1), 1)
    chroma = red + blue
    for begin in (0, 1):
        within, between = slice(begin, len(chroma) - 1, 2), slice(begin + 1, None, 2)
        clear = chroma[between] > _CHANGES * _ROUNDING
        if np.count_nonzero(clear) < _FEWEST:
            continue
        in_pairs = chroma[within][: len(clear)][clear]
        # Where all of a picture is repeated its green does not change either.
        green_too = np.median(green[within][: len(clear)][clear]) <= np.median(in_pairs)
        if np.median(in_pairs / chroma[between][clear]) * _CHANGES < 1 and not green_too:
            return begin, _matrix_misfits(change, begin)
    return None


def _siting(lines: Levels, white: float, matrix: Matrix) -> Siting:
    """Return where samples sit by which levels luma has: every one of 256, as in JPEG, or not, as in video."""
    red, blue = LUMA_WEIGHTS[matrix]
    luma = lines.astype(np.float32) @ np.array([red, 1 - red - blue, blue], np.float32) * np.float32(255 / white)
    of_video, of_jpeg = (np.abs(np.exp(2j * np.pi / 255 * levels * luma).mean()) for levels in (219, 255))
    # Some libraries round luma before they add chroma: then it has gaps.
    counts = np.bincount(np.rint(luma).astype(np.intp).ravel(), minlength=256)
    gaps = 2 * counts[1:-1] < np.minimum(counts[:-2], counts[2:])
    with_gaps = np.count_nonzero(gaps) > _GAPS * np.count_nonzero(counts)
    return "left" if of_video > of_jpeg or with_gaps else "centre"


def _matrix_misfits(change: _Changes, begin: int) -> npt.NDArray[np.float64]:
    """Return for each matrix by how much luma's changes between pairs miss a cubic through those within pairs."""
    within, between = change[:, begin::2], change[:, begin + 1 :: 2]
    n = min(within.shape[1] - 3, between.shape[1] - 2)
    luma = within[1]
    expected = (9 * (luma[1 : n + 1] + luma[2 : n + 2]) - luma[:n] - luma[3 : n + 3]) / 16
    red, green, blue = between[:, 1 : n + 1]
    misfits = [green + of_red * red + of_blue * blue - expected for of_red, of_blue in LUMA_WEIGHTS.values()]
    return np.array([float((misfit**2).mean()) for misfit in misfits])
