"""Letters in pictures, smooth at any size."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

#: RGB of letters and lines.
INK = (236, 238, 241)
# Where it may be drawn over anything, letters stand on a panel: its RGB, and how much of it covers what is below.
_PANEL, _COVER = np.array([24, 27, 32], np.float32), 0.55


def text_size(text: str, size_px: float) -> tuple[int, int]:
    """Return width and height of a text, px, whose letters are `size_px` high from line to line."""
    return _drawn(text, round(size_px * 64)).shape[::-1]


def write_text(image: npt.NDArray[np.uint8], text: str, place: tuple[float, float], size_px: float) -> None:
    """Write a text into an image, in place; what lies outside the image is left out.

    Parameters
    ----------
    image : (H, W, 3) uint8
        RGB.
    text : str
        One line.
    place : (float, float)
        x of its left edge and y of its middle, px.
    size_px : float
        Size of the letters, px.
    """
    cover = _drawn(text, round(size_px * 64))
    left, top = round(place[0]), round(place[1] - cover.shape[0] / 2)
    rows = slice(max(top, 0), min(top + cover.shape[0], image.shape[0]))
    columns = slice(max(left, 0), min(left + cover.shape[1], image.shape[1]))
    if rows.start >= rows.stop or columns.start >= columns.stop:
        return
    part = cover[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left, None] / 255
    image[rows, columns] = (image[rows, columns] * (1 - part) + part * INK).round().astype(np.uint8)


def darken(image: npt.NDArray[np.uint8], left: float, top: float, right: float, bottom: float) -> None:
    """Lay a dark, half clear panel over a part of an image, in place, on which letters can be read."""
    part = np.s_[max(round(top), 0) : max(round(bottom), 0), max(round(left), 0) : max(round(right), 0)]
    image[part] = ((1 - _COVER) * image[part] + _COVER * _PANEL).astype(np.uint8)


@cache
def _font() -> Any:
    import matplotlib  # slow to import
    from matplotlib.ft2font import FT2Font

    return FT2Font(str(Path(matplotlib.get_data_path(), "fonts", "ttf", "DejaVuSans.ttf")))


# Films write the same words again and again.
@cache
def _glyph(letter: str, size_64: int) -> tuple[npt.NDArray[np.uint8], int, int, int]:
    """Return a letter's cover, by how many px it is moved right and up from the pen, and how far the pen goes on."""
    font = _font()
    font.set_size(size_64 / 64, 72)
    font.clear()
    glyph = font.load_char(ord(letter))
    font.set_text(letter, 0.0)
    font.draw_glyphs_to_bitmap(antialiased=True)
    cover = np.array(font.get_image(), np.uint8)
    left, _, _, top = (round(value / 64) for value in glyph.bbox)
    return cover, left, top, round(glyph.linearHoriAdvance / 65536)


@cache
def _drawn(text: str, size_64: int) -> npt.NDArray[np.uint8]:
    """Return how much of each pixel a line of text covers, (H, W), its baseline at the same row for all texts."""
    size = size_64 / 64
    glyphs = [_glyph(letter, size_64) for letter in text]
    height, baseline = round(1.2 * size), round(0.95 * size)
    cover = np.zeros((height, max(1, sum(glyph[3] for glyph in glyphs) + 2)), np.uint8)
    pen = 0
    for image, left, up, onward in glyphs:
        top, x = baseline - up, max(pen + left, 0)
        rows = slice(max(top, 0), min(top + image.shape[0], height))
        columns = slice(x, min(x + image.shape[1], cover.shape[1]))
        if image.size and rows.start < rows.stop and columns.start < columns.stop:
            part = image[rows.start - top : rows.stop - top, : columns.stop - x]
            cover[rows, columns] = np.maximum(cover[rows, columns], part)
        pen += onward
    return cover
