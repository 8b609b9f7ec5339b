"""`colorphase calibrate geometry` as its user meets it, the search for corners left out."""

import json
from pathlib import Path

import numpy as np
import pytest
from support.posed_boards import CAMERA_PX, exact_poses

from pipeline.calibration.board import Board
from pipeline.calibration.board_poses import MeasuredPoses
from pipeline.cli import calibrate

ARGUMENTS = ("calibrate", "geometry", "poses", "--board", "chessboard", "--squares", "10x7", "--code", "none")
SECOND = ("--second-board", "second", "--second-square-mm", "20")


@pytest.fixture
def posed(monkeypatch):
    """Have the corners of boards with squares of 26 and 20 mm found in the folders, whatever they are said to be."""

    def measured(folder, board, size_px, white_level, least=8):
        true_mm, count = (20.0, least) if folder == Path("second") else (26.0, 10)
        seen = exact_poses(count, 0.01, Board(kind="chessboard", squares=(10, 7), square_mm=true_mm))
        said = [
            type(pose)(**{**pose.__dict__, "corners_mm": pose.corners_mm * (board.square_mm / true_mm)})
            for pose in seen
        ]
        return MeasuredPoses(said, ("pose_99: no board is seen",), CAMERA_PX)

    monkeypatch.setattr(calibrate, "measure_poses", measured)


def test_a_verdict_follows_the_figures(posed, command, tmp_path):
    done = command(*ARGUMENTS, "--square-mm", "26", *SECOND, "--out", "rig.json")
    assert done.returncode == 0, done.stderr
    assert "depth bias to be expected" in done.stdout and "note: pose_99: no board is seen" in done.stdout
    worst, verdict, scale, wrote = done.stdout.strip().splitlines()[-4:]
    assert worst.startswith("worst pose: pose_0") and "it does not stand out" in worst
    assert verdict.startswith("good: 9") and "mm a point" in verdict
    assert scale == "scale proven by the second board; camera and projector stand 180.0 mm apart"
    assert wrote == "wrote rig.json"
    assert json.loads((tmp_path / "rig.json").read_text())["scale_proof"] == "second board"


def test_squares_that_are_wrong_by_a_quarter(posed, command, tmp_path):
    """Unproven they pass, and are said to be unproven; either proof refuses them in one line, and writes nothing."""
    wrong = (*ARGUMENTS, "--square-mm", "32.5", "--out", "rig.json")
    for proof, message in (
        (SECOND, "mm, not 20; if the second's are 20 mm, the first's are 26.0"),
        (("--baseline-mm", "180"), "the squares are then 0.80"),
    ):
        done = command(*wrong, *proof)
        assert done.returncode == 1 and message in done.stderr and len(done.stderr.strip().splitlines()) == 1
        assert not (tmp_path / "rig.json").exists()
    done = command(*wrong)
    assert done.returncode == 0, done.stderr
    assert "scale unproven: only --square-mm tells it, and camera and projector stand 225 mm apart" in done.stdout
    found = json.loads((tmp_path / "rig.json").read_text())
    assert found["scale_proof"] is None
    assert abs(np.linalg.norm(found["translation_mm"]) - 225) < 0.5


def test_half_a_second_board_is_refused(command):
    for half in (SECOND[:2], SECOND[2:]):
        done = command(*ARGUMENTS, "--out", "rig.json", *half)
        assert done.returncode == 1 and "give --second-board and --second-square-mm" in done.stderr
