"""What the colours of a picture stand for: limits, colour map, and the bar that tells them."""

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.output.pictures.lettering import INK, text_size, write_text

# From below zero to above it, blue through grey to red (Moreland's cool and warm), as RGB.
_DIVERGING = np.array([[59, 76, 192], [141, 176, 254], [221, 221, 221], [244, 154, 123], [180, 4, 38]], np.float32)
# Ticks of a bar, at most.
_TICKS = 6
# Of what is shown on each side that may lie outside the limits, percent.
_OUTSIDE = 1.0
# By which part of their range values may lie outside the limits before they are far outside, and the grey of those.
_BEYOND, _GREY = 0.1, 120


@dataclass(frozen=True)
class ColorScale:
    """How values become colours.

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
    grey_beyond : bool
        Whether what lies far outside the limits, as a wall behind the object does, has no colour but grey.
    """

    low: float
    high: float
    name: str
    unit: str
    diverging: bool = False
    grey_beyond: bool = False

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
        if self.diverging:
            table, numbers = _diverging_map(), 255 * fractions
        else:  # the map's ends are too dark to tell apart
            table, numbers = _TURBO, 20 + 215 * fractions
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
        What it tells.
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


_TURBO = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_TURBO)[:, 0, ::-1]
