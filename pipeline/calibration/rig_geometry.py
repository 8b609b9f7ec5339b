"""Solve for the poses of camera and projector, and for their lenses, from a board in several poses.

Poses that repeat others or do not fit are left out of the bundle adjustment, and a result that the poses do not support
is refused.

Corners in camera and projector determine every length but for one factor; the side of the board's squares sets it. So a
side that is wrong by a quarter makes every length wrong by a quarter, and leaves no residual. A second length proves
the scale: the baseline, measured by hand; or a board whose squares have another side, seen by the calibrated rig.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, NoReturn

import cv2
import numpy as np

from pipeline.calibration.board_poses import MIN_POSES, BoardPose
from pipeline.calibration.bundle_adjustment import BundleAdjustment
from pipeline.calibration.lens import Lens
from pipeline.calibration.model import Calibration, ColorShift, Pattern, ScaleProof, Uncertainty
from pipeline.calibration.verdict import GeometryVerdict, corners_off, depth_bias_mm, judge_geometry, pose_causes
from pipeline.causes import Cause
from pipeline.errors import CalibrationError
from pipeline.models import FloatArray, SensorPart
from pipeline.text import sizes_differ

# A measured baseline that differs from the user's by a greater part shows a wrong square size: by hand, from lens to
# lens, it is known to some millimetres in two hundred.
_MAX_BASELINE_ERROR = 0.02
# Two boards may disagree by this many standard deviations of the fit ...
_BOARD_SIGMAS = 4.0
# ... or by this part: ten squares of 20 mm each are measured to half a millimetre with a ruler, on both boards.
_MAX_BOARD_ERROR = 0.005
# Corners of a second board that lie this many times as far off as the first one's show a pose that moved.
_BOARD_OUTLIER = 3.0
# Gauss-Newton steps; from a start within some per cent four are enough.
_BOARD_STEPS = 10
# By which part the scale is changed for its derivative.
_SCALE_DIFFERENCE = 1e-4
# A pose is left out whose corners lie this many times as far off as the median pose's, and by more than this, px, which
# noise alone makes.
_OUTLIER, _OUTLIER_PX = 3.0, 0.2
# Corners that lie further off than this, RMS px: then something else is wrong than single poses.
_MAX_RMS_PX = 1.0
# Two poses that differ by less than this turn, and by less than this part of their distance, add nothing.
_SAME_DEG, _SAME_PART = 2.0, 0.02
# Boards whose normals differ by less, deg, determine no lens: what tilting takes off a board's width is 0.4 % of it
# then.
_PARALLEL_DEG = 5.0
# Poses that are all alike leave the focal lengths open: a greater relative standard deviation is no calibration.
_MAX_FOCAL_SIGMA = 0.02
# Where depth moves the light across the stripes by less than this part of what it moves along them, the stripes run
# along the baseline.
_MIN_ACROSS = 0.3
# Lateral colour below this, px, changes nothing that could be measured: 0.03 px is 0.016 rad at 12 px per cycle.
_MIN_COLOR_SHIFT_PX = 0.03


class SecondBoard(NamedTuple):
    """Poses of a board whose squares have another side, and the two sides, each measured by itself."""

    poses: Sequence[BoardPose]
    square_mm: float
    first_square_mm: float


def prove_scale(fit: BundleAdjustment, baseline_mm: float | None, second: SecondBoard | None) -> ScaleProof | None:
    """Return the proof of a fit's scale; None: there is none.

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
        The baseline or the second board contradicts the fit, or cannot prove anything.
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
        lengths = f"the baseline comes out as {found:.1f} mm but is {baseline_mm:.1f} mm"
        squares = f"the squares are then {baseline_mm / found:.4f} times as large as given"
        _refuse(fit, lengths, Cause("other squares", squares))


def _refuse(fit: BundleAdjustment, what: str, otherwise: Cause) -> NoReturn:
    """Refuse lengths that contradict each other, by what the corners show, and otherwise by the squares."""
    cause = corners_off(fit) or otherwise
    raise CalibrationError(Cause(cause.key, f"{what}: {cause}"))


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
    if abs(ratio - 1) <= max(_BOARD_SIGMAS * sigma, _MAX_BOARD_ERROR):
        return
    squares = (
        f"if the first's squares are {first_mm:g} mm, the second's are "
        f"{second.square_mm * ratio:.3f} ± {second.square_mm * sigma:.3f} mm, not {second.square_mm:g}; "
        f"if the second's are {second.square_mm:g} mm, the first's are {first_mm / ratio:.3f}, not {first_mm:g}: "
        "measure ten squares of each"
    )
    _refuse(fit, "the two boards disagree", Cause("other squares", squares))


