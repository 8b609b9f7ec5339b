"""Overlays of a picture: letters, the bar that explains its colours, the scale bar, the frame's number."""

from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt

#: RGB of letters and lines.
INK = (236, 238, 241)
# Where it may be drawn over anything, letters stand on a panel: its RGB, and how much of it covers what is below.
_PANEL, _COVER = np.array([24, 27, 32], np.float32), 0.55

#: Colour maps, by OpenCV's names.
Colormap = Literal["turbo", "viridis", "cividis", "magma", "inferno", "plasma"]

# From below zero to above it, blue through grey to red (Moreland's cool and warm), as RGB.
_DIVERGING = np.array([[59, 76, 192], [141, 176, 254], [221, 221, 221], [244, 154, 123], [180, 4, 38]], np.float32)
# Ticks of a bar, at most.
_TICKS = 6
# Of what is shown on each side that may lie outside the limits, percent.
_OUTSIDE = 1.0
# By which part of their range values may lie outside the limits before they are far outside, and the grey of those.
_BEYOND, _GREY = 0.1, 120

# Parts of the picture's height.
_EDGE, _LETTERS, _BAR = 0.03, 0.026, 0.62
# Longest scale bar, as a part of the picture's width.
_LONGEST = 0.22
# Smaller ones have no room for letters.
_LEAST_HEIGHT = 200


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
def _font_file() -> str:
    """Return matplotlib's font, without importing matplotlib, which takes 0.2 s; a dependency is found."""
    (folder,) = find_spec("matplotlib").submodule_search_locations  # type: ignore[union-attr, misc]
    return str(Path(folder, "mpl-data", "fonts", "ttf", "DejaVuSans.ttf"))


# Films write the same words again and again.
@cache
def _drawn(text: str, size_64: int) -> npt.NDArray[np.uint8]:
    """Return how much of each pixel a line of text covers, (H, W), its baseline at the same row for all texts."""
    from PIL import Image, ImageDraw, ImageFont  # only needed here

    size = size_64 / 64
    font = ImageFont.truetype(_font_file(), size, layout_engine=ImageFont.Layout.BASIC)
    cover = Image.new("L", (round(font.getlength(text)) + 2, round(1.2 * size)))
    ImageDraw.Draw(cover).text((0, round(0.95 * size)), text, fill=255, font=font, anchor="ls")
    return np.asarray(cover)


@dataclass(frozen=True)
class ColorScale:
    """A colour map with its limits.

    Parameters
    ----------
    low, high : float
        What is blue, and what is red.
    name : str
        What the values are; printed over the bar.
    unit : str
        In what.
    diverging : bool
        Whether zero lies in the middle, in grey.
    colormap : str, optional
        Which colours; left out, turbo, or blue through grey to red where zero is in the middle.
    grey_beyond : bool
        Whether what lies far outside the limits, as a wall behind the object does, has no colour but grey.
    """

    low: float
    high: float
    name: str
    unit: str
    diverging: bool = False
    grey_beyond: bool = False
    colormap: Colormap | None = None

    @classmethod
    def over(
        cls,
        values: npt.NDArray[np.floating],
        name: str,
        unit: str,
        *,
        diverging: bool = False,
        from_zero: bool = False,
        grey_beyond: bool = False,
    ) -> "ColorScale":
        """Return the scale from the 1st to the 99th percentile; about zero, or from it."""
        values = values[np.isfinite(values)]
        low, high = np.percentile(values, (_OUTSIDE, 100 - _OUTSIDE)).tolist() if len(values) else (0.0, 1.0)
        if diverging:
            high = max(abs(low), abs(high), 1e-6)
            low = -high
        elif from_zero:
            low = 0.0
        return cls(low, max(high, low + 1e-6 * max(abs(low), 1.0)), name, unit, diverging, grey_beyond)

    def colors(self, values: npt.NDArray[np.floating]) -> npt.NDArray[np.uint8]:
        """Return the RGB of each value, (..., 3); those outside the limits have the limit's."""
        fractions = ((values - self.low) / (self.high - self.low)).clip(0, 1)
        if self.diverging and self.colormap is None:
            table, numbers = _diverging_map(), 255 * fractions
        elif self.colormap in (None, "turbo"):  # the map's ends are too dark to distinguish
            table, numbers = _color_map("turbo"), 20 + 215 * fractions
        else:
            table, numbers = _color_map(self.colormap), 255 * fractions
        colors = np.take(table, numbers.round().astype(np.uint8), axis=0)
        if self.grey_beyond:
            reach = _BEYOND * (self.high - self.low)
            colors[(values < self.low - reach) | (values > self.high + reach)] = _GREY
        return colors

    def ticks(self) -> list[tuple[float, str]]:
        """Return round values between the limits, and how they are written."""
        step = round_step((self.high - self.low) / _TICKS)
        decimals = max(0, -int(np.floor(np.log10(step))))
        values = np.arange(np.ceil(self.low / step), np.floor(self.high / step) + 1) * step
        sign = "+" if self.diverging else ""
        return [(float(v), f"{v + 0.0:{sign if abs(v) > step / 2 else ''}.{decimals}f}") for v in values]


