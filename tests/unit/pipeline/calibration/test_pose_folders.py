"""Poses from folders: what is refused before minutes go into the geometry, and what is only left out."""

import numpy as np
import pytest

from pipeline.calibration import board_poses
from pipeline.calibration.board import Board
from pipeline.calibration.board_poses import measure_poses
from pipeline.calibration.multishot import multishot_sequence
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

    monkeypatch.setattr(board_poses, "measure_pose", measured)
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
    with pytest.raises(CalibrationError, match="0 usable poses, at least 1 are needed: black"):
        measure_poses(tmp_path, BOARD, SIZE, least=1)
    capture(tmp_path / "other", (32, 24))
    with pytest.raises(CalibrationError, match="other is 32x24, the poses before are 64x48"):
        measure_poses(tmp_path, BOARD, SIZE)
