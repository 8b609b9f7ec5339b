"""Where camera and projector stand, and what their lenses do, from a board in several poses.

Poses that repeat others or do not fit are left out of the bundle adjustment, and a result that the poses do not support
is refused.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from pipeline.calibration.board_poses import BoardPose
from pipeline.calibration.bundle_adjustment import BundleAdjustment
from pipeline.calibration.depth_bias import depth_bias_mm
from pipeline.calibration.geometry_verdict import GeometryVerdict, judge_geometry
from pipeline.calibration.model import Calibration, ColorShift, Lens, Pattern, ScaleProof, Uncertainty
from pipeline.calibration.pose_judgement import pose_causes
from pipeline.calibration.scale_proof import SecondBoard, prove_scale
from pipeline.errors import CalibrationError
from pipeline.models import FloatArray

#: Poses at least: three tell a lens, and with eight one that is wrong shows beside the others.
MIN_POSES = 8
# A pose is left out whose corners lie this many times as far off as the median pose's, and by more than this, px, which
# noise alone makes.
_OUTLIER, _OUTLIER_PX = 3.0, 0.2
# Corners that lie further off than this, RMS px: then something else is wrong than single poses.
_MAX_RMS_PX = 1.0
# Two poses that differ by less than this turn, and by less than this part of their distance, add nothing.
_SAME_DEG, _SAME_PART = 2.0, 0.02
# Boards whose normals differ by less, deg, tell no lens: what tilting takes off a board's width is 0.4 % of it then.
_PARALLEL_DEG = 5.0
# Poses that are all alike leave the focal lengths open: a greater relative standard deviation is no calibration.
_MAX_FOCAL_SIGMA = 0.02
# Where depth moves the light across the stripes by less than this part of what it moves along them, the stripes run
# along the baseline.
_MIN_ACROSS = 0.3
# Lateral colour below this, px, changes nothing that could be measured: 0.03 px is 0.016 rad at 12 px a cycle.
_MIN_COLOR_SHIFT_PX = 0.03


@dataclass(frozen=True)
class GeometryFit:
    """A calibrated geometry, and how far it can be trusted."""

    calibration: Calibration
    poses: tuple[str, ...]  # that were used
    left_out: tuple[tuple[str, str], ...]  # names, and why
    camera_rms_px: float
    projector_rms_px: float
    verdict: GeometryVerdict


def solve_geometry(
    poses: list[BoardPose],
    camera_size_px: tuple[int, int],
    projector_size_px: tuple[int, int],
    pattern: Pattern,
    base: Calibration | None = None,
    baseline_mm: float | None = None,
    second: SecondBoard | None = None,
) -> GeometryFit:
    """Calibrate both lenses and where they stand.

    Parameters
    ----------
    poses : list of BoardPose
        At least eight that differ.
    camera_size_px, projector_size_px : (width, height)
        The two devices' sizes in px.
    pattern : Pattern
        What will be projected when frames are decoded.
    base : Calibration, optional
        A calibration whose light is kept.
    baseline_mm : float, optional
        The distance between camera and projector where it is known: a wrong square size shows in it.
    second : SecondBoard, optional
        Poses of a board of other squares: it shows in these, too.

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
    calibration = calibration.model_copy(update={"color_shift_px": shift})
    names = tuple(pose.name for pose in fit.poses)
    verdict = judge_geometry(fit, camera_size_px, pattern, calibration.depth_range_mm)
    return GeometryFit(calibration, names, tuple(left_out), fit.camera_rms_px, fit.projector_rms_px, verdict)


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
    """Refuse a fit that its poses do not support, or whose stripes tell no depth."""
    if fit.camera_rms_px > _MAX_RMS_PX or fit.projector_rms_px > _MAX_RMS_PX:
        raise CalibrationError(
            f"the poses do not fit together ({fit.camera_rms_px:.2f} px off in the camera, {fit.projector_rms_px:.2f} "
            "px in the projector): is the board flat, of the squares given, not mirrored, and did nothing move?"
        )
    focal_sigma = fit.focal_sigma()
    if not focal_sigma < _MAX_FOCAL_SIGMA:
        raise CalibrationError(
            f"the poses are too much alike, they tell the focal lengths only to {focal_sigma:.0%}: tilt the board by "
            "15-35 deg, a different way in each pose"
        )
    across, along = fit.px_per_mm(pattern, float(np.median(fit.depths_mm())))
    if across < _MIN_ACROSS * along:
        other = "vertical" if pattern.stripes == "horizontal" else "horizontal"
        raise CalibrationError(
            f"{pattern.stripes} stripes run along the line from camera to projector, where their phase tells no depth: "
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
            raise CalibrationError(
                "the calibration whose light is kept is for another {}, of {}x{} px, not {}x{}: leave it out".format(
                    name, *lens.size_px, *size_px
                )
            )


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
    beside = np.median([pose.projector_shift_px + camera @ pose.jacobian.T for pose in poses], axis=0)
    mix = np.eye(3) if crosstalk_matrix is None else crosstalk_matrix / crosstalk_matrix.sum(axis=1, keepdims=True)
    projector = -np.linalg.solve(mix, beside)
    if max(np.abs(camera).max(), np.abs(projector).max()) < _MIN_COLOR_SHIFT_PX:
        return None
    return ColorShift(camera=camera, projector=projector)