def board_scale(fit: BundleAdjustment, poses: Sequence[BoardPose]) -> tuple[float, float]:
    """Return the ratio of a board's squares to their given size by a fit of another board, and its deviation.

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
    places = [fit.rough_stand(pose) for pose in poses]
    unknowns = np.array([1.0, *np.concatenate(places)])
    for _ in range(_BOARD_STEPS):
        residual, by_unknown, by_fixed = _board_residuals(fit, poses, unknowns)
        unknowns = unknowns - np.linalg.lstsq(by_unknown, residual, rcond=None)[0]
    for pose, errors in zip(poses, _split_by_pose(poses, residual), strict=True):
        off = float(np.sqrt((errors**2).mean()))
        if off > _BOARD_OUTLIER:
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


def _board_residuals(
    fit: BundleAdjustment, poses: Sequence[BoardPose], unknowns: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the errors of all corners in standard deviations, and their derivatives by unknowns and by the rest."""
    parts = []
    for k, pose in enumerate(poses):
        place = unknowns[1 + 6 * k : 7 + 6 * k]
        error, slopes = fit.corner_errors(pose, place, unknowns[0])
        wider, _ = fit.corner_errors(pose, place, unknowns[0] + _SCALE_DIFFERENCE)
        weight = (1 / fit.sigma_px)[None, :, None]
        by_unknown = np.zeros((error.size, len(unknowns)))
        by_unknown[:, 0] = (weight * (wider - error) / _SCALE_DIFFERENCE).ravel()
        slopes = (weight[..., None] * slopes).reshape(error.size, -1)
        by_unknown[:, 1 + 6 * k : 7 + 6 * k] = slopes[:, 24:]
        parts.append(((weight * error).ravel(), by_unknown, slopes[:, :24]))
    residual, by_unknowns, by_fixed = (np.concatenate(column) for column in zip(*parts, strict=True))
    return residual, by_unknowns, by_fixed


def _split_by_pose(poses: Sequence[BoardPose], residual: FloatArray) -> list[FloatArray]:
    """Split the errors of all corners by their poses."""
    return np.split(residual, np.cumsum([pose.camera_px.size * 2 for pose in poses])[:-1])


@dataclass(frozen=True)
class GeometryFit:
    """A calibrated geometry, and how far it can be trusted."""

    calibration: Calibration
    poses: tuple[str, ...]  # that were used
    left_out: tuple[tuple[str, str], ...]  # names, and why
    camera_rms_px: float
    projector_rms_px: float
    verdict: GeometryVerdict
    adjustment: BundleAdjustment  # with the poses that were used
    unused: tuple[BoardPose, ...]  # those that were left out


def solve_geometry(
    poses: list[BoardPose],
    camera_size_px: tuple[int, int],
    projector_size_px: tuple[int, int],
    pattern: Pattern,
    base: Calibration | None = None,
    baseline_mm: float | None = None,
    second: SecondBoard | None = None,
    sensor: SensorPart | None = None,
) -> GeometryFit:
    """Calibrate both lenses and their poses.

    Parameters
    ----------
    poses : list of BoardPose
        At least eight that differ.
    camera_size_px, projector_size_px : (width, height)
        The two devices' sizes in px.
    pattern : Pattern
        Pattern of the frames to be decoded.
    base : Calibration, optional
        A calibration whose light is kept.
    baseline_mm : float, optional
        The distance between camera and projector where it is known: a wrong square size shows in it.
    second : SecondBoard, optional
        Poses of a board of other squares: it shows in these, too.
    sensor : SensorPart, optional
        The part of the camera's sensor that the captures are, where it is known.

    Raises
    ------
    CalibrationError
        Too few poses, all alike, or they do not fit together; sizes, pattern, baseline, second board or base are
        another rig's.
    """
    _check_rig([*poses, *(second.poses if second else ())], camera_size_px, projector_size_px, pattern, base)
    left_out: list[tuple[str, str]] = []
    kept = _without_repeats(poses, camera_size_px, left_out)
    fit = _fit_without_outliers(kept, camera_size_px, projector_size_px, left_out)
    _check_fit(fit, pattern)
    proof = prove_scale(fit, baseline_mm, second)
    calibration = _calibration(fit, camera_size_px, projector_size_px, pattern, base, proof)
    # An earlier calibration's lateral colour goes with its lenses.
    shift = _color_shift(fit.poses, calibration.crosstalk_matrix)
    calibration = calibration.replace(color_shift_px=shift, sensor=sensor)
    return GeometryFit(
        calibration=calibration,
        poses=tuple(pose.name for pose in fit.poses),
        left_out=tuple(left_out),
        camera_rms_px=fit.camera_rms_px,
        projector_rms_px=fit.projector_rms_px,
        verdict=judge_geometry(fit, camera_size_px, pattern, calibration.depth_range_mm),
        adjustment=fit,
        unused=tuple(pose for pose in poses if pose.name in dict(left_out)),
    )


