<<<<<<< HEAD
"""Poses from folders: what is refused before minutes go into the geometry, and what is only left out."""

import numpy as np
import pytest

from pipeline.calibration import pose_folders
from pipeline.calibration.board import Board
from pipeline.calibration.multishot import multishot_sequence
from pipeline.calibration.pose_folders import measure_poses
from pipeline.errors import CalibrationError
from pipeline.output.range_image import write_png

SIZE = (64, 48)
BOARD = Board(kind="chessboard", squares=(9, 6), square_mm=20.0)


def capture(folder, size_px=SIZE):
    folder.mkdir(parents=True)
    for name in multishot_sequence(SIZE).names:
        write_png(folder / f"{name}.png", np.zeros((size_px[1], size_px[0], 3), np.uint8))


def test_each_folder_is_a_pose_in_the_order_of_their_names(tmp_path, monkeypatch):
    for number in (2, 1, *range(3, 11)):
        capture(tmp_path / f"pose{number:02d}")
    (tmp_path / "notes.txt").touch()

    def measured(name, captures, board, projector_size_px, white_level):
        if name == "pose04":
            raise CalibrationError("pose04: no board is seen")
        assert (board, projector_size_px, white_level, len(captures)) == (BOARD, SIZE, 200.0, 30)
        return name

    monkeypatch.setattr(pose_folders, "measure_pose", measured)
    found = measure_poses(tmp_path, BOARD, SIZE, 200.0)
    assert found.poses == [f"pose{number:02d}" for number in range(1, 11) if number != 4]
    assert found.refused == ("pose04: no board is seen",)
    assert found.camera_size_px == SIZE


def test_too_few_poses_are_refused_with_the_first_reason(tmp_path):
    with pytest.raises(CalibrationError, match=r"none is no folder: give the one with a folder a pose"):
        measure_poses(tmp_path / "none", BOARD, SIZE)
    with pytest.raises(CalibrationError, match=r"0 usable poses, at least 8 .* holds 0 folders of captures"):
        measure_poses(tmp_path, BOARD, SIZE)
    capture(tmp_path / "black")
    with pytest.raises(CalibrationError, match="0 usable poses, at least 8 are needed: black"):
        measure_poses(tmp_path, BOARD, SIZE)
    capture(tmp_path / "other", (32, 24))
    with pytest.raises(CalibrationError, match="other is 32x24, the poses before are 64x48"):
        measure_poses(tmp_path, BOARD, SIZE)
=======
"""Folders of a board's poses, those that are none, and captures that do not belong together."""

import cv2
import numpy as np
import pytest
from support.posed_boards import CHARUCO, PROJECTOR_PX, SEQUENCE

from pipeline.calibration import pose_folders
from pipeline.calibration.pose_folders import measure_poses
from pipeline.errors import CalibrationError


def write_pose(folder, size_px=(40, 30)):
    folder.mkdir(parents=True)
    picture = cv2.imencode(".png", np.zeros((*size_px[::-1], 3), np.uint8))[1].tobytes()
    for name in SEQUENCE.names:
        (folder / f"{name}.png").write_bytes(picture)


def test_what_is_no_folder_of_poses(tmp_path):
    with pytest.raises(CalibrationError, match="give the one with a folder a pose"):
        measure_poses(tmp_path / "none", CHARUCO, PROJECTOR_PX)
    with pytest.raises(CalibrationError, match=r"0 usable poses, at least \d+ are needed: .* holds 0 folders"):
        measure_poses(tmp_path, CHARUCO, PROJECTOR_PX)


def test_a_capture_that_is_missing_is_named_with_its_pose(tmp_path):
    write_pose(tmp_path / "pose_1")
    (tmp_path / "pose_1" / f"{SEQUENCE.names[7]}.png").unlink()
    with pytest.raises(CalibrationError, match=rf"pose_1 lacks the capture {SEQUENCE.names[7]}\.png"):
        measure_poses(tmp_path, CHARUCO, PROJECTOR_PX)


def test_poses_of_two_cameras_do_not_mix(tmp_path, monkeypatch):
    write_pose(tmp_path / "pose_1")
    write_pose(tmp_path / "pose_2", (20, 30))
    monkeypatch.setattr(pose_folders, "measure_pose", lambda *arguments: None)
    with pytest.raises(CalibrationError, match="pose_2 is 20x30, the poses before are 40x30"):
        measure_poses(tmp_path, CHARUCO, PROJECTOR_PX)


def test_too_few_usable_poses_say_what_the_first_one_lacks(tmp_path):
    write_pose(tmp_path / "pose_1")
    with pytest.raises(CalibrationError, match=r"0 usable poses, .*: pose_1: 00-white is hardly brighter"):
        measure_poses(tmp_path, CHARUCO, PROJECTOR_PX)


def test_poses_that_cannot_be_used_are_told_beside_the_others(tmp_path, monkeypatch):
    for number in range(9):
        write_pose(tmp_path / f"pose_{number}")

    def measured(name, *_):
        if name == "pose_3":
            raise CalibrationError("pose_3: no board is seen")
        return name

    monkeypatch.setattr(pose_folders, "measure_pose", measured)
    found = measure_poses(tmp_path, CHARUCO, PROJECTOR_PX)
    assert found.poses == [f"pose_{number}" for number in range(9) if number != 3]
    assert found.refused == ("pose_3: no board is seen",)
    assert found.camera_size_px == (40, 30)
>>>>>>> refs/heads/tests
