"""A board in several poses in, both lenses and where they stand out: against the truth of a rendered rig."""

import cv2
import numpy as np
import pytest
from support.command_line import colorphase
from support.posed_boards import (
    CAMERA_PX,
    CHESSBOARD,
    PATTERN,
    PROJECTOR_PX,
    RIG_PX,
    captured,
    exact_poses,
    rig,
)

from pipeline import Calibration
from pipeline.calibration import ColorShift
from pipeline.calibration.board import Board
from pipeline.calibration.board_poses import BoardPose, measure_pose
from pipeline.calibration.model import Pattern
from pipeline.calibration.multishot import multishot_codes, multishot_sequence
from pipeline.calibration.rig_geometry import solve_geometry
from pipeline.calibration.simulated_board import BoardCaptures, board_turns
from pipeline.errors import CalibrationError
from pipeline.simulation import TYPICAL_CROSSTALK, simulated_rig


def lens_values(lens):
    return np.array([lens.matrix[0, 0], lens.matrix[1, 1], *lens.matrix[:2, 2], *lens.distortion])


def test_the_solver_on_noise_alone():
    """Within three of its own standard deviations; focal lengths to 0.2 %, the baseline to 0.2 mm of 180."""
    found = solve_geometry(exact_poses(), CAMERA_PX, PROJECTOR_PX, PATTERN)
    truth, calibration = rig(), found.calibration
    assert found.camera_rms_px < 0.15 and found.projector_rms_px < 0.15
    for name in ("camera", "projector"):
        off = lens_values(getattr(calibration, name)) - lens_values(getattr(truth, name))
        assert np.all(np.abs(off) < 3.5 * getattr(calibration.uncertainty, name)), name
        assert np.all(np.abs(off[:2]) < 0.002 * lens_values(getattr(truth, name))[:2])
    off = calibration.translation_mm - truth.translation_mm
    assert np.all(np.abs(off) < 3.5 * calibration.uncertainty.translation_mm)
    assert abs(np.linalg.norm(calibration.translation_mm) - 180) < 0.2
    assert 0 < calibration.uncertainty.depth_bias_mm < 1.0


def test_standard_deviations_are_honest():
    """Over six noisy rigs the errors, in their own deviations, have a spread of about one."""
    pulls = []
    for seed in range(6):
        found = solve_geometry(exact_poses(8, seed=seed), CAMERA_PX, PROJECTOR_PX, PATTERN).calibration
        for name in ("camera", "projector"):
            off = lens_values(getattr(found, name)) - lens_values(getattr(rig(), name))
            pulls.append((off / getattr(found.uncertainty, name))[:4])
        pulls.append((found.translation_mm - rig().translation_mm) / found.uncertainty.translation_mm)
    assert 0.6 < np.sqrt(np.mean(np.concatenate(pulls) ** 2)) < 1.4


def test_poses_that_are_left_out():
    """One that was moved between its pictures, and one that repeats another, by name."""
    poses = exact_poses(11)
    moved = poses[4]
    poses[4] = BoardPose(**{**moved.__dict__, "projector_px": moved.projector_px + np.array([3.0, -2.0])})
    poses.append(BoardPose(**{**poses[0].__dict__, "name": "again"}))
    found = solve_geometry(poses, CAMERA_PX, PROJECTOR_PX, PATTERN)
    assert dict(found.left_out).keys() == {"pose_04", "again"}
    assert "repeats pose_00" in dict(found.left_out)["again"]
    assert len(found.poses) == 10


def test_refused_sets_of_poses():
    with pytest.raises(CalibrationError, match="7 usable poses, at least 8"):
        solve_geometry(exact_poses(7), CAMERA_PX, PROJECTOR_PX, PATTERN)
    with pytest.raises(CalibrationError, match=r"1 usable poses.*repeats pose_00"):
        solve_geometry([exact_poses(1)[0]] * 9, CAMERA_PX, PROJECTOR_PX, PATTERN)
    with pytest.raises(CalibrationError, match=r"baseline comes out as 180.* squares are then 0\.5"):
        solve_geometry(exact_poses(), CAMERA_PX, PROJECTOR_PX, PATTERN, baseline_mm=90.0)
    with pytest.raises(CalibrationError, match="baseline is given as 0 mm"):
        solve_geometry(exact_poses(), CAMERA_PX, PROJECTOR_PX, PATTERN, baseline_mm=0.0)
    with pytest.raises(CalibrationError, match="camera and projector are swapped"):
        solve_geometry(exact_poses(), PROJECTOR_PX, CAMERA_PX, PATTERN)
    with pytest.raises(CalibrationError, match=r"period of 900 px does not fit"):
        solve_geometry(exact_poses(), CAMERA_PX, PROJECTOR_PX, Pattern(period_px=900))
    with pytest.raises(CalibrationError, match=r"another camera, of 320x240"):
        solve_geometry(exact_poses(), CAMERA_PX, PROJECTOR_PX, PATTERN, simulated_rig((320, 240)))
    with pytest.raises(CalibrationError, match=r"vertical stripes run along .* calibrate for horizontal ones"):
        solve_geometry(exact_poses(), CAMERA_PX, PROJECTOR_PX, Pattern(period_px=16, stripes="vertical"))