def _fit_without_outliers(
    poses: list[BoardPose],
    camera_size_px: tuple[int, int],
    projector_size_px: tuple[int, int],
    left_out: list[tuple[str, str]],
) -> BundleAdjustment:
    """Fit the poses, leaving out the worst one until all that remain fit alike."""
    while True:
        _need(poses, left_out)
        try:
            fit = BundleAdjustment(poses, camera_size_px, projector_size_px)
            fit.refine()
        except (cv2.error, np.linalg.LinAlgError):
            raise CalibrationError(
                "no lens fits these poses: tilt the board by 15-35 deg, a different way in each pose, and fill the view"
            ) from None
        errors = fit.pose_errors_px()
        worst = int(np.argmax(errors))
        if errors[worst] <= max(_OUTLIER * float(np.median(errors)), _OUTLIER_PX):
            return fit
        reason = f"its corners lie {errors[worst]:.2f} px off, others {np.median(errors):.2f}"
        left_out.append((poses[worst].name, "; ".join((reason, *pose_causes(fit, worst)))))
        poses = poses[:worst] + poses[worst + 1 :]


def _check_fit(fit: BundleAdjustment, pattern: Pattern) -> None:
    """Refuse a fit that its poses do not support, or whose stripes show no depth."""
    if fit.camera_rms_px > _MAX_RMS_PX or fit.projector_rms_px > _MAX_RMS_PX:
        raise CalibrationError(Cause("poses do not fit", f"the poses do not fit together: {corners_off(fit)}"))
    focal_sigma = fit.focal_sigma()
    if not focal_sigma < _MAX_FOCAL_SIGMA:
        raise CalibrationError(
            f"the poses are too much alike, they determine the focal lengths only to {focal_sigma:.0%}: tilt the "
            "board by 15-35 deg, a different way in each pose"
        )
    across, along = fit.px_per_mm(pattern, float(np.median(fit.depths_mm())))
    if across < _MIN_ACROSS * along:
        other = "vertical" if pattern.stripes == "horizontal" else "horizontal"
        raise CalibrationError(
            f"{pattern.stripes} stripes run along the line from camera to projector, where their phase shows no depth: "
            f"calibrate for {other} ones"
        )


def _check_rig(
    poses: list[BoardPose],
    camera_size_px: tuple[int, int],
    projector_size_px: tuple[int, int],
    pattern: Pattern,
    base: Calibration | None,
) -> None:
    """Refuse what belongs to another rig."""

    def beyond(corners_px: FloatArray, size_px: tuple[int, int]) -> bool:
        return bool((corners_px < -2).any() or (corners_px > np.array(size_px) + 1).any())

    for pose in poses:
        if beyond(pose.camera_px, camera_size_px) or beyond(pose.projector_px, projector_size_px):
            swapped = not (beyond(pose.camera_px, projector_size_px) or beyond(pose.projector_px, camera_size_px))
            raise CalibrationError(
                "{}: corners lie outside the camera's {}x{} px or the projector's {}x{}: ".format(
                    pose.name, *camera_size_px, *projector_size_px
                )
                + ("camera and projector are swapped" if swapped else "give their true sizes")
            )
    length = projector_size_px[1 if pattern.stripes == "horizontal" else 0]
    if pattern.period_px > length:
        raise CalibrationError(f"a period of {pattern.period_px:g} px does not fit on the projector's {length} px")
    for name, size_px in (("camera", camera_size_px), ("projector", projector_size_px)):
        lens = None if base is None else getattr(base, name)
        if lens is not None and lens.size_px != tuple(size_px):
            sizes = sizes_differ(name, tuple(size_px), "that of the calibration whose light is kept is", lens.size_px)
            raise CalibrationError(f"{sizes}: leave that calibration out")


def _need(kept: list[BoardPose], left_out: list[tuple[str, str]]) -> None:
    if len(kept) < MIN_POSES:
        why = "; ".join(f"{name} left out: {reason}" for name, reason in left_out[:3])
        raise CalibrationError(
            f"{len(kept)} usable poses, at least {MIN_POSES} that differ are needed" + (f" ({why})" if why else "")
        )