def round_step(step: float) -> float:
    """Return the least of 1, 2 and 5 times a power of ten that is at least `step`.

    >>> round_step(0.03), round_step(7)
    (0.05, 10.0)
    """
    power: float = 10.0 ** np.floor(np.log10(step))
    return next(factor * power for factor in (1, 2, 5, 10) if factor * power >= step * (1 - 1e-9))


def draw_color_bar(image: npt.NDArray[np.uint8], scale: ColorScale, place: tuple[float, float], height: float) -> None:
    """Draw a colour bar with its ticks into an image, in place.

    Parameters
    ----------
    image : (H, W, 3) uint8
        RGB.
    scale : ColorScale
        What it shows.
    place : (float, float)
        x and y of its upper left corner, px, its title included.
    height : float
        px, its title included.
    """
    size = letter_size(height)
    left, top, bottom = round(place[0]), round(place[1] + 2.2 * size), round(place[1] + height - size / 2)
    width, line = round(1.1 * size), max(1, round(size / 12))
    write_text(image, _title(scale), (left, place[1] + 0.7 * size), size)
    levels = np.linspace(scale.high, scale.low, max(bottom - top, 2))
    colors = scale.colors(levels)[:, None]
    bar = image[top:bottom, left : left + width]
    bar[:] = colors[: bar.shape[0]]
    for value, text in scale.ticks():
        y = bottom - 1 - (value - scale.low) / (scale.high - scale.low) * (bottom - 1 - top)
        row = round(y - (line - 1) / 2)
        image[max(row, top) : row + line, left + width : left + width + round(0.35 * size)] = INK
        write_text(image, text, (left + width + 0.6 * size, y), size)


def color_bar_width(scale: ColorScale, height: float) -> int:
    """Return how many px of width a bar of some height takes, its letters included."""
    size = letter_size(height)
    numbers = max(text_size(text, size)[0] for _, text in [*scale.ticks(), (0.0, "0")])
    return max(round(1.7 * size) + numbers, text_size(_title(scale), size)[0])


def letter_size(height: float) -> float:
    """Return the size of the letters of a bar of some height, px."""
    return max(height / 26, 11.0)


def _title(scale: ColorScale) -> str:
    return f"{scale.name}, {scale.unit}" if scale.name and scale.unit else scale.name or scale.unit


@cache
def _diverging_map() -> npt.NDArray[np.uint8]:
    at = np.linspace(0, len(_DIVERGING) - 1, 256)
    channels = [np.interp(at, np.arange(len(_DIVERGING)), channel) for channel in _DIVERGING.T]
    return np.stack(channels, axis=1).round().astype(np.uint8)


