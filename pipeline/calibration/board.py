"""The boards that a rig is calibrated with: a plain chessboard, or a ChArUco board, which may be partly hidden."""

import io
from pathlib import Path
from typing import Annotated, Literal

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from pipeline.calibration.chessboard import find_chessboard, refine_corners
from pipeline.errors import CalibrationError, OutputError
from pipeline.files import write_atomically
from pipeline.models import FloatArray, Model

_MM_PER_INCH = 25.4


class Board(Model):
    """A printed board."""

    kind: Literal["charuco", "chessboard"] = "charuco"
    squares: tuple[Annotated[int, Field(ge=4, le=40)], Annotated[int, Field(ge=4, le=40)]] = (11, 8)  # columns, rows
    square_mm: Annotated[float, Field(gt=0)] = 20.0
    marker_mm: Annotated[float, Field(gt=0)] | None = None
    """Side of a ChArUco marker; None: three quarters of a square."""
    dictionary: str = "DICT_5X5_250"
    """The markers' dictionary, as OpenCV names it."""

    @model_validator(mode="after")
    def _check(self) -> "Board":
        if self.marker_mm is not None and self.marker_mm >= self.square_mm:
            raise ValueError("marker_mm must be less than square_mm")
        if not self.dictionary.startswith("DICT_") or not hasattr(cv2.aruco, self.dictionary):
            raise ValueError(f"dictionary is {self.dictionary!r}: name one of OpenCV's, as DICT_5X5_250")
        markers = len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary)).bytesList)
        needed = self.squares[0] * self.squares[1] // 2
        if self.kind == "charuco" and needed > markers:
            raise ValueError(f"{self.dictionary} has {markers} markers, the board needs {needed}: name a larger one")
        return self

    def corners_mm(self) -> FloatArray:
        """Return the inner corners, (N, 3) mm, row by row; x right, y down, z into the board."""
        columns, rows = self.squares[0] - 1, self.squares[1] - 1
        x, y = np.meshgrid(np.arange(1, columns + 1), np.arange(1, rows + 1))
        return np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3).astype(np.float64) * self.square_mm

    def find(self, image: npt.NDArray[np.floating]) -> tuple[npt.NDArray[np.intp], FloatArray]:
        """Find the inner corners in an image.

        Parameters
        ----------
        image : (H, W) float
            Grey, 0..1.

        Returns
        -------
        (N,) int, (N, 2) float64
            Which of `corners_mm`, and where, px. A chessboard may be numbered from either end.

        Raises
        ------
        CalibrationError
            The board is not there, or not as described.
        """
        # Corners are black and white wherever they lie: the brightest of the picture counts as white.
        grey = np.clip(255 * image / max(float(np.percentile(image, 99.5)), 1e-6), 0, 255)
        return self._find_chessboard(grey) if self.kind == "chessboard" else self._find_charuco(grey)

    def _find_chessboard(self, grey: FloatArray) -> tuple[npt.NDArray[np.intp], FloatArray]:
        size = (self.squares[0] - 1, self.squares[1] - 1)
        search = find_chessboard(grey, size)
        if search.corners_px is not None:
            places = search.corners_px.reshape(-1, 2)
            return self._front_side(places), places
        name, count, seen = "{}x{} chessboard".format(*self.squares), size[0] * size[1], search.seen
        if seen >= count:
            raise CalibrationError(
                f"a grid of {seen} corners is seen, not the {count} of a {name}: give its true squares"
            )
        only = f"only {seen} of the {count} inner corners of a {name} are seen" if seen >= 4 else f"no {name} is seen"
        raise CalibrationError(f"{only}: show it whole, sharp, lit and with nothing before it")

    def _find_charuco(self, grey: FloatArray) -> tuple[npt.NDArray[np.intp], FloatArray]:
        detector = cv2.aruco.CharucoDetector(self._charuco())
        levels = grey.astype(np.uint8)
        corners, ids, _, markers = detector.detectBoard(levels)
        if ids is not None and self.spans(np.asarray(ids).ravel()):
            places = refine_corners(grey, np.asarray(corners, np.float64).reshape(-1, 2))
            return np.asarray(ids).ravel().astype(np.intp), places
        if detector.detectBoard(np.ascontiguousarray(levels[:, ::-1]))[1] is not None:
            raise CalibrationError("the camera's pictures are mirrored: switch that off")
        name, seen = "{}x{} charuco".format(*self.squares), 0 if markers is None else len(markers)
        if seen == 0:
            wrong = f"not a marker of {self.dictionary}: show it sharp and lit, and name its dictionary"
        else:
            wrong = f"but {seen} of its markers: show more of it, sharp and lit, and give its true squares"
        raise CalibrationError(f"no {name} is seen, {wrong}")

    def spans(self, numbers: npt.NDArray[np.integer]) -> bool:
        """Return whether these corners tell how the board stands: two rows of it with two corners each, or more."""
        rows = np.asarray(numbers) // (self.squares[0] - 1)
        return int(np.count_nonzero(np.bincount(rows) >= 2)) >= 2

    def _front_side(self, places: FloatArray) -> npt.NDArray[np.intp]:
        """Return the numbers of a chessboard's corners, so that from x to y is clockwise, as on the front."""
        columns, rows = self.squares[0] - 1, self.squares[1] - 1
        grid = places.reshape(rows, columns, 2)
        right, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
        numbers = np.arange(rows * columns).reshape(rows, columns)
        return (numbers if right[0] * down[1] - right[1] * down[0] > 0 else numbers[:, ::-1]).ravel()

    def _charuco(self) -> cv2.aruco.CharucoBoard:
        marker = self.marker_mm or 0.75 * self.square_mm
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        return cv2.aruco.CharucoBoard(self.squares, self.square_mm, marker, dictionary)

    def draw(self, pixels_per_square: int = 40) -> npt.NDArray[np.uint8]:
        """Draw the board as it is printed, without a margin: each square is `pixels_per_square` px wide."""
        columns, rows = self.squares
        size = (columns * pixels_per_square, rows * pixels_per_square)
        if self.kind == "charuco":
            return np.asarray(self._charuco().generateImage(size, marginSize=0), np.uint8)
        y, x = np.mgrid[: size[1], : size[0]] // pixels_per_square
        return np.where((x + y) % 2 == 0, 0, 255).astype(np.uint8)

    def write(self, path: Path) -> None:
        """Write the board to be printed, as PDF, SVG or PNG, in its true size with a white margin of one square.

        Raises
        ------
        OutputError
            The name has another suffix, or the place cannot be written.
        """
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        kind = path.suffix.lower().lstrip(".")
        if kind not in ("pdf", "svg", "png"):
            raise OutputError(f"a board is written as PDF, SVG or PNG: name it {path.stem}.pdf")
        drawing = np.pad(self.draw(64), 64, constant_values=255)
        height, width = np.array(drawing.shape) / 64 * self.square_mm / _MM_PER_INCH
        figure = Figure(figsize=(width, height))
        FigureCanvasAgg(figure)
        axes = figure.add_axes((0, 0, 1, 1))
        axes.imshow(drawing, cmap="gray", interpolation="nearest", aspect="auto", vmin=0, vmax=255)
        axes.set_axis_off()
        buffer = io.BytesIO()
        figure.savefig(buffer, format=kind, dpi=300)
        write_atomically(path, buffer.getvalue())