def _without_repeats(
    poses: list[BoardPose], camera_size_px: tuple[int, int], left_out: list[tuple[str, str]]
) -> list[BoardPose]:
    """Leave out poses that repeat an earlier one, and refuse boards that are all parallel; a rough lens shows both."""
    width, height = camera_size_px
    matrix = np.array([[1.5 * width, 0, width / 2], [0, 1.5 * width, height / 2], [0, 0, 1]], np.float64)
    kept: list[tuple[BoardPose, FloatArray, FloatArray]] = []
    for pose in poses:
        _, turn, place = cv2.solvePnP(pose.corners_mm, pose.camera_px, matrix, None)
        rotation, place = cv2.Rodrigues(turn)[0], place.ravel()
        for other, rotation2, place2 in kept:
            angle = np.degrees(np.arccos(np.clip((np.trace(rotation.T @ rotation2) - 1) / 2, -1, 1)))
            if angle < _SAME_DEG and np.linalg.norm(place - place2) < _SAME_PART * place[2]:
                left_out.append((pose.name, f"it repeats {other.name}"))
                break
        else:
            kept.append((pose, rotation, place))
    normals = np.array([rotation[:, 2] for _, rotation, _ in kept])
    spread_deg = float(np.degrees(np.arccos(np.clip((normals @ normals.T).min(initial=1.0), -1, 1))))
    if len(kept) > 1 and spread_deg < _PARALLEL_DEG:
        raise CalibrationError(
            f"the poses are too much alike, their tilts differ by {spread_deg:.0f} deg at most: tilt the board by "
            "15-35 deg, a different way in each pose"
        )
    return [pose for pose, _, _ in kept]


def _lens(size_px: tuple[int, int], values: FloatArray) -> Lens:
    matrix = np.array([[values[0], 0, values[2]], [0, values[1], values[3]], [0, 0, 1]])
    return Lens(size_px=size_px, matrix=matrix, distortion=values[4:])


def _calibration(
    fit: BundleAdjustment,
    camera_size_px: tuple[int, int],
    projector_size_px: tuple[int, int],
    pattern: Pattern,
    base: Calibration | None,
    proof: ScaleProof | None,
) -> Calibration:
    p, covariance = fit.parameters, fit.covariance()
    sigma = np.sqrt(np.diag(covariance))
    depths = fit.depths_mm()
    axis = 1 if pattern.stripes == "horizontal" else 0
    known = {} if base is None else {name: getattr(base, name) for name in Calibration.model_fields}
    old = (known.get("uncertainty") or Uncertainty()).model_dump()
    uncertainty = Uncertainty(
        **{
            **old,
            "camera": sigma[:9],
            "projector": sigma[9:18],
            "rotation_deg": np.degrees(sigma[18:21]),
            "translation_mm": sigma[21:24],
            "reprojection_px": (fit.camera_rms_px, fit.projector_rms_px),
            "depth_bias_mm": depth_bias_mm(p[:24], covariance, camera_size_px, axis, float(np.median(depths))),
        }
    )
    return Calibration(
        **{
            **known,
            "camera": _lens(camera_size_px, p[:9]),
            "projector": _lens(projector_size_px, p[9:18]),
            "rotation": cv2.Rodrigues(fit.stereo[:3])[0],
            "translation_mm": fit.stereo[3:],
            "pattern": pattern,
            "uncertainty": uncertainty,
            "scale_proof": proof,
        }
    )


def _color_shift(poses: list[BoardPose], crosstalk_matrix: FloatArray | None) -> ColorShift | None:
    """Return the lateral colour of both lenses, from all poses; None where there is none worth undoing, or none shows.

    A camera channel at a pixel sees the place less its own shift, and decodes the mix of the projector's channels that
    its row of the crosstalk matrix makes.
    """
    poses = [pose for pose in poses if np.isfinite(pose.camera_shift_px).all()]
    if not poses:
        return None
    camera = np.median([pose.camera_shift_px for pose in poses], axis=0)
    relative = np.median([pose.projector_shift_px + camera @ pose.jacobian.T for pose in poses], axis=0)
    mix = np.eye(3) if crosstalk_matrix is None else crosstalk_matrix / crosstalk_matrix.sum(axis=1, keepdims=True)
    projector = -np.linalg.solve(mix, relative)
    if max(np.abs(camera).max(), np.abs(projector).max()) < _MIN_COLOR_SHIFT_PX:
        return None
    return ColorShift(camera=camera, projector=projector)
