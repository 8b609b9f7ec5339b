"""What proves the scale of a geometry, which else only the board's squares tell.

Corners in camera and projector tell every length but for one factor; the side of the board's squares sets it. So a side
that is wrong by a quarter makes every length wrong by a quarter, and leaves no residual. A second length tells: the
baseline, measured by hand; or a board whose squares are of another side, seen by the calibrated rig.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from pipeline.calibration.board_poses import BoardPose
from pipeline.calibration.bundle_adjustment import BundleAdjustment
from pipeline.calibration.model import ScaleProof
from pipeline.errors import CalibrationError
from pipeline.models import FloatArray

# A measured baseline that differs from the user's by a greater part shows a wrong square size: by hand, from lens to
# lens, it is known to some millimetres in two hundred.
_MAX_BASELINE_ERROR = 0.02
# Two boards may disagree by this many standard deviations of the fit ...
_SIGMAS = 4.0
# ... or by this part: ten squares of 20 mm each are measured to half a millimetre with a ruler, on both boards.
_MAX_BOARD_ERROR = 0.005
# Corners of a second board that lie this many times as far off as the first one's show a pose that moved.
_OUTLIER = 3.0
# Gauss-Newton steps; from a start within some per cent four are enough.
_STEPS = 10
# By which part the scale is changed for its derivative.
_DIFFERENCE = 1e-4


class SecondBoard(NamedTuple):
    """Poses of a board whose squares have another side, and the two sides, each measured by itself."""

    poses: Sequence[BoardPose]
    square_mm: float
    first_square_mm: float


def prove_scale(fit: BundleAdjustment, baseline_mm: float | None, second: SecondBoard | None) -> ScaleProof | None:
    """Return what proves the scale of a fit; None: nothing.

    Parameters
    ----------
    fit : BundleAdjustment
        Of the first board.
    baseline_mm : float, optional
        The measured distance between camera and projector.
    second : SecondBoard, optional
        The second board.

    Raises
    ------
    CalibrationError
        The baseline or the second board contradicts the fit, or cannot tell anything.
    """
    if baseline_mm is not None:
        _check_baseline(fit, baseline_mm)
    if second is None:
        return None if baseline_mm is None else "baseline"
    _check_second_board(fit, second)
    return "second board"


def _check_baseline(fit: BundleAdjustment, baseline_mm: float) -> None:
    """Refuse a fit whose baseline is not the measured one."""
    if not baseline_mm > 0:
        raise CalibrationError(f"the baseline is given as {baseline_mm:g} mm: measure it from lens to lens")
    found = float(np.linalg.norm(fit.stereo[3:]))
    if abs(found / baseline_mm - 1) > _MAX_BASELINE_ERROR:
        raise CalibrationError(
            f"the baseline comes out as {found:.1f} mm but is {baseline_mm:.1f} mm: the squares are then "
            f"{baseline_mm / found:.4f} times as large as given"
        )


def _check_second_board(fit: BundleAdjustment, second: SecondBoard) -> None:
    """Refuse two boards whose squares contradict each other."""
    if not second.poses:
        raise CalibrationError("no pose of the second board can be measured: show it in one pose or more")
    first_mm = second.first_square_mm
    if abs(second.square_mm / first_mm - 1) < _MAX_BOARD_ERROR:
        raise CalibrationError(
            f"both boards have squares of {first_mm:g} mm: a second board proves the scale only where its squares "
            "were printed in another size and measured by themselves"
        )
    ratio, sigma = board_scale(fit, second.poses)
    if abs(ratio - 1) <= max(_SIGMAS * sigma, _MAX_BOARD_ERROR):
        return
    raise CalibrationError(
        f"the two boards disagree: if the first's squares are {first_mm:g} mm, the second's are "
        f"{second.square_mm * ratio:.3f} ± {second.square_mm * sigma:.3f} mm, not {second.square_mm:g}; "
        f"if the second's are {second.square_mm:g} mm, the first's are {first_mm / ratio:.3f}, not {first_mm:g}: "
        "measure ten squares of each"
    )


def board_scale(fit: BundleAdjustment, poses: Sequence[BoardPose]) -> tuple[float, float]:
    """Return how many times as large as given a board's squares are by a fit of another one, and the deviation.

    Parameters
    ----------
    fit : BundleAdjustment
        Of the other board, refined.
    poses : sequence of BoardPose
        This board's.

    Raises
    ------
    CalibrationError
        A pose does not fit.

    Notes
    -----
    Least squares over the scale and each pose's place, the lenses and the step between them held fixed. What holding
    them fixed hides is added by the derivative of the solution by them: with J the residuals' derivatives by the
    unknowns and K those by the 24 fixed parameters of covariance C, the covariance is inv(J'J) s^2 + G C G', G =
    inv(J'J) J'K.
    """
    places = [_start(fit, pose) for pose in poses]
    unknowns = np.array([1.0, *np.concatenate(places)])
    for _ in range(_STEPS):
        residual, by_unknown, by_fixed = _residuals(fit, poses, unknowns)
        unknowns = unknowns - np.linalg.lstsq(by_unknown, residual, rcond=None)[0]
    for pose, errors in zip(poses, _by_pose(poses, residual), strict=True):
        off = float(np.sqrt((errors**2).mean()))
        if off > _OUTLIER:
            raise CalibrationError(
                f"{pose.name} of the second board does not fit: its corners lie {off:.1f} times as far off as the "
                "first board's; take it again, and let nothing move meanwhile"
            )
    inverse = np.linalg.inv(by_unknown.T @ by_unknown)
    gain = inverse @ by_unknown.T @ by_fixed
    # The residuals are in standard deviations of the first board's corners.
    noise = max(1.0, float((residual**2).sum() / (len(residual) - len(unknowns))))
    covariance = noise * inverse + gain @ fit.covariance() @ gain.T
    return float(unknowns[0]), float(np.sqrt(covariance[0, 0]))


def _start(fit: BundleAdjustment, pose: BoardPose) -> FloatArray:
    """Return roughly how a pose stands in the camera's frame: rotation vector and place."""
    lens = fit.parameters[:9]
    matrix = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1]])
    _, turn, place = cv2.solvePnP(pose.corners_mm, pose.camera_px, matrix, lens[4:])
    return np.concatenate([turn.ravel(), place.ravel()])


def _residuals(
    fit: BundleAdjustment, poses: Sequence[BoardPose], unknowns: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the errors of all corners in standard deviations, and their derivatives by unknowns and by the rest."""
    parts = []
    for k, pose in enumerate(poses):
        place = unknowns[1 + 6 * k : 7 + 6 * k]
        error, slopes = fit.corner_errors(pose, place, unknowns[0])
        wider, _ = fit.corner_errors(pose, place, unknowns[0] + _DIFFERENCE)
        weight = (1 / fit.sigma_px)[None, :, None]
        by_unknown = np.zeros((error.size, len(unknowns)))
        by_unknown[:, 0] = (weight * (wider - error) / _DIFFERENCE).ravel()
        slopes = (weight[..., None] * slopes).reshape(error.size, -1)
        by_unknown[:, 1 + 6 * k : 7 + 6 * k] = slopes[:, 24:]
        parts.append(((weight * error).ravel(), by_unknown, slopes[:, :24]))
    residual, by_unknowns, by_fixed = (np.concatenate(column) for column in zip(*parts, strict=True))
    return residual, by_unknowns, by_fixed


def _by_pose(poses: Sequence[BoardPose], residual: FloatArray) -> list[FloatArray]:
    """Split the errors of all corners by their poses."""
    return np.split(residual, np.cumsum([pose.camera_px.size * 2 for pose in poses])[:-1])
