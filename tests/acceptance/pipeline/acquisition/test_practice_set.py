"""The captures to practise on: whole, or not at all; and what a calibration makes of them, faults put in or not."""

import cv2
import numpy as np
import pytest
from support.board_rig import MovedCaptures

from pipeline.acquisition import practice_set
from pipeline.acquisition.practice_set import (
    BALL_MIDDLE_MM,
    BALL_RADIUS_MM,
    BOARD,
    SECOND_BOARD,
    practice_poses,
    practice_rig,
    write_practice,
)
from pipeline.calibration.board_poses import measure_pose
from pipeline.calibration.model import DEFAULT_PROJECTOR_PX
from pipeline.calibration.rig_geometry import SecondBoard, solve_geometry
from pipeline.calibration.simulated_board import BoardCaptures
from pipeline.errors import CalibrationError, OutputError
from pipeline.simulation import SimulationSettings, simulate_frame

CAMERA_PX = practice_rig().geometry().camera.size_px
PATTERN = practice_rig().geometry().pattern


def measured(name, captures, board=BOARD):
    return measure_pose(name, captures, board, DEFAULT_PROJECTOR_PX)


def solved(poses, **proof):
    return solve_geometry(poses, CAMERA_PX, DEFAULT_PROJECTOR_PX, PATTERN, **proof)


@pytest.fixture(scope="module")
def captures():
    """Return the captures of the ten poses."""
    return list(practice_poses(BOARD, 10, 1))


@pytest.fixture(scope="module")
def poses(captures):
    return [measured(f"pose-{k:02d}", pose) for k, pose in enumerate(captures, start=1)]


def test_the_board_is_seen_whole_and_at_the_rims():
    """Every outline lies in the picture; all together they come within 12 px of each of its sides."""
    lens, outlines = practice_rig().geometry().camera, []
    for board, count, seed in ((BOARD, 10, 1), (SECOND_BOARD, 2, 2)):
        for pose in practice_poses(board, count, seed):
            columns, rows = board.squares
            corners = np.array([[x, y, 0] for x in (0, columns) for y in (0, rows)], float) * board.square_mm
            placed = (corners - corners.mean(axis=0)) @ cv2.Rodrigues(pose.turn)[0].T + pose.place_mm
            pixels, _ = cv2.projectPoints(placed, np.zeros(3), np.zeros(3), lens.matrix, lens.distortion)
            outlines.append(pixels.reshape(-1, 2))
    seen = np.concatenate(outlines)
    size = np.array(CAMERA_PX)
    assert (seen > 3).all() and (seen < size - 4).all()
    assert (seen.min(axis=0) < 12).all() and (seen.max(axis=0) > size - 12).all()


def test_the_ball_is_where_it_is_said_to_be(cpu):
    truth = simulate_frame(practice_rig(), SimulationSettings(scene="ball"))
    distance = np.linalg.norm(truth.points - BALL_MIDDLE_MM, axis=-1)
    on_ball = truth.points[..., 2] < 950
    assert on_ball.sum() > 20_000
    # A ray that grazes the ball stops short of it.
    assert np.mean(np.abs(distance[on_ball] - BALL_RADIUS_MM) < 0.05) > 0.998


def test_nothing_stays_of_a_set_that_was_interrupted(cpu, tmp_path, monkeypatch):
    def interrupted(what):
        if "pose" in what:
            raise KeyboardInterrupt

    monkeypatch.setattr(practice_set, "_write_light", lambda folder, rig, notify: folder.mkdir())
    with pytest.raises(KeyboardInterrupt):
        write_practice(tmp_path / "practice", "cpu", interrupted)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "practice").mkdir()
    with pytest.raises(OutputError, match="practice exists already"):
        write_practice(tmp_path / "practice", "cpu", print)
    with pytest.raises(OutputError, match=r"cannot write .*: its folder is a file"):
        (tmp_path / "file").touch()
        write_practice(tmp_path / "file" / "practice", "cpu", print)


