"""The board to print for a rig: how many squares, how large, and how far to tilt it."""

from dataclasses import dataclass
from math import floor, inf, radians, sin, sqrt

# Boards of fewer squares where the camera has few pixels; the first is what `colorphase pattern --board` draws.
_SQUARES = ((11, 8), (9, 7), (7, 5))
# The board's part of the field, by area: its corners then lie in most of the picture, and there is room to move it.
_PART = 0.5
#: Markers of smaller squares are not surely read. Of boards tilted by 15 to 35 degrees (blur 0.6 px, noise of 1.5
#: levels, 24 of each size) those with squares of 24 px all show nine corners of ten on average, of 20 px half, of 16 px
#: none.
LEAST_SQUARE_PX = 24.0
#: Ten poses tilted like that gave focal lengths to 0.02 % (`docs/calibration.md`).
TILTS_DEG = (15, 35)
# ISO 216, mm.
_SHEETS = (("A4", 210, 297), ("A3", 297, 420), ("A2", 420, 594), ("A1", 594, 841), ("A0", 841, 1189))


@dataclass(frozen=True)
class BoardChoice:
    """A ChArUco board that fills half of what camera and projector both see."""

    squares: tuple[int, int]  # columns, rows
    square_mm: float
    square_px: float  # of the camera, seen straight on
    sheet: str  # the smallest that takes it with its margin of one square
    sharp_mm: float  # how far before and behind the object the lenses must be sharp when it is tilted most


def choose_board(field_mm: tuple[float, float], mm_per_px: float) -> BoardChoice:
    """Return the board to calibrate with.

    Parameters
    ----------
    field_mm : (width, height)
        What camera and projector both see at the object's distance.
    mm_per_px : float
        Of the camera, there.
    """
    for squares in _SQUARES:
        fits = sqrt(_PART) * min(field_mm[0] / squares[0], field_mm[1] / squares[1])
        # Whole millimetres can be checked with a ruler; squares of less than 2 mm cannot.
        square_mm = float(floor(fits)) if fits >= 2 else fits
        if square_mm / mm_per_px >= LEAST_SQUARE_PX:
            break
    columns, rows = squares
    short, long = sorted(((columns + 2) * square_mm, (rows + 2) * square_mm))
    sheets = (*_SHEETS, ("more than A0", inf, inf))
    return BoardChoice(
        squares=squares,
        square_mm=square_mm,
        square_px=square_mm / mm_per_px,
        sheet=next(name for name, width, height in sheets if short <= width and long <= height),
        sharp_mm=columns * square_mm / 2 * sin(radians(TILTS_DEG[1])),
    )
