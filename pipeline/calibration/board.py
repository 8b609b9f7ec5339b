"""The boards that a rig is calibrated with, and how their corners are found.

A ChArUco board may be partly hidden; OpenCV finds it. The inner corners of a chessboard are saddle points of the
picture that join to a grid. Where four squares meet, a smoothed picture I has a saddle point: its gradient is zero and
the determinant of its second derivatives negative. On a circle around it the picture is bright, dark, bright and dark.
From one corner to the next, bright and dark change places. (Saddles and grids as in A. Geiger, F. Moosmann, O. Car and
B. Schuster, Automatic camera and range sensor calibration using a single shot, 2012, doi:10.1109/ICRA.2012.6224570;
corners to a fraction of a pixel as in L. Lucchese and S. K. Mitra, Using saddle points for subpixel feature detection
in camera calibration targets, 2002, doi:10.1109/APCCAS.2002.1115151.)
"""

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from pipeline.errors import CalibrationError, OutputError
from pipeline.files import write_atomically
from pipeline.models import FloatArray, Model

# The smoothing, px: noise goes, and the edges of squares of 12 px do not reach each other.
_SMOOTHING_PX = 1.5
# The circle, px, on which bright and dark must alternate: within squares of 12 px that are tilted by 50 degrees.
_CIRCLE_PX, _CIRCLE_SAMPLES = 4.0, 24
# Of the circle's variation, the least share that repeats twice around: a corner of even angles has 0.81 before it is
# blurred, one seen at 50 degrees and blurred 0.85; where a margin meets a mount there is less.
_MIN_TWOFOLD = 0.8
# The least contrast, of 255 levels: below it noise makes corners.
_MIN_CONTRAST = 3.0
# The root of the determinant, over the contrast about the corner, at least: blurred by 1 px a corner has 0.19.
_MIN_CURVATURE = 0.08
# Determinant over squared trace, at least: edges that cross at 50 degrees have 0.35, a bright line has none.
_MIN_BALANCE = 0.3
# Half the window, px, in which contrast is measured.
_WINDOW_PX = 7
# A board has up to 39 by 39 corners; the strongest saddles of a picture that is full of things are searched.
_MAX_SADDLES = 2000
# Peaks that are examined closely, at most: OpenCV reads no more than 32767 rows at once.
_MAX_PEAKS = 20000
# A corner's first two ways are found among this many of its nearest saddles of other sign.
_NEIGHBOURS = 8
# The least height or width, px, of a picture that is searched: in a smaller one what hides a corner passes for blur.
_MIN_SIZE_PX = 240
# A corner that moves further when it is refined, px, has found something else.
_MAX_MOVE_PX = 2.0
# A corner lies this near to where its neighbours put it, over a square's side.
_REACH = 0.2
# And this near to the board's homography, over a square's side: a lens bends it by less, and the rim of a margin lies
# further off.
_FIT = 0.05
_MM_PER_INCH = 25.4
# What A4 and Letter paper have in common; what of a page's rim name and ruler need, and their places in it.
_PAPER_MM = (279.4, 210.0)
_CAPTION_MM, _TEXT_MM, _RULER_MM = 11.0, 5.0, 8.5


@dataclass(frozen=True)
class ChessboardSearch:
    """Result of a search for a chessboard."""

    corners_px: FloatArray | None  # (rows, columns, 2), or None
    seen: int  # how many corners the largest grid has: another board's, or a part's


