"""Boards in a pose before the rig that calibration is tested with."""

from support.board_rig import BoardCaptures

from pipeline.calibration.board import Board
from pipeline.calibration.model import Pattern
from pipeline.calibration.multishot import multishot_codes, multishot_sequence
from pipeline.simulation import simulated_rig

CAMERA_PX, PROJECTOR_PX = RIG_PX = (640, 480), (1024, 768)
SEQUENCE = multishot_sequence(PROJECTOR_PX)
CHESSBOARD = Board(kind="chessboard", squares=(10, 7), square_mm=26.0)
CHARUCO = Board(kind="charuco", squares=(9, 6), square_mm=30.0)
PATTERN = Pattern(period_px=768 / 44)


def rig():
    return simulated_rig(
        CAMERA_PX,
        camera_distortion=(-0.12, 0.08, 0.001, -0.0008, 0),
        projector_distortion=(-0.06, 0.05, -0.001, 0.0005, 0),
    )


def codes(name):
    return multishot_codes(name, PROJECTOR_PX)


def captured(board, turn=(0.3, -0.3, 0.1), place=(0.0, 0.0, 900.0), **options):
    options = {"samples": 2, "noise": 1.5, **options}
    return BoardCaptures(rig(), board, turn, place, SEQUENCE.names, codes, **options)