def test_poses_that_are_all_parallel():
    """They tell no focal length, however the board is tilted."""
    places = np.random.default_rng(1).uniform((-60, -40, 800), (60, 40, 1000), (10, 3))
    with pytest.raises(CalibrationError, match="too much alike"):
        solve_geometry(exact_poses(turns=[np.array([0.4, 0.1, 0.05])] * 10, places=places), *RIG_PX, PATTERN)


def test_an_earlier_lateral_colour_is_not_kept():
    shift = ColorShift(camera=np.zeros((3, 2)), projector=np.full((3, 2), 0.5))
    base = Calibration(crosstalk_matrix=np.eye(3), color_shift_px=shift)
    assert solve_geometry(exact_poses(), *RIG_PX, PATTERN, base).calibration.color_shift_px is None
    poses = [BoardPose(**{**pose.__dict__, "camera_shift_px": np.full((3, 2), np.nan)}) for pose in exact_poses()]
    assert solve_geometry(poses, *RIG_PX, PATTERN, base).calibration.color_shift_px is None


def test_a_projector_upside_down():
    """Half a turn about the camera's axis: rotation vectors flip their sign there."""
    half = np.diag([-1.0, -1.0, 1.0])
    hanging = rig().model_copy(
        update={"rotation": half @ rig().rotation, "translation_mm": half @ rig().translation_mm}
    )
    found = solve_geometry(exact_poses(geometry=hanging.geometry()), *RIG_PX, PATTERN).calibration
    np.testing.assert_allclose(found.rotation, hanging.rotation, atol=0.003)
    assert abs(np.linalg.norm(found.translation_mm) - 180) < 0.2


@pytest.mark.parametrize("shown", [(0,), (0, 4)])
def test_lateral_colour_is_found(shown):
    """To 0.05 px, though the camera's channels see each other's light."""
    camera = np.array([[-0.3, -0.4], [0.0, 0.0], [0.2, 0.5]])
    projector = np.array([[0.2, 0.3], [0.0, 0.0], [-0.1, -0.5]])
    options = {"camera_shift": camera, "projector_shift": projector, "crosstalk": TYPICAL_CROSSTALK}
    poses = exact_poses(9)
    turns, places = board_turns(10, 3)
    seen = [
        measure_pose(
            poses[k].name, captured(CHESSBOARD, turns[k], places[k], seed=k, **options), CHESSBOARD, PROJECTOR_PX
        )
        for k in shown
    ]
    shifts = {"camera_shift_px": seen[0].camera_shift_px, "projector_shift_px": seen[0].projector_shift_px}
    others = [BoardPose(**{**pose.__dict__, **shifts, "jacobian": seen[0].jacobian}) for pose in poses]
    poses = [*seen, *(pose for k, pose in enumerate(others) if k not in shown)]
    base = Calibration(crosstalk_matrix=np.array(TYPICAL_CROSSTALK))
    found = solve_geometry(poses, CAMERA_PX, PROJECTOR_PX, PATTERN, base).calibration
    np.testing.assert_allclose(found.color_shift_px.camera, camera - camera.mean(axis=0), atol=0.05)
    np.testing.assert_allclose(found.color_shift_px.projector, projector - projector.mean(axis=0), atol=0.05)


def test_the_command(tmp_path):
    """Eight folders of captures in, a calibration out; never over an existing one."""
    small = (320, 240)
    names = multishot_sequence(small).names
    camera = simulated_rig((320, 240))
    # A projector of 320x240 with the field of view of the larger one.
    lens = camera.geometry().projector
    matrix = lens.matrix * np.array([[0.3125] * 3, [0.3125] * 3, [1.0] * 3])
    own = camera.model_copy(update={"projector": lens.model_copy(update={"size_px": small, "matrix": matrix})})
    board = Board(kind="chessboard", squares=(8, 6), square_mm=32.0)
    turns, places = board_turns(8, 5)
    for k in range(8):
        folder = tmp_path / "poses" / f"pose_{k}"
        folder.mkdir(parents=True)
        captures = BoardCaptures(
            own, board, turns[k], places[k], names, lambda name: multishot_codes(name, small), samples=2, seed=k
        )
        for name in names:
            cv2.imwrite(str(folder / f"{name}.png"), captures[name][..., ::-1])

    def run(*arguments):
        return colorphase("calibrate", "geometry", *arguments, cwd=tmp_path)

    arguments = ("poses", "--out", "c.json", "--size", "320x240", "--period", "8", "--square-mm", "32")
    done = run(*arguments, "--board", "chessboard", "--squares", "8x6")
    assert done.returncode == 0, done.stderr
    found = Calibration.read(tmp_path / "c.json")
    assert found.pattern.period_px == 8
    assert abs(np.linalg.norm(found.translation_mm) - 180) < 2
    done = run(*arguments, "--board", "chessboard", "--squares", "8x6")
    assert done.returncode == 1 and "exists already" in done.stderr
    (tmp_path / "poses" / "pose_3" / f"{names[7]}.png").unlink()
    done = run(*arguments, "--board", "chessboard", "--squares", "8x6", "--force")
    assert done.returncode == 1 and names[7] in done.stderr and "pose_3" in done.stderr
    done = run("--make", "pictures", "--size", "64x48")
    assert done.returncode == 0 and len(list((tmp_path / "pictures").iterdir())) == len(names) + 1
