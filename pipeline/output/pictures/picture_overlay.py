"""What is written into a picture: colour bar, scale bar, the frame's number."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.output.pictures.color_scale import ColorScale, color_bar_width, draw_color_bar, round_step
from pipeline.output.pictures.lettering import INK, darken, text_size, write_text

# Parts of the picture's height.
_EDGE, _LETTERS, _BAR = 0.03, 0.026, 0.62
# Longest scale bar, as a part of the picture's width.
_LONGEST = 0.22
# Smaller ones have no room for letters.
_LEAST_HEIGHT = 200


@dataclass(frozen=True)
class PictureOverlay:
    """What every picture of a film tells, and where.

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