def test_the_practised_geometry_is_the_true_one(poses):
    """Focal lengths within 0.1 %, the baseline within 0.3 mm of 180, all within three and a half deviations."""
    second = [measured(f"second-{k}", pose, SECOND_BOARD) for k, pose in enumerate(practice_poses(SECOND_BOARD, 2, 2))]
    found = solved(poses, second=SecondBoard(second, SECOND_BOARD.square_mm, BOARD.square_mm))
    truth = practice_rig()
    assert found.calibration.scale_proof == "second board" and found.left_out == ()
    assert abs(np.linalg.norm(found.calibration.translation_mm) - 180) < 0.3
    for name in ("camera", "projector"):
        lens, true, sigma = (getattr(rig, name) for rig in (found.calibration, truth, found.calibration.uncertainty))
        off = np.diag(lens.matrix)[:2] - np.diag(true.matrix)[:2]
        assert np.all(np.abs(off) < 3.5 * sigma[:2]) and np.all(np.abs(off) < 1e-3 * np.diag(true.matrix)[:2])
    assert not found.verdict.poses[0].stands_out and found.verdict.poses[0].causes == ()
    assert found.verdict.grade != "poor"


@pytest.mark.parametrize(("step_mm", "fits"), [((0.3, 0.2, 0.0), True), ((0.3, 0.2, 2.0), False)])
def test_a_pose_that_moved_is_named_with_what_moved(captures, poses, step_mm, fits):
    """Between the column and the row pictures: in its plane it still fits, towards the camera it is the worst one."""
    still, rig = captures[3], practice_rig()
    place = still.place_mm + np.array(step_mm)
    after = BoardCaptures(rig, BOARD, still.turn, place, still.names, still.codes, still.light, seed=9)
    pose = measured("pose-04", MovedCaptures(still, after, "07-row-digit-0"))
    found = solved([*poses[:3], pose, *poses[4:]])
    (judged,) = (judged for judged in found.verdict.poses if judged.name == "pose-04")
    assert "it moved: from 09-row-fringe-0 on" in judged.in_words()
    assert (judged is found.verdict.poses[0]) == (judged.rms_px[0] > 2 * judged.usual_px[0]) == (not fits)


def test_a_blurred_pose_is_named_with_its_blur(captures, poses):
    """A sigma of 3 px: its corners still lie in place, so that it need not be the worst."""
    pose = measured("pose-07", {name: cv2.GaussianBlur(captures[6][name], (0, 0), 3.0) for name in captures[6]})
    assert pose.evidence.blur_px == pytest.approx(3.0, rel=0.1)
    found = solved([*poses[:6], pose, *poses[7:]])
    (blurred,) = (judged for judged in found.verdict.poses if judged.name == "pose-07")
    assert blurred.causes[0].startswith("it is blurred (edges have a sigma of 3.0 px, elsewhere 0.4)")


def test_a_board_of_another_size_is_caught_by_a_proof(poses):
    """Squares given as 27.5 mm that are 22 mm."""
    wrong = [type(pose)(**{**pose.__dict__, "corners_mm": 1.25 * pose.corners_mm}) for pose in poses]
    second = [measured("second", next(practice_poses(SECOND_BOARD, 2, 2)), SECOND_BOARD)]
    assert solved(wrong).calibration.scale_proof is None
    with pytest.raises(CalibrationError, match=r"baseline comes out as 225"):
        solved(wrong, baseline_mm=180.0)
    with pytest.raises(CalibrationError, match=r"second's are 22\.\d+ ± 0\.\d+ mm, not 18"):
        solved(wrong, second=SecondBoard(second, 18.0, 27.5))


def test_a_board_that_is_never_tilted_is_refused(captures):
    """All parallel to the picture: no lens follows from it."""
    flat = []
    for k, pose in enumerate(captures[:9]):
        straight = BoardCaptures(
            practice_rig(),
            BOARD,
            (0, 0, 0.1 * k),
            pose.place_mm * [0.5, 0.5, 1],
            pose.names,
            pose.codes,
            pose.light,
            seed=k,
        )
        flat.append(measured(f"flat {k}", straight))
    with pytest.raises(CalibrationError, match="too much alike"):
        solved(flat)
