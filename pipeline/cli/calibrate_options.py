"""What the commands of `colorphase calibrate` share: the board's options, and what goes in and out."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from pipeline.calibration.board import Board
from pipeline.calibration.model import DEFAULT_PROJECTOR_PX
from pipeline.cli.console import above_zero, size_of
from pipeline.errors import SettingsError
from pipeline.models import build

#: The projector's size where none is given.
PROJECTOR_SIZE = "{}x{}".format(*DEFAULT_PROJECTOR_PX)


@Parameter(name="*")
@dataclass(frozen=True)
class BoardOptions:
    """The options that describe a board."""

    squares: str = "11x8"
    """The board's squares, columns and rows."""
    square_mm: Annotated[float, Parameter(validator=above_zero)] = 20.0
    """The side of a square."""
    marker_mm: Annotated[float | None, Parameter(validator=above_zero)] = None
    """The side of a ChArUco marker; left out, three quarters of a square."""
    dictionary: str = "DICT_5X5_250"
    """The markers' dictionary, as OpenCV names it."""

    def with_square(self, square_mm: float) -> "BoardOptions":
        """Return the options of the same board, printed in another size."""
        marker = None if self.marker_mm is None else self.marker_mm * square_mm / self.square_mm
        return replace(self, square_mm=square_mm, marker_mm=marker)

    def board(self, kind: str) -> Board:
        """Return the board.

        Raises
        ------
        SettingsError
            There is no such board.
        """
        sides = {
            "squares": size_of(self.squares, "--squares"),
            "square_mm": self.square_mm,
            "marker_mm": self.marker_mm,
        }
        return build(Board, {"kind": kind, "dictionary": self.dictionary, **sides}, SettingsError, "board")


def captures_and_target(captures: Path | None, out: Path | None) -> tuple[Path, Path]:
    """Return what is measured, and where the result goes.

    Raises
    ------
    SettingsError
        One of them is missing.
    """
    if captures is None or out is None:
        raise SettingsError("give either --make and a folder, or a folder of captures and --out")
    return captures, out
