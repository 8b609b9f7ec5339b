"""A board's poses: their corners in camera and projector, how their pictures were taken, and their folders."""

import cv2
import numpy as np
import pytest
from support.board_rig import MovedCaptures
from support.posed_boards import CHARUCO, CHESSBOARD, PROJECTOR_PX, captured, rig
from support.slide_shows import film

from pipeline.calibration import board_poses
from pipeline.calibration.board import Board
from pipeline.calibration.board_poses import PictureEvidence, edge_blur_px, measure_pose, measure_poses
from pipeline.calibration.captures import CapturedFolder
from pipeline.calibration.multishot import multishot_sequence
from pipeline.errors import CalibrationError, FootageError
from pipeline.models import SensorPart
from pipeline.output.range_image import write_png
from pipeline.recording.recorder import Recorder
from tikernels.raw.pixel_format import PixelFormat

SIZE = (64, 48)
BOARD = Board(kind="chessboard", squares=(9, 6), square_mm=20.0)


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


def test_a_board_that_moves_between_its_pictures(of_chessboard):
    """By half a millimetre, which is 0.6 px, from the row pictures on: found to a tenth of a pixel, and when."""
    before, after = of_chessboard, captured(CHESSBOARD, place=(0.4, 0.25, 900.0))
    shift_px = np.linalg.norm([0.4, 0.25]) * 1232 / 900
    still = measure_pose("still", before, CHESSBOARD, PROJECTOR_PX).evidence
    moved = measure_pose("moved", MovedCaptures(before, after, "07-row-digit-0"), CHESSBOARD, PROJECTOR_PX).evidence
    assert still.moved_px < 0.03 and still.blur_px < 0.7
    assert moved.moved_px == pytest.approx(shift_px, abs=0.1)
    assert moved.moved_before == "09-row-fringe-0"
    assert [name for name, _ in moved.drift_px] == ["04-column-fringe-0", "09-row-fringe-0"]


def test_what_was_not_looked_at_has_not_moved():
    assert PictureEvidence(1.0, ()).moved_px == 0


@pytest.mark.parametrize("board", [CHESSBOARD, CHARUCO], ids=["chessboard", "charuco"])
def test_corners_of_one_pose(board, of_charuco, of_chessboard):
    """In camera and projector to 0.15 px; a chessboard may be numbered from either end."""
    captures = of_charuco if board is CHARUCO else of_chessboard
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
        ({"place": (400.0, 0.0, 900.0)}, "9x6 charuco is seen|px see the fringes|hardly brighter"),
        ({"hide": (slice(None), slice(100, None))}, "corners are seen|9x6 charuco is seen"),
        ({"blur_px": 9.0}, "of white's light: focus"),
    ],
)
def test_refused_captures(options, message):
    with pytest.raises(CalibrationError, match=message) as raised:
        measure_pose("pose_07", captured(CHARUCO, samples=1, **options), CHARUCO, PROJECTOR_PX)
    assert "pose_07" in str(raised.value) and "\n" not in str(raised.value)


def test_a_board_that_is_partly_hidden():
    """A ChArUco board still serves."""
    pose = measure_pose("p", captured(CHARUCO, hide=(slice(None), slice(0, 160))), CHARUCO, PROJECTOR_PX)
    assert 12 <= len(pose.corners_mm) < 40


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
        assert (board, projector_size_px, white_level, len(captures)) == (BOARD, SIZE, 200.0, 12)
        return name

    monkeypatch.setattr(board_poses, "measure_pose", measured)
    found = measure_poses(tmp_path, BOARD, SIZE, 200.0)
    assert found.poses == [f"pose{number:02d}" for number in range(1, 11) if number != 4]
    assert found.refused == ("pose04: no board is seen",)
    assert found.camera_size_px == SIZE


def test_too_few_poses_are_refused_with_the_first_reason(tmp_path):
    with pytest.raises(FootageError, match=r"cannot read .*none: there is no such file"):
        measure_poses(tmp_path / "none", BOARD, SIZE)
    with pytest.raises(FootageError, match="holds no pictures"):
        measure_poses(tmp_path, BOARD, SIZE)
    capture(tmp_path / "black")
    with pytest.raises(CalibrationError, match="0 usable poses, at least 8 are needed: black"):
        measure_poses(tmp_path, BOARD, SIZE)
    with pytest.raises(CalibrationError, match="0 usable poses, at least 1 are needed: black"):
        measure_poses(tmp_path, BOARD, SIZE, least=1)
    capture(tmp_path / "other", (32, 24))
    with pytest.raises(CalibrationError, match="other is 32x24, the poses before are 64x48"):
        measure_poses(tmp_path, BOARD, SIZE)


def test_poses_of_two_parts_of_the_sensor_are_refused(tmp_path, monkeypatch):
    poses = []
    for x, name in enumerate("ab"):
        capture(tmp_path / name)
        poses.append((name, CapturedFolder(tmp_path / name, multishot_sequence(SIZE).names)))
        poses[x][1].sensor = SensorPart(sensor_px=(99, 80), offset_px=(x, 0), binning=(1, 1))
    monkeypatch.setattr(board_poses, "find_poses", lambda *place: poses)
    with pytest.raises(CalibrationError, match=r"^b shows another part of the sensor than the poses before"):
        measure_poses(tmp_path, BOARD, SIZE)


def test_a_pose_in_a_recording_is_the_one_in_a_folder(tmp_path, of_chessboard):
    """In a recording without names, with other things before and after, to what noise moves corners."""
    pictures = list(of_chessboard.values())
    (tmp_path / "named").mkdir()
    for name, picture in of_chessboard.items():
        write_png(tmp_path / "named" / f"{name}.png", picture)
    frames, _ = film([pictures[7], *pictures, pictures[3]], 1, dwell=(3.5, 5.0), noise=1.0)
    part = SensorPart(sensor_px=(2000, 1500), offset_px=(1, 2), binning=(1, 1))
    with Recorder(tmp_path / "show.zarr", PixelFormat("rgb"), sensor=part) as recorder:
        for frame in frames:
            recorder.add(frame)
    both = [measure_poses(tmp_path / place, CHESSBOARD, PROJECTOR_PX, least=1) for place in ("named", "show.zarr")]
    assert [measured.sensor for measured in both] == [None, part]
    named, recorded = (measured.poses[0] for measured in both)
    assert (named.name, recorded.name) == ("named", "show.zarr")
    assert len(named.camera_px) == len(CHESSBOARD.corners_mm())
    np.testing.assert_allclose(recorded.camera_px, named.camera_px, atol=0.1)
    np.testing.assert_allclose(recorded.projector_px, named.projector_px, atol=0.3)
