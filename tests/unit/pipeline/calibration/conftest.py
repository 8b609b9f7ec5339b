"""Captures that several modules of calibration are tested with."""

import pytest
from support.posed_boards import CHARUCO, CHESSBOARD, captured

from pipeline.calibration.simulated_board import BoardCaptures


@pytest.fixture(scope="session")
def of_charuco() -> BoardCaptures:
    """Return the captures of one pose of the board with markers."""
    return captured(CHARUCO)


@pytest.fixture(scope="session")
def of_chessboard() -> BoardCaptures:
    """Return the captures of one pose of the board without."""
    return captured(CHESSBOARD)
