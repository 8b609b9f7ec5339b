"""Faults that only the pictures of several poses show, on rendered pictures of the simulated rig."""

import pytest

from pipeline.acquisition.guided_capture import GuidedCapture
from pipeline.acquisition.simulated_studio import SimulatedStudio, StudioFaults
from pipeline.calibration.board import Board
from pipeline.calibration.pose_guide import PoseGuide
from pipeline.errors import CalibrationError
from pipeline.simulation import simulated_truth

BOARD = Board(kind="chessboard", squares=(11, 8), square_mm=24.0)


@pytest.mark.parametrize(
    ("faults", "message", "n_poses"),
    [
        # Of the millimetre by which its edges are bent, the outermost corners, 9/11 from the middle, have two thirds.
        (StudioFaults(bow_mm=1.0), r"the board is bent by 0\.[67] ", 4),
        (StudioFaults(moved_from=6), r"pose-06 contradicts the poses before it .*: a lens has changed", 5),
    ],
)
def test_it_is_named_at_the_first_pose_that_shows_it(tmp_path, faults, message, n_poses):
    geometry = simulated_truth().geometry()
    studio = SimulatedStudio(BOARD, faults=faults, seed=5)
    guide = PoseGuide(BOARD, geometry.camera.size_px, geometry.projector.size_px, geometry.pattern)
    capture = GuidedCapture(studio, tmp_path, {}, lambda line: None, lambda line: None)
    capture.check_rig()
    with pytest.raises(CalibrationError, match=message):
        capture.take_poses(BOARD, guide)
    assert len(guide.poses) == n_poses
