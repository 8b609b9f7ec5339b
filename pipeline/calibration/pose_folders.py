"""A board's poses as they were captured: a folder a pose."""

from dataclasses import dataclass
from pathlib import Path

from pipeline.calibration.board import Board
from pipeline.calibration.board_poses import BoardPose, measure_pose
from pipeline.calibration.captures import CapturedFolder
from pipeline.calibration.multishot import multishot_sequence
from pipeline.calibration.rig_geometry import MIN_POSES
from pipeline.errors import CalibrationError


@dataclass(frozen=True)
class MeasuredPoses:
    """The poses that could be measured."""

    poses: list[BoardPose]
    refused: tuple[str, ...]  # why others could not, a sentence each
    camera_size_px: tuple[int, int]


def measure_poses(
    folder: Path,
    board: Board,
    projector_size_px: tuple[int, int],
    white_level: float | None = None,
    least: int = MIN_POSES,
) -> MeasuredPoses:
    """Find the board in every pose.

    Parameters
    ----------
    folder : Path
        With a folder a pose, each with the captures of `multishot_sequence` under the pictures' names.
    board : Board
        What stands there.
    projector_size_px : (width, height)
        The projector's.
    white_level : float, optional
        Full scale; None: the type's.
    least : int
        How many poses are needed.

    Raises
    ------
    CalibrationError
        The folder lacks captures, they differ in size, or the board is found in too few of them.
    """
    if not folder.is_dir():
        raise CalibrationError(f"{folder} is no folder: give the one with a folder a pose")
    names = multishot_sequence(projector_size_px).names
    poses: list[BoardPose] = []
    refused: list[str] = []
    camera_px = None
    for place in sorted(entry for entry in folder.iterdir() if entry.is_dir()):
        captures = CapturedFolder(place, names)
        height, width = captures[names[0]].shape[:2]
        if camera_px is not None and camera_px != (width, height):
            raise CalibrationError(f"{place} is {width}x{height}, the poses before are {camera_px[0]}x{camera_px[1]}")
        camera_px = (width, height)
        try:
            poses.append(measure_pose(place.name, captures, board, projector_size_px, white_level))
        except CalibrationError as error:
            refused.append(str(error))
    if camera_px is None or len(poses) < least:
        reason = refused[0] if refused else f"{folder} holds {len(poses)} folders of captures"
        raise CalibrationError(f"{len(poses)} usable poses, at least {least} are needed: {reason}")
    return MeasuredPoses(poses, tuple(refused), camera_px)
