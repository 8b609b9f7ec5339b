"""Boards in a pose before the rig that calibration is tested with."""

from dataclasses import replace

import cv2
import numpy as np
from support.board_rig import SpoiltCaptures

from pipeline.calibration.board import Board
from pipeline.calibration.board_poses import BoardPose
from pipeline.calibration.model import Pattern
from pipeline.calibration.multishot import multishot_codes, multishot_sequence
from pipeline.calibration.simulated_board import board_turns
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
    return SpoiltCaptures(rig(), board, turn, place, SEQUENCE.names, codes, **options)


def exact_poses(
    count=10, noise_px=0.03, board=CHESSBOARD, seed=3, turns=None, places=None, geometry=None, bow_mm=0.0
):  # fmt: skip
    """Return poses whose corners are projected, not looked for: what the solver makes of noise alone.

    The board's left and right edges are bent by `bow_mm`.
    """
    rng = np.random.default_rng(seed)
    geometry = geometry or rig().geometry()
    turns, places = (turns, places) if turns is not None else board_turns(count, seed)
    poses = []
    for k, (turn, place) in enumerate(zip(turns, places, strict=True)):
        rotation = cv2.Rodrigues(turn)[0]
        corners = board.corners_mm() - board.corners_mm().mean(axis=0)
        corners[:, 2] += bow_mm * (corners[:, 0] / corners[:, 0].max()) ** 2
        corners = corners @ rotation.T + place
        views = []
        for lens, r, t in (
            (geometry.camera, np.eye(3), np.zeros(3)),
            (geometry.projector, geometry.rotation, geometry.translation_mm),
        ):
            pixels, _ = cv2.projectPoints(corners, cv2.Rodrigues(r)[0], t, lens.matrix, lens.distortion)
            views.append(pixels.reshape(-1, 2) + noise_px * rng.standard_normal((len(corners), 2)))
        shift = np.zeros((3, 2))
        poses.append(BoardPose(f"pose_{k:02d}", board.corners_mm(), *views, shift, shift, np.eye(2)))
    return poses


def scaled(poses, factor):
    """Return poses of a board whose squares are said to be this many times as large as they are."""
    return [replace(pose, corners_mm=factor * pose.corners_mm) for pose in poses]
