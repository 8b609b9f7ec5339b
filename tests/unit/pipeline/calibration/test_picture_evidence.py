"""How sharp a pose's pictures are, and whether the board stood still meanwhile: against what was done to them."""

import cv2
import numpy as np
import pytest
from support.board_rig import MovedCaptures
from support.posed_boards import CHESSBOARD, PROJECTOR_PX, SEQUENCE, captured

from pipeline.calibration.board_poses import PictureEvidence, edge_blur_px, measure_pose


@pytest.mark.parametrize("blur_px", [0.8, 1.5, 3.0])
def test_the_blur_of_an_edge_is_found(blur_px):
    """To a tenth of it and 0.15 px, of a checkerboard with noise whose edges lie half-way between pixels."""
    y, x = np.mgrid[:120, :160] // 20
    grey = cv2.GaussianBlur(np.where((x + y) % 2 == 0, 0.1, 0.8), (0, 0), blur_px)
    grey += 0.004 * np.random.default_rng(1).standard_normal(grey.shape)
    corners = np.stack(np.meshgrid(np.arange(20, 160, 20), np.arange(20, 120, 20)), axis=-1).reshape(-1, 2) - 0.5
    assert edge_blur_px(grey, corners, 20.0) == pytest.approx(blur_px, rel=0.1, abs=0.15)


def test_corners_at_the_very_rim_tell_no_blur():
    assert np.isnan(edge_blur_px(np.zeros((40, 40)), np.array([[1.0, 1.0]]), 20.0))


def test_a_board_that_moves_between_its_pictures():
    """By half a millimetre, which is 0.6 px, from the fine columns on: found to a tenth of a pixel, and when."""
    before, after = captured(CHESSBOARD), captured(CHESSBOARD, place=(0.4, 0.25, 900.0))
    shift_px = np.linalg.norm([0.4, 0.25]) * 1232 / 900
    still = measure_pose("still", before, CHESSBOARD, PROJECTOR_PX).evidence
    moved = measure_pose("moved", MovedCaptures(before, after, SEQUENCE.names[10]), CHESSBOARD, PROJECTOR_PX).evidence
    assert still.moved_px < 0.03 and still.blur_px < 0.7
    assert moved.moved_px == pytest.approx(shift_px, abs=0.1)
    assert moved.moved_before == "10-column-fine-0"
    assert [name for name, _ in moved.drift_px][:3] == ["02-column-coarse-0", "06-column-middle-0", "10-column-fine-0"]


def test_what_was_not_looked_at_has_not_moved():
    assert PictureEvidence(1.0, ()).moved_px == 0