def find_chessboard(grey: npt.NDArray[np.floating], size: tuple[int, int]) -> ChessboardSearch:
    """Find the inner corners of a chessboard that is seen whole.

    Parameters
    ----------
    grey : (H, W) float
        Grey, 0..255.
    size : (columns, rows)
        Of inner corners.

    Returns
    -------
    ChessboardSearch
        Row by row, from any of the board's ends, and perhaps mirrored.
    """
    search = _search(grey.astype(np.float32), size)
    height, width = (length // 2 for length in grey.shape)
    if search.corners_px is not None or min(height, width) < _MIN_SIZE_PX:
        return search
    # What is blurred by many pixels is sharp in a smaller picture.
    half = cv2.resize(grey[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA)
    smaller = find_chessboard(half, size)
    places = None if smaller.corners_px is None else refine_corners(grey, 2 * smaller.corners_px + 0.5)
    return ChessboardSearch(places, max(search.seen, smaller.seen))


def refine_corners(grey: npt.NDArray[np.floating], corners: FloatArray) -> FloatArray:
    """Return corners to a few hundredths of a pixel, (..., 2) px, from places a pixel off.

    A corner stays where it is where the picture has no saddle point near it.
    """
    slopes = _slopes(grey.astype(np.float32))
    height, width = grey.shape
    places = corners.reshape(-1, 2)
    for _ in range(3):
        u, v = np.clip(np.rint(places), 0, (width - 1, height - 1)).astype(int).T
        places = np.column_stack([u, v]) + np.clip(_to_saddle(slopes, v, u), -1, 1)
    ran_away = np.linalg.norm(places - corners.reshape(-1, 2), axis=1) > _MAX_MOVE_PX
    return np.where(ran_away[:, None], corners.reshape(-1, 2), places).reshape(corners.shape)


def _slopes(picture: npt.NDArray[np.float32]) -> tuple[npt.NDArray[np.float32], ...]:
    """Return the smoothed picture's derivatives: x, y, xx, yy, xy."""
    smooth = cv2.GaussianBlur(picture, (0, 0), _SMOOTHING_PX)
    orders = ((1, 0, 8), (0, 1, 8), (2, 0, 4), (0, 2, 4), (1, 1, 4))
    return tuple(np.asarray(cv2.Sobel(smooth, cv2.CV_32F, i, j, ksize=3, scale=1 / n)) for i, j, n in orders)


def _to_saddle(
    slopes: tuple[npt.NDArray[np.float32], ...], v: npt.NDArray[np.intp], u: npt.NDArray[np.intp]
) -> FloatArray:
    """Return the way from pixels to where the gradient is zero, (N, 2) px: one step of Newton."""
    x, y, xx, yy, xy = (slope[v, u].astype(np.float64) for slope in slopes)
    determinant = np.minimum(xx * yy - xy * xy, -1e-12)
    return np.column_stack([xy * y - yy * x, xy * x - xx * y]) / determinant[:, None]


def _saddles(picture: npt.NDArray[np.float32]) -> tuple[FloatArray, npt.NDArray[np.complex128]]:
    """Return the places that may be corners, (N, 2) px, strongest first, and how their light turns.

    The second is exp(2i angle) of the way to the bright squares, times the contrast.
    """
    slopes = _slopes(picture)
    _, _, xx, yy, xy = slopes
    strength = xy * xy - xx * yy
    window = (2 * _WINDOW_PX + 1,) * 2
    mean = cv2.blur(picture, window)
    contrast = np.sqrt(np.maximum(cv2.blur(picture * picture, window) - mean * mean, 0))
    peak = (strength == cv2.dilate(strength, np.ones((5, 5)))) & (contrast > _MIN_CONTRAST)
    peak &= (strength > (_MIN_CURVATURE * contrast) ** 2) & (strength > _MIN_BALANCE * (xx + yy) ** 2)
    v, u = np.nonzero(peak)
    if len(v) == 0:
        return np.zeros((0, 2)), np.zeros(0, np.complex128)
    strongest = np.argsort(-strength[v, u])[:_MAX_PEAKS]
    v, u = v[strongest], u[strongest]
    places = np.column_stack([u, v]) + np.clip(_to_saddle(slopes, v, u), -1, 1)
    around = np.exp(2j * np.pi * np.arange(_CIRCLE_SAMPLES) / _CIRCLE_SAMPLES)
    on_circle = (places[:, :1] + 1j * places[:, 1:] + _CIRCLE_PX * around).astype(np.complex64)
    circle = cv2.remap(
        cv2.GaussianBlur(picture, (0, 0), 0.7), on_circle.real.copy(), on_circle.imag.copy(), cv2.INTER_LINEAR
    ).reshape(len(places), _CIRCLE_SAMPLES)
    circle = circle - circle.mean(axis=1, keepdims=True)
    bright = (circle * around**2).mean(axis=1)
    good = 2 * np.abs(bright) ** 2 > _MIN_TWOFOLD * (circle**2).mean(axis=1)
    good &= np.abs(bright) > _MIN_CONTRAST
    best = np.flatnonzero(good)[np.argsort(-np.abs(bright[good]))[:_MAX_SADDLES]]
    return np.asarray(places[best], np.float64), np.asarray(bright[best], np.complex128)


def _search(picture: npt.NDArray[np.float32], size: tuple[int, int]) -> ChessboardSearch:
    """Search a picture at its own scale."""
    places, bright = _saddles(picture)
    if len(places) < 4:
        return ChessboardSearch(None, 0)
    saddles = _Saddles(places, bright)
    free = np.ones(len(places), np.bool_)
    grids = []
    for seed in range(len(places)):
        if free[seed]:
            grids.append(saddles.grid(seed))
            free[list(grids[-1].values())] = False
    grids.sort(key=len, reverse=True)
    for cells in grids:
        corners = _board(np.array(list(cells)), places[list(cells.values())], size)
        if corners is not None:
            return ChessboardSearch(corners, len(cells))
    return ChessboardSearch(None, len(grids[0]))


class _Saddles:
    """Places that may be corners, and the grids that they make."""

    def __init__(self, places: FloatArray, bright: npt.NDArray[np.complex128]) -> None:
        self.places, self.bright = places, bright

    def grid(self, seed: int) -> dict[tuple[int, int], int]:
        """Return the saddles that join a seed, by column and row in a grid that is the seed's own."""
        steps = self._first_steps(seed)
        cells = {(0, 0): seed}
        if steps is None:
            return cells
        taken = {seed}
        queue = [(0, 0)]
        for i, j in queue:
            for di, dj in ((1, 0), (0, 1), (-1, 0), (0, -1)):
                cell = (i + di, j + dj)
                if cell in cells:
                    continue
                step = self._step(cells, (i, j), (di, dj), steps)
                near = self._opposite(cells[i, j], step)
                if near is not None and near not in taken:
                    cells[cell] = near
                    taken.add(near)
                    queue.append(cell)
        return cells

    def _first_steps(self, seed: int) -> tuple[FloatArray, FloatArray] | None:
        """Return the steps to two neighbours of a seed, along a row and a column."""
        ways = self.places[self._change_places(seed, slice(None))] - self.places[seed]
        ways = ways[np.argsort(np.hypot(*ways.T))[:_NEIGHBOURS]]
        for way in ways[1:]:
            across = abs(ways[0][0] * way[1] - ways[0][1] * way[0])
            if across > 0.5 * np.hypot(*ways[0]) * np.hypot(*way):
                return ways[0], way
        return None

    def _step(
        self,
        cells: dict[tuple[int, int], int],
        at: tuple[int, int],
        way: tuple[int, int],
        first: tuple[FloatArray, FloatArray],
    ) -> FloatArray:
        """Return the step that leads one way: as the one before it, or next to it, or else the first."""
        (i, j), (di, dj) = at, way
        for m, n in ((i - di, j - dj), (i + dj, j + di), (i - dj, j - di)):
            if (m, n) in cells and (m + di, n + dj) in cells:
                return np.asarray(self.places[cells[m + di, n + dj]] - self.places[cells[m, n]])
        return di * first[0] + dj * first[1]

    def _opposite(self, at: int, step: FloatArray) -> int | None:
        """Return the saddle a step away whose bright and dark have changed places."""
        off = np.hypot(*(self.places - self.places[at] - step).T)
        near = int(np.argmin(off))
        return near if off[near] < _REACH * np.hypot(*step) and self._change_places(at, near) else None

    def _change_places(self, one: int, others: Any) -> Any:
        """Return whether what is bright about one saddle is dark about others."""
        return (self.bright[one] * np.conj(self.bright[others])).real < 0


def _board(cells: npt.NDArray[np.intp], places: FloatArray, size: tuple[int, int]) -> FloatArray | None:
    """Return the (rows, columns, 2) corners of a board of this size in a grid; None: it is another board, or a part.

    At the rim of a narrow margin there may be saddles that are not the board's corners and do not fit its homography.
    """
    least, board = np.inf, None
    for grid in (cells, cells[:, ::-1]):
        for first in np.ndindex(*np.maximum(np.ptp(grid, axis=0) + 2 - size, 0)):
            squares = grid - grid.min(axis=0) - first
            inside = ((squares >= 0) & (squares < size)).all(axis=1)
            if np.count_nonzero(inside) < size[0] * size[1]:
                continue
            misfit = _misfit(squares, places, inside)
            if misfit[inside].max() < least:
                least = misfit[inside].max()
                is_larger = np.count_nonzero(~inside & (misfit < _FIT)) > min(size) / 2
                order = np.lexsort(squares[inside].T)
                board = None if is_larger else places[inside][order].reshape(size[1], size[0], 2)
    return board


def _misfit(squares: npt.NDArray[np.intp], places: FloatArray, inside: npt.NDArray[np.bool_]) -> FloatArray:
    """Return how far places lie off the homography of those inside, over a square's side."""
    on_board = squares[:, None].astype(np.float64)
    to_px, _ = cv2.findHomography(on_board[inside], places[inside])
    area = cv2.contourArea(cv2.convexHull(places[inside].astype(np.float32)))
    side = np.sqrt(area / np.prod(np.ptp(squares[inside], axis=0)))
    return np.asarray(np.linalg.norm(cv2.perspectiveTransform(on_board, to_px)[:, 0] - places, axis=1) / side)


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

    def outline_mm(self) -> FloatArray:
        """Return the squares' outer corners about the board's middle, (4, 3) mm, clockwise from the upper left."""
        columns, rows = self.squares
        corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float64)
        return np.asarray(corners * (columns, rows, 0) * self.square_mm / 2)

    def find(self, image: npt.NDArray[np.floating]) -> tuple[npt.NDArray[np.intp], FloatArray]:
        """Find the inner corners in an image.

        Parameters
        ----------
        image : (H, W) float
            Grey, 0..1.

        Returns
        -------
        (N,) int, (N, 2) float64
            Numbers in `corners_mm`, and places, px. A chessboard may be numbered from either end.

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
        """Return whether these corners fix the board's pose: two rows of it with two corners each, or more."""
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
        """Write the board to be printed, as PDF, SVG or PNG, in its true size.

        Below the board are its name and a ruler of 100 mm, to check that it was printed in its true size; above it,
        which way is up. The page fits on A4 and on Letter paper where the board does, with a white margin of half a
        square at least; else it is the board with a margin of one square.

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
        board = np.array(self.squares) * self.square_mm
        page = np.array(_PAPER_MM if board[0] >= board[1] else _PAPER_MM[::-1])
        if (board + max(self.square_mm, 2 * _CAPTION_MM) > page).any():
            page = board + 2 * max(self.square_mm, _CAPTION_MM)
        figure = Figure(figsize=tuple(page / _MM_PER_INCH))
        FigureCanvasAgg(figure)
        left, bottom = (page - board) / 2
        axes = figure.add_axes((left / page[0], bottom / page[1], *(board / page)))
        axes.imshow(self.draw(64), cmap="gray", interpolation="nearest", aspect="auto", vmin=0, vmax=255)
        axes.set_axis_off()
        self._caption(figure.add_axes((0, 0, 1, 1), xlim=(0, page[0]), ylim=(0, page[1])), page)
        buffer = io.BytesIO()
        figure.savefig(buffer, format=kind, dpi=300)
        write_atomically(path, buffer.getvalue())

    def _caption(self, axes: Any, page_mm: FloatArray) -> None:
        """Draw name, ruler and "up" at the page's rims, in axes whose unit is mm."""
        axes.set_axis_off()
        axes.patch.set_alpha(0)
        middle, top = page_mm[0] / 2, page_mm[1]
        name = "{} {}x{}, squares of {:g} mm".format(self.kind, *self.squares, self.square_mm)
        if self.kind == "charuco":
            name += f", {self.dictionary}, markers of {self.marker_mm or 0.75 * self.square_mm:g} mm"
        axes.text(middle, _TEXT_MM, f"{name}; the ruler is 100 mm long", ha="center", va="bottom", fontsize=6)
        ticks = middle - 50 + np.arange(0, 101, 10)
        axes.vlines(ticks, _RULER_MM, _RULER_MM + 1.5, colors="black", linewidths=0.5)
        axes.hlines(_RULER_MM, ticks[0], ticks[-1], colors="black", linewidths=0.5)
        axes.text(middle, top - _TEXT_MM, "up", ha="center", va="top", fontsize=6)
