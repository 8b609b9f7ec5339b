"""Captures that several modules of calibration are tested with."""

import pytest
from support.board_rig import BoardCaptures
from support.posed_boards import CHARUCO, captured


@pytest.fixture(scope="session")
def of_charuco() -> BoardCaptures:
    """Return the captures of one pose of the board with markers."""
    return captured(CHARUCO)
