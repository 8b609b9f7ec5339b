"""What a calibrated geometry is worth where objects will stand, in mm, and what would make it better.

An error of depth that is smooth over the picture makes an object longer or shorter by the part that it is of the
distance. So errors are judged as parts of the distance.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from pipeline.calibration.bundle_adjustment import BundleAdjustment
from pipeline.calibration.depth_bias import depth_bias_mm
from pipeline.calibration.grades import Grade, grade_of
from pipeline.calibration.model import Pattern
from pipeline.calibration.pose_judgement import PoseJudgement, judge_poses
from pipeline.models import FloatArray

#: What a frame's own noise leaves of phase, rad: 0.007 to 0.014 on skin, smoothed as by default (docs/accuracy.md).
FRAME_NOISE_RAD = 0.01
# Parts of the distance. With the first a face of 200 mm is wrong by 0.07 mm, which is what a frame's noise makes of a
# point 900 mm away; with the second by 0.2 mm, three times that.
_GOOD, _USABLE = 1 / 3000, 1 / 1000
# Boards whose normals differ by less, deg, hardly tell focal length from distance: two poses tilted by 15 deg to either
# side differ by this.
_MIN_SPREAD_DEG = 30.0
# Corners that fill less of the picture leave its rim, where lenses bend most, to extrapolation.
_MIN_FIELD = 0.5
# Corners further off than this, px RMS, are twice what a ChArUco board and three times what a chessboard leaves.
_MAX_CORNER_PX = 0.2


@dataclass(frozen=True)
class GeometryVerdict:
    """What a geometry is worth."""

    grade: Grade
    distance_mm: float  # where it is judged: the middle of the depth range, or else where the boards stood
    bias_mm: float  # one standard deviation of depth by what the calibration is uncertain of; smooth over the picture
    random_mm: float  # by the noise of a frame of `FRAME_NOISE_RAD`, a point
    advice: tuple[str, ...]  # what would make it better, the most effective first
    poses: tuple[PoseJudgement, ...]  # the worst, and others whose pictures show a fault

    def in_words(self) -> str:
        """Return a line that says what it is worth."""
        part = round(self.distance_mm / self.bias_mm, -2) if self.bias_mm > 0 else np.inf
        return (
            f"{self.grade}: {self.distance_mm:.0f} mm away the calibration leaves depth off by {self.bias_mm:.2f} mm "
            f"(one standard deviation, smooth over the picture; 1 part in {part:.0f}), and the noise of a frame, "
            f"{FRAME_NOISE_RAD:g} rad, adds {self.random_mm:.2f} mm a point"
        )


def judge_geometry(
    fit: BundleAdjustment,
    camera_size_px: tuple[int, int],
    pattern: Pattern,
    depth_range_mm: tuple[float, float] | None = None,
) -> GeometryVerdict:
    """Judge a refined fit.

    Parameters
    ----------
    fit : BundleAdjustment
        Lenses, step and poses.
    camera_size_px : (width, height)
        The camera's.
    pattern : Pattern
        What frames are taken with.
    depth_range_mm : (nearest, farthest), optional
        Where objects will stand; None: where the boards stood.
    """
    depths = fit.depths_mm()
    distance = float(np.median(depths) if depth_range_mm is None else np.mean(depth_range_mm))
    axis = 1 if pattern.stripes == "horizontal" else 0
    bias = depth_bias_mm(fit.parameters[:24], fit.covariance(), camera_size_px, axis, distance)
    across, _ = fit.px_per_mm(pattern, distance)
    random = FRAME_NOISE_RAD * pattern.period_px / (2 * np.pi) / across
    grade = grade_of(max(bias, random) / distance, _GOOD, _USABLE)
    advice = () if grade == "good" else _advice(fit, camera_size_px, pattern, depths, distance, bias, random)
    return GeometryVerdict(grade, distance, bias, random, advice, judge_poses(fit))


def _advice(
    fit: BundleAdjustment,
    camera_size_px: tuple[int, int],
    pattern: Pattern,
    depths: FloatArray,
    distance: float,
    bias: float,
    random: float,
) -> tuple[str, ...]:
    """Return what would make a geometry better."""
    advice = []
    if random > max(bias, _GOOD * distance):
        baseline = float(np.linalg.norm(fit.stereo[3:]))
        advice.append(
            f"camera and projector stand only {baseline:.0f} mm apart, 1 part in {distance / baseline:.0f} of the "
            f"distance: set them farther apart, or project a shorter period than {pattern.period_px:g} px"
        )
    if bias > _GOOD * distance:
        normals = fit.normals()
        spread = float(np.degrees(np.arccos(np.clip((normals @ normals.T).min(), -1, 1))))
        if spread < _MIN_SPREAD_DEG:
            advice.append(f"the boards' tilts differ by {spread:.0f} deg at most: tilt them by 15-35 deg, every way")
        hull = cv2.convexHull(np.concatenate([pose.camera_px for pose in fit.poses]).astype(np.float32))
        field = cv2.contourArea(hull) / (camera_size_px[0] * camera_size_px[1])
        if field < _MIN_FIELD:
            advice.append(f"all corners together fill {field:.0%} of the picture: show the board at its rims, too")
        if not depths.min() <= distance <= depths.max():
            advice.append(
                f"the boards stood {depths.min():.0f} to {depths.max():.0f} mm away: show them {distance:.0f} mm away"
            )
        worst = max(fit.camera_rms_px, fit.projector_rms_px)
        if worst > _MAX_CORNER_PX:
            advice.append(f"corners are off by {worst:.2f} px RMS: take sharper pictures, larger squares, a flat board")
        advice.append(f"show more poses than {len(fit.poses)}: twice as many take three tenths off the bias")
    return tuple(advice)