@cache
def _color_map(name: Colormap) -> npt.NDArray[np.uint8]:
    ramp = np.arange(256, dtype=np.uint8)[:, None]
    return np.asarray(cv2.applyColorMap(ramp, getattr(cv2, f"COLORMAP_{name.upper()}"))[:, 0, ::-1])


@dataclass(frozen=True)
class PictureOverlay:
    """The overlay that all pictures of a film share.

    Parameters
    ----------
    size_px : (int, int)
        Width and height of the pictures; one that is less than 200 px high is left as it is.
    scale : ColorScale or None
        What colours stand for.
    """

    size_px: tuple[int, int]
    scale: ColorScale | None

    def margins_px(self) -> tuple[float, float, float, float]:
        """Return what an object should leave free on the left, above, on the right and below."""
        width, height = self.size_px
        edge = _EDGE * height
        if height < _LEAST_HEIGHT:
            return edge, edge, edge, edge
        letters = self._letters_px()
        right = edge if self.scale is None else 3 * edge + color_bar_width(self.scale, _BAR * height)
        return edge, edge, min(right, 0.4 * width), 1.5 * edge + 2.2 * letters

    def draw(self, image: npt.NDArray[np.uint8], px_per_mm: float | None, label: str = "") -> None:
        """Draw it into a picture, in place.

        Parameters
        ----------
        image : (H, W, 3) uint8
            RGB.
        px_per_mm : float or None
            How long a mm is; None: there are no mm, and no scale bar.
        label : str
            What to write into the upper left corner.
        """
        width, height = self.size_px
        if height < _LEAST_HEIGHT:
            return
        edge, letters = _EDGE * height, self._letters_px()
        if self.scale is not None:
            tall = _BAR * height
            wide = color_bar_width(self.scale, tall)
            left, top = width - 1.6 * edge - wide, (height - tall) / 2
            darken(image, left - 0.6 * edge, top - 0.6 * edge, left + wide + 0.6 * edge, top + tall + 0.6 * edge)
            draw_color_bar(image, self.scale, (left, top), tall)
        if px_per_mm is not None:
            self._draw_scale_bar(image, px_per_mm)
        if label:
            wide = text_size(label, letters)[0]
            darken(image, edge, edge, 1.9 * edge + wide, edge + 1.6 * letters)
            write_text(image, label, (1.45 * edge, edge + 0.8 * letters), letters)

    def _letters_px(self) -> float:
        return max(_LETTERS * self.size_px[1], 11.0)

    def _draw_scale_bar(self, image: npt.NDArray[np.uint8], px_per_mm: float) -> None:
        width, height = self.size_px
        edge, letters = _EDGE * height, self._letters_px()
        length_mm = round_length(_LONGEST * width / px_per_mm)
        length, line = length_mm * px_per_mm, max(2, round(height / 400))
        text = f"{length_mm:g} mm"
        wide = max(length, text_size(text, letters)[0])
        left, bottom = 1.45 * edge, height - 1.4 * edge
        darken(image, edge, bottom - 2.1 * letters, left + wide + 0.45 * edge, height - edge)
        write_text(image, text, (left + (wide - text_size(text, letters)[0]) / 2, bottom - 1.2 * letters), letters)
        first, last, y, tick = round(left), round(left + length), round(bottom), round(0.3 * letters)
        image[y - line : y, first:last] = INK
        for end in (first, last - line):
            image[y - tick : y, end : end + line] = INK


def round_length(most: float) -> float:
    """Return the greatest of 1, 2 and 5 times a power of ten that is not above a length.

    >>> round_length(73.0), round_length(0.3)
    (50.0, 0.2)
    """
    step = round_step(most)
    if step <= most * (1 + 1e-9):
        return step
    power: float = 10.0 ** np.floor(np.log10(most))
    return float(max(factor * power for factor in (1, 2, 5) if factor * power <= most))
