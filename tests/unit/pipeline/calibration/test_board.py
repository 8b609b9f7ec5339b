"""Boards as they are printed, and found in a picture."""

import cv2
import numpy as np
import pytest
from support.posed_boards import CHARUCO

from pipeline.calibration.board import Board
from pipeline.errors import OutputError, SettingsError
from pipeline.models import build


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
