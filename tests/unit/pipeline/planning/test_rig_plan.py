"""The board that is recommended: as large as it should be, and found."""

import cv2
import numpy as np
import pytest

from pipeline.calibration.board import Board
from pipeline.planning.rig_plan import LEAST_SQUARE_PX, TILTS_DEG, choose_board

FOCAL_PX = 1250.0


def photographed(board, square_px, tilt_deg, turn_deg, rng):
    """Return a 640x480 photograph of a board in the middle, tilted about an axis at this angle, 0..1."""
    drawing = np.pad(board.draw(64), 64, constant_values=255).astype(np.float32)
    height, width = drawing.shape
    ends = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float64)
    axis = np.radians(tilt_deg) * np.array([np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg)), 0.0])
    squares = np.column_stack([(ends - [width / 2, height / 2]) / 64, np.zeros(4)])
    points = squares @ cv2.Rodrigues(axis)[0].T + [0, 0, FOCAL_PX / square_px]
    pixels = points[:, :2] / points[:, 2:] * FOCAL_PX + [320, 240]
    finer = 4
    to_picture = cv2.getPerspectiveTransform(ends.astype(np.float32), (finer * pixels).astype(np.float32))
    picture = cv2.warpPerspective(drawing, to_picture, (640 * finer, 480 * finer), borderValue=120)
    picture = cv2.resize(cv2.GaussianBlur(picture, (0, 0), 0.6 * finer), (640, 480), interpolation=cv2.INTER_AREA)
    return np.clip(0.75 * picture + 10 + rng.normal(0, 1.5, picture.shape), 0, 255) / 255


@pytest.mark.parametrize("tilt_deg", TILTS_DEG)
def test_the_smallest_squares_are_found(tilt_deg):
    """In eight ways of tilting it, half of the corners or more, where three rows of two would do."""
    board, rng = Board(), np.random.default_rng(4)
    corners = len(board.corners_mm())
    for turn_deg in range(0, 360, 45):
        numbers, _ = board.find(photographed(board, LEAST_SQUARE_PX, tilt_deg, turn_deg, rng))
        assert len(numbers) > 0.5 * corners, turn_deg


@pytest.mark.parametrize("field_mm", [(458.0, 343.0), (200.0, 150.0), (2000.0, 1500.0), (300.0, 900.0)])
def test_it_fits_into_half_of_the_field(field_mm):
    """Half by area, less what whole millimetres take off; and it is not smaller than it needs to be."""
    board = choose_board(field_mm, 1e-3 * field_mm[0])
    sides = np.array(board.squares) * board.square_mm
    assert np.all(sides <= np.sqrt(0.5) * np.array(field_mm))
    assert np.any(sides + np.array(board.squares) > np.sqrt(0.5) * np.array(field_mm))


def test_few_pixels_get_fewer_and_larger_squares():
    many, few = choose_board((458.0, 343.0), 458 / 640), choose_board((458.0, 343.0), 458 / 320)
    assert many.squares == (11, 8) and many.square_px > LEAST_SQUARE_PX
    assert few.squares != (11, 8) and few.square_mm > many.square_mm and few.square_px > LEAST_SQUARE_PX
    assert choose_board((458.0, 343.0), 458 / 80).square_px < LEAST_SQUARE_PX


def test_the_sheet_takes_the_margin():
    board = choose_board((458.0, 343.0), 0.7)
    assert (board.squares, board.square_mm, board.sheet) == ((11, 8), 29.0, "A3")
    assert 13 * 29 <= 420 and 10 * 29 <= 297
    assert choose_board((9000.0, 9000.0), 1.0).sheet == "more than A0"
