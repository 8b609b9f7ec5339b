"""Boards that are found, refused or found wrongly in photographs whose corners are known, by what makes them hard.

python tests/benchmarks/board_detection.py [boards a row]

Beside it what one call of OpenCV's findChessboardCornersSB does, exhaustive and normalised, on the same pictures.
"""

import sys
import time

import _tests_path  # noqa: F401 - puts support on the path
import cv2
import numpy as np
from support.board_photographs import View, photograph, rms_px, wall

from pipeline.calibration.board import Board
from pipeline.errors import CalibrationError

CHESSBOARDS = [Board(kind="chessboard", squares=s) for s in ((10, 7), (8, 6), (7, 7), (12, 9), (6, 5), (11, 8))]
CHARUCOS = [Board(squares=s) for s in ((9, 6), (7, 5), (11, 8))]
WHOLE = {
    "anything below at once": View(fringes=(0, 0.05), clutter=12, bend=0.05, unevenness=(0, 0.7)),
    "squares of 12 to 16 px": View(square_px=(12, 16)),
    "tilted by 40 to 50 degrees": View(tilt_deg=(40, 50)),
    "blur of 0.9 to 1 px": View(blur_px=(0.9, 1.0)),
    "dark (white at 60 to 100), noise 3 to 5": View(noise=(3, 5), white=(60, 100)),
    "light falls by 60 to 80 %": View(unevenness=(0.6, 0.8)),
    "fringes of 10 to 20 % on board and wall": View(fringes=(0.1, 0.2)),
    "25 things on the wall": View(clutter=25),
    "margin narrow or covered by a dark mount": View(mounted=True, margin=(0.1, 0.5)),
    "the same, squares of 12 to 16 px": View(mounted=True, margin=(0.1, 0.5), square_px=(12, 16)),
    "lens that bends by up to 10 %": View(bend=0.1, square_px=(12, 40)),
    "1280x960 px": View(size_px=(1280, 960), square_px=(12, 100), clutter=12),
}
CHARUCO_VIEWS = {
    "ChArUco, squares of 24 to 40 px": View(square_px=(24, 40), clutter=12),
    "ChArUco, squares of 40 to 60 px": View(square_px=(40, 60), clutter=12),
}
# Found corners that are further off are wrong, px.
WRONG_PX = 0.5


def found_by_one_call(board, grey):
    """Return what OpenCV finds, None where it finds nothing."""
    size = (board.squares[0] - 1, board.squares[1] - 1)
    levels = np.clip(255 * grey / np.percentile(grey, 99.5), 0, 255).astype(np.uint8)
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    found, corners = cv2.findChessboardCornersSB(levels, size, flags=flags)
    places = corners.reshape(-1, 2) if found else None
    return None if places is None else (board._front_side(places), places)


def found_by_us(board, grey):
    """Return what the library finds, None where it finds nothing."""
    try:
        return board.find(grey)
    except CalibrationError:
        return None


def row(name, boards, view, count, finders):
    """Print one line: found, refused, wrong, corners off, seconds a picture; of each finder."""
    rng = np.random.default_rng(11)
    off, seconds = [[] for _ in finders], [[] for _ in finders]
    for k in range(count):
        board = boards[k % len(boards)]
        picture, corners = photograph(board, view, rng)
        grey = picture.mean(axis=-1) / 255
        for finder, errors, times in zip(finders, off, seconds, strict=True):
            start = time.perf_counter()
            found = finder(board, grey)
            times.append(time.perf_counter() - start)
            errors.append(np.nan if found is None else rms_px(board, *found, corners))
    cells = []
    for errors, times in zip(off, seconds, strict=True):
        right = [error for error in errors if error <= WRONG_PX]
        cells.append(
            f"{len(right)} | {np.isnan(errors).sum()} | {count - len(right) - np.isnan(errors).sum()} | "
            f"{np.median(right):.3f}, {max(right):.3f} | {np.median(times):.2f}, {max(times):.2f}"
        )
    print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


def row_without(name, pictures, finders):
    """Print how often a board is found where there is none, or not the one that is looked for."""
    counts = np.zeros(len(finders), int)
    total = 0
    for board, picture in pictures:
        total += 1
        grey = picture.mean(axis=-1) / 255
        counts += [finder(board, grey) is not None for finder in finders]
    print(f"| {name} | {total} | " + " | ".join(str(count) for count in counts) + " |", flush=True)


def walls(view, count):
    """Yield pictures without a board."""
    rng = np.random.default_rng(12)
    for k in range(count):
        yield CHESSBOARDS[k % len(CHESSBOARDS)], wall(view, rng)


def spoilt(how, count):
    """Yield boards that are cut off, partly hidden, or not as described."""
    rng = np.random.default_rng(13)
    for k in range(count):
        board = CHESSBOARDS[k % len(CHESSBOARDS)]
        picture, corners = photograph(board, View(clutter=5), rng)
        columns, rows = board.squares
        hidden = corners[rng.integers(len(corners))]
        if how == "cut":
            picture = picture[:, : int(np.sort(corners[:, 0])[-1 - rows // 2])]
        elif how == "hidden":
            cv2.circle(picture, hidden.astype(int), 12, (150, 120, 100), -1)
        else:
            other = (columns + (1 if how == "smaller" else -1), rows)
            board = board.model_copy(update={"squares": other})
        yield board, picture


def main(count):
    """Print the tables."""
    finders = (found_by_us, found_by_one_call)
    head = "found | refused | wrong | RMS px, median and worst | s, median and worst"
    print(f"| whole, sharp, lit | {head} | one call: {head} |")
    for name, view in WHOLE.items():
        row(name, CHESSBOARDS, view, count, finders)
    for name, view in CHARUCO_VIEWS.items():
        row(name, CHARUCOS, view, count, finders[:1])
    print("| no such board | pictures | found | one call: found |")
    row_without("25 things on a wall", walls(View(clutter=25), count), finders)
    row_without("fringes of 20 % on a wall", walls(View(clutter=10, fringes=(0.2, 0.2)), count), finders)
    for how in ("cut", "hidden", "smaller", "larger"):
        row_without(how, spoilt(how, count), finders)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100)
