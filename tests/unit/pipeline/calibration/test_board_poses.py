"""A board's corners in camera and projector, from the captures of one pose."""

import cv2
import numpy as np
import pytest
from support.posed_boards import CHARUCO, CHESSBOARD, PROJECTOR_PX, captured, rig

from pipeline.calibration.board_poses import measure_pose
from pipeline.errors import CalibrationError


@pytest.mark.parametrize("board", [CHESSBOARD, CHARUCO], ids=["chessboard", "charuco"])
def test_corners_of_one_pose(board, of_charuco):
    """In camera and projector to 0.15 px; a chessboard may be numbered from either end."""
    captures = of_charuco if board is CHARUCO else captured(board)
    pose = measure_pose("pose", captures, board, PROJECTOR_PX)
    geometry = rig().geometry()
    truth = captures.corners_camera
    camera, _ = cv2.projectPoints(truth, np.zeros(3), np.zeros(3), geometry.camera.matrix, geometry.camera.distortion)
    projector, _ = cv2.projectPoints(
        truth, cv2.Rodrigues(geometry.rotation)[0], geometry.translation_mm, geometry.projector.matrix,
        geometry.projector.distortion,
    )  # fmt: skip
    nearest = np.linalg.norm(pose.camera_px[:, None] - camera.reshape(-1, 2), axis=-1).argmin(axis=1)
    assert len(set(nearest)) == len(pose.corners_mm) >= 0.9 * len(truth)
    for found, true in ((pose.camera_px, camera), (pose.projector_px, projector)):
        off = np.linalg.norm(found - true.reshape(-1, 2)[nearest], axis=1)
        assert np.sqrt((off**2).mean()) < 0.15
    if board.kind == "charuco":
        np.testing.assert_array_equal(board.corners_mm()[nearest], pose.corners_mm)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"mirror": True}, "mirrored"),
        ({"place": (400.0, 0.0, 900.0)}, "9x6 charuco is seen|hardly a pixel|hardly brighter"),
        ({"hide": (slice(None), slice(100, None))}, "corners are seen|9x6 charuco is seen"),
        ({"blur_px": 9.0}, "washed out"),
    ],
)
def test_refused_captures(options, message):
    with pytest.raises(CalibrationError, match=message) as raised:
        measure_pose("pose_07", captured(CHARUCO, **options), CHARUCO, PROJECTOR_PX)
    assert "pose_07" in str(raised.value) and "\n" not in str(raised.value)


def test_a_board_that_is_partly_hidden():
    """A ChArUco board still serves."""
    pose = measure_pose("p", captured(CHARUCO, hide=(slice(None), slice(0, 160))), CHARUCO, PROJECTOR_PX)
    assert 12 <= len(pose.corners_mm) < 40
