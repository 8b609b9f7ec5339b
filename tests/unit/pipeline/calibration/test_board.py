"""Boards as they are printed, and their corners found in every picture that shows a board, and nowhere else."""

import cv2
import numpy as np
import pytest
from support.board_photographs import View, photograph, rms_px, wall
from support.posed_boards import CHARUCO

from pipeline.calibration.board import Board, find_chessboard, refine_corners
from pipeline.errors import CalibrationError, OutputError, SettingsError
from pipeline.models import build

BOARDS = [Board(kind="chessboard", squares=squares) for squares in ((8, 6), (7, 7), (9, 6), (6, 5))]
SMALL = {"size_px": (320, 240), "square_px": (12, 18)}
VIEWS = {
    "tilted": View(**SMALL, tilt_deg=(40, 50)),
    "cluttered": View(**SMALL, clutter=10, unevenness=(0.5, 0.8)),
    "mounted": View(**SMALL, mounted=True, margin=(0.1, 0.5)),
    "blurred and noisy": View(**SMALL, blur_px=(0.9, 1.0), noise=(2, 3)),
    "bent": View(**SMALL, bend=0.08),
}


@pytest.mark.parametrize("view", VIEWS.values(), ids=VIEWS)
def test_whole_boards_are_found(view):
    """Corners lie within 0.1 px RMS, and every one has its own number."""
    rng = np.random.default_rng(5)
    for k in range(6):
        board = BOARDS[k % len(BOARDS)]
        picture, corners = photograph(board, view, rng)
        numbers, places = board.find(picture.mean(axis=-1) / 255)
        assert sorted(numbers) == list(range(len(corners)))
        assert rms_px(board, numbers, places, corners) < 0.1


def test_fringes_and_things_are_no_board():
    rng = np.random.default_rng(6)
    for k in range(8):
        picture = wall(View(**SMALL, clutter=12 * (k % 2), fringes=(0.1, 0.3)), rng)
        assert find_chessboard(picture.mean(axis=-1), (7, 5)).corners_px is None


@pytest.mark.parametrize(
    ("squares", "spoil", "message"),
    [
        (
            (8, 6),
            lambda picture, corners: picture[:, : int(corners[:, 0].max()) - 5],
            "only 3. of the 35 inner corners",
        ),
        ((8, 6), lambda picture, corners: picture * 0 + 90, "no 8x6 chessboard is seen: show it whole"),
        ((7, 6), lambda picture, corners: picture, "a grid of 35 corners is seen, not the 30 of a 7x6"),
        ((9, 6), lambda picture, corners: picture, "only 35 of the 40 inner corners"),
        (
            (8, 6),
            lambda picture, corners: cv2.circle(picture, corners[17].astype(int), 8, (90, 90, 90), -1),
            "only 34 of the 35 inner corners",
        ),
    ],
    ids=["cut off", "nothing", "a larger board", "a smaller board", "partly hidden"],
)
def test_what_is_no_such_board_is_said(squares, spoil, message):
    picture, corners = photograph(BOARDS[0], View(**SMALL, tilt_deg=(0, 20)), np.random.default_rng(8))
    grey = spoil(picture, corners).mean(axis=-1) / 255
    with pytest.raises(CalibrationError, match=message):
        Board(kind="chessboard", squares=squares).find(grey)


def test_a_board_out_of_focus_is_found_in_a_smaller_picture():
    """Blurred by 6 px, squares of 50 px: corners to 0.5 px."""
    view = View(size_px=(640, 480), square_px=(50, 52), tilt_deg=(0, 20))
    picture, corners = photograph(BOARDS[0], view, np.random.default_rng(9))
    blurred = cv2.GaussianBlur(picture.mean(axis=-1) / 255, (0, 0), 6)
    assert rms_px(BOARDS[0], *BOARDS[0].find(blurred), corners) < 0.5


def test_corners_are_refined_where_there_are_any():
    picture, corners = photograph(BOARDS[0], View(**SMALL), np.random.default_rng(10))
    moved = corners + np.random.default_rng(11).uniform(-0.7, 0.7, corners.shape)
    assert np.sqrt(((refine_corners(picture.mean(axis=-1), moved) - corners) ** 2).sum(axis=1).mean()) < 0.1
    np.testing.assert_array_equal(refine_corners(np.zeros((40, 40)), np.array([[20.25, 3.0]])), [[20, 3]])


def test_boards_that_cannot_be():
    with pytest.raises(SettingsError, match=r"DICT_4X4_50 has 50 markers, the board needs 300"):
        build(Board, {"squares": (30, 20), "dictionary": "DICT_4X4_50"}, SettingsError, "board")
    assert CHARUCO.spans(np.array([0, 1, 8, 9]))
    assert not CHARUCO.spans(np.arange(8)) and not CHARUCO.spans(np.array([0, 1, 2, 8]))


def test_a_printed_board(tmp_path):
    for name in ("board.pdf", "board.svg", "board.png"):
        CHARUCO.write(tmp_path / name)
    picture = cv2.imread(str(tmp_path / "board.png"), cv2.IMREAD_GRAYSCALE)
    # 11 x 8 squares of 30 mm with the margin, at 300 dots an inch.
    assert abs(picture.shape[1] - 11 * 30 / 25.4 * 300) < 3 and abs(picture.shape[0] - 8 * 30 / 25.4 * 300) < 3
    numbers, places = CHARUCO.find(picture / 255.0)
    assert len(numbers) == 40
    np.testing.assert_allclose(places, (CHARUCO.corners_mm()[numbers, :2] + 30) / 25.4 * 300, atol=3)
    with pytest.raises(OutputError, match="PDF, SVG or PNG"):
        CHARUCO.write(tmp_path / "board.jpg")


@pytest.mark.parametrize(
    ("squares", "square_mm", "page_mm"),
    [((11, 8), 20.0, (279.4, 210.0)), ((6, 9), 20.0, (210.0, 279.4)), ((11, 8), 24.0, (312.0, 240.0))],
)
def test_a_printed_board_fits_on_paper_and_tells_its_size(tmp_path, squares, square_mm, page_mm):
    """A ruler of 100 mm lies under it, in a margin that hides no corner."""
    board = Board(kind="chessboard", squares=squares, square_mm=square_mm)
    board.write(tmp_path / "board.png")
    picture = cv2.imread(str(tmp_path / "board.png"), cv2.IMREAD_GRAYSCALE)
    px_per_mm = 300 / 25.4
    np.testing.assert_allclose(picture.shape[::-1], np.array(page_mm) * px_per_mm, atol=2)
    dark = np.flatnonzero(picture[round(picture.shape[0] - 8.5 * px_per_mm)] < 160)
    assert np.ptp(dark) == pytest.approx(100 * px_per_mm, abs=8)
    small = cv2.resize(picture, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    _, places = board.find(small / 255.0)
    assert np.linalg.norm(places[1] - places[0]) * 4 / px_per_mm == pytest.approx(square_mm, rel=0.01)
