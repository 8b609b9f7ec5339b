"""Pictures side by side on a dark sheet, each under a few words."""

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.output.pictures.picture_overlay import text_size, write_text

Picture = npt.NDArray[np.uint8]
Panel = tuple[str, Picture]

#: RGB of the sheet: what is behind a drawn surface, below.
GROUND = np.array([29, 33, 39], np.uint8)
_LETTERS_PX, _MARGIN_PX = 17, 10
# JPEG as small as fringes bear; their colours are not to be subsampled, of all pictures.
_JPEG = (cv2.IMWRITE_JPEG_QUALITY, 84, cv2.IMWRITE_JPEG_OPTIMIZE, 1)
_WHOLE_COLORS = (cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)


def write_sheet(path: Path, panels: list[Panel], columns: int) -> None:
    """Write panels of one height in rows, as a JPEG."""
    gap, head = _MARGIN_PX, round(1.6 * _LETTERS_PX)
    rows = [panels[first : first + columns] for first in range(0, len(panels), columns)]
    widths = [max(row[k][1].shape[1] for row in rows if k < len(row)) for k in range(columns)]
    heights = [max(picture.shape[0] for _, picture in row) for row in rows]
    sheet = np.full((sum(heights) + len(rows) * head + gap, sum(widths) + (columns + 1) * gap, 3), GROUND, np.uint8)
    y = head
    for row, height in zip(rows, heights, strict=True):
        x = gap
        for (words, picture), width in zip(row, widths, strict=False):
            assert text_size(words, _LETTERS_PX)[0] <= width, f"no room for {words!r}"
            write_text(sheet, words, (x, y - head / 2), _LETTERS_PX)
            sheet[y : y + picture.shape[0], x : x + picture.shape[1]] = picture
            x += width + gap
        y += height + head
    cv2.imwrite(str(path), sheet[..., ::-1], [*_JPEG, *_WHOLE_COLORS])


def enlarged(picture: Picture, height_px: int) -> Picture:
    """Return a picture of another height."""
    size = (round(height_px * picture.shape[1] / picture.shape[0]), height_px)
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_CUBIC), np.uint8)
