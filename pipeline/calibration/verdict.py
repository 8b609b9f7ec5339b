"""The quality of a calibration: a grade, the figures behind it, and what would improve it.

**Light.** A channel whose light is off by a small part e of its range leaves the three-step phase off by

    (2 / 3) sum_j e_j sin(phi_j) / (b / range),

the derivative of the arctangent by each channel, with the fringe's amplitude b: half of the range at full modulation.
Independent errors of the three channels, each of RMS e, make sqrt(8 / 3) e rad RMS. The same holds for noise.

**Poses.** A cause is named only where the data shows it: corners that are found elsewhere in later pictures, edges that
are less sharp than in the other poses, a board seen at a slant or from afar, or an error that a few corners carry
alone.

**Geometry.** An error of depth that is smooth over the picture makes an object longer or shorter by the part that it is
of the distance. So errors are judged as parts of the distance.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from pipeline.calibration.board_poses import BoardPose
from pipeline.calibration.bundle_adjustment import BundleAdjustment, project_points
from pipeline.calibration.model import Geometry, Pattern
from pipeline.calibration.multishot import multishot_sequence
from pipeline.calibration.radiometry import Radiometry
from pipeline.causes import Cause
from pipeline.models import FloatArray

#: "good": a frame's noise limits a measurement; "usable": the calibration does; "poor": calibrate again.
Grade = Literal["good", "usable", "poor"]
# rad per part of the channels' range, at full modulation.
_RAD_PER_PART = float(np.sqrt(8 / 3))
# rad RMS: what the noise of one frame leaves of a smoothed phase (0.007 to 0.014, docs/accuracy.md); and what the
# paper's chain leaves, which measures no response.
_GOOD_RAD, _USABLE_RAD = 0.01, 0.03
# Part of white by which grey may differ from red + green + blue where nothing but noise makes it: above, the projector
# mixes its colours a little, or the camera's transfer is another.
_USUAL_ADDITIVITY = 0.005
# Of full scale: a brighter target, or a longer exposure, then gives half the noise or less.
_DIM = 0.35
# Codes, of 255, from which on a response is a power of the code; below, black levels bend it.
_GAMMA_FROM = 64
# A pose stands out whose RMS is this many times the median pose's: poses of one set that are sharp and stand still
# differ by up to 1.9 times, as some are tilted more.
_STANDS_OUT = 2.5
# A board that moved shows its corners elsewhere by this, px, which is ten times what noise does to their median; and by
# this many times as much as in the median pose.
_MOVED_PX, _MOVED = 0.1, 3.0
# Edges with a sigma below this, px, are as sharp as the picture in which corners are refined. Even blur moves no
# corner, but a board out of focus or in motion is seldom blurred evenly. And how many times as much as in the median
# pose.
_BLURRED_PX, _BLURRED = 1.2, 1.5
# Beyond this tilt, deg, boards are found less and less well (docs/calibration.md).
_STEEP_DEG = 50.0
# Squares of fewer px leave no room for the corners' windows; and what counts as far away compared with the other poses.
_SMALL_PX, _SMALL = 12.0, 0.6
# The worst tenth of the corners carries a third of the squared error where it is noise; so much only where it is their
# own.
_FEW_SHARE, _FEW = 0.6, 0.1
#: What a frame's own noise leaves of phase, rad: 0.007 to 0.014 on skin, smoothed as by default (docs/accuracy.md).
FRAME_NOISE_RAD = 0.01
# Parts of the distance. With the first a face of 200 mm is wrong by 0.07 mm, which is the effect of a frame's noise on
# a point 900 mm away; with the second by 0.2 mm, three times that.
_GOOD, _USABLE = 1 / 3000, 1 / 1000
# Boards whose normals differ by less, deg, hardly distinguish focal length from distance: two poses tilted by 15 deg to
# either side differ by this.
_MIN_SPREAD_DEG = 30.0
# Corners that fill less of the picture leave its rim, where lenses bend most, to extrapolation.
_MIN_FIELD = 0.5
# A projector that warps its picture leaves its corners this many times as far off as the camera's: corners dragged by
# 15 px leave 0.35 and 0.04 px, a board bent by 3 mm 0.73 and 0.51.
_WARPED = 2.0
# Corners further off than this, px RMS, are twice what a ChArUco board and three times what a chessboard leaves.
_MAX_CORNER_PX = 0.2


def grade_of(error: float, good: float, usable: float) -> Grade:
    """Return the grade of an error, given the largest that is good and the largest that is usable; NaN is poor.

    >>> grade_of(0.2, 0.3, 1.0), grade_of(0.5, 0.3, 1.0), grade_of(2.0, 0.3, 1.0)
    ('good', 'usable', 'poor')
    """
    if error <= good:
        return "good"
    return "usable" if error <= usable else "poor"


@dataclass(frozen=True)
class Verdict(ABC):
    """The quality of a part of a calibration."""

    grade: Grade
    advice: tuple[str, ...]  # improvements, the most effective first

    @abstractmethod
    def in_words(self) -> str:
        """Return one line with the grade and its figures."""

    def lines(self) -> list[str]:
        """Return the complete verdict, one line each."""
        return [self.in_words(), *(f"better: {advice}" for advice in self.advice)]


@dataclass(frozen=True)
class RadiometryVerdict(Verdict):
    """The quality of a radiometry."""

    ripple_rad: float  # RMS over a cycle, by what is uncertain of response and crosstalk
    noise_rad: float  # of one pixel, one frame as bright as the white capture, nothing smoothed
    mm_per_rad: float | None  # at the working distance, where the geometry is known
    gamma: tuple[float, float, float]  # of the projector's red, green and blue

    def in_words(self) -> str:
        """Return one line with the grade and its figures."""

        def both(rad: float) -> str:
            return f"{rad:.4f} rad" + ("" if self.mm_per_rad is None else f" ({rad * self.mm_per_rad:.3f} mm)")

        gamma = ", ".join(f"{value:.2f}" for value in self.gamma)
        return (
            f"{self.grade}: response and crosstalk leave a ripple of {both(self.ripple_rad)} RMS; the camera's noise "
            f"makes {both(self.noise_rad)} of a pixel, unsmoothed; the projector's gamma is {gamma}"
        )


def judge_radiometry(found: Radiometry, geometry: Geometry | None) -> RadiometryVerdict:
    """Judge what was measured of the light.

    Parameters
    ----------
    found : Radiometry
        Measured light.
    geometry : Geometry, optional
        The rig's, which turns a radian into mm.
    """
    # Of light 0..1, RMS over codes and primaries; and of each channel's crosstalk, over all that it sees.
    response = float(np.sqrt((found.response_sigma**2).mean()))
    rows = found.crosstalk_matrix.sum(axis=1, keepdims=True)
    crosstalk = float(np.sqrt(((found.crosstalk_sigma / rows) ** 2).sum(axis=1).mean()))
    ripple = _RAD_PER_PART * float(np.hypot(response, crosstalk))
    noise = _RAD_PER_PART * float(np.sqrt(((found.noise / rows.ravel()) ** 2).mean()))
    gamma = tuple(_gamma(row) for row in found.response)
    advice = []
    if found.additivity > _USUAL_ADDITIVITY:
        advice.append(
            f"grey differs from red + green + blue by {found.additivity:.1%} of white: look for a colour mode of the "
            "projector, light that changes meanwhile, and black that the camera clips"
        )
    if rows.max() < _DIM:
        advice.append(f"white reaches {rows.max():.0%} of full scale only: expose longer")
    distance = None if geometry is None else geometry.working_distance_mm()
    return RadiometryVerdict(
        grade=grade_of(ripple, _GOOD_RAD, _USABLE_RAD),
        advice=tuple(advice),
        ripple_rad=ripple,
        noise_rad=noise,
        mm_per_rad=None if geometry is None or distance is None else 1 / geometry.rad_per_mm(distance),
        gamma=(gamma[0], gamma[1], gamma[2]),
    )


def _gamma(response: FloatArray) -> float:
    """Return the power of the code that a response is nearest to, by least squares of logarithms."""
    codes = np.log(np.arange(_GAMMA_FROM, len(response)) / (len(response) - 1))
    light = np.log(np.maximum(response[_GAMMA_FROM:], 1e-6))
    return float((codes @ light) / (codes @ codes))


@dataclass(frozen=True)
class PoseJudgement:
    """Fit of a pose compared with the others."""

    name: str
    rms_px: tuple[float, float]  # camera, projector
    usual_px: tuple[float, float]  # the median pose's
    causes: tuple[str, ...]  # that the data shows

    @property
    def stands_out(self) -> bool:
        """True where it fits worse than chance explains."""
        return any(rms > _STANDS_OUT * usual for rms, usual in zip(self.rms_px, self.usual_px, strict=True))

    def in_words(self) -> str:
        """Return one line with its fit and the causes."""
        figures = (
            f"{self.name}: corners off by {self.rms_px[0]:.3f} px RMS in the camera and {self.rms_px[1]:.3f} in the "
            f"projector, those of the middle pose by {self.usual_px[0]:.3f} and {self.usual_px[1]:.3f}"
        )
        if self.causes:
            return f"{figures}; {'; '.join(self.causes)}"
        return f"{figures}; " + ("no cause shows but the error itself" if self.stands_out else "it does not stand out")


def judge_poses(fit: BundleAdjustment) -> tuple[PoseJudgement, ...]:
    """Return the worst pose of a fit, and after it all others whose pictures show a fault.

    A board that moves in its own plane hardly changes which projector pixels shine on it, nor do blurred corners lie
    off their place: such poses need not fit badly.
    """
    rms = fit.pose_rms_px()
    usual = np.maximum(np.median(rms, axis=0), 1e-9)  # corners without noise are nowhere off

    def judged(k: int, causes: Sequence[str]) -> PoseJudgement:
        own, middle = (float(rms[k, 0]), float(rms[k, 1])), (float(usual[0]), float(usual[1]))
        return PoseJudgement(fit.poses[k].name, own, middle, tuple(causes))

    worst = int(np.argmax((rms / usual).max(axis=1)))
    faulty = [(k, _picture_causes(fit, k)) for k in range(len(fit.poses)) if k != worst]
    return judged(worst, pose_causes(fit, worst)), *(judged(k, causes) for k, causes in faulty if causes)


def pose_causes(fit: BundleAdjustment, k: int) -> tuple[str, ...]:
    """Return the causes of corners that lie off their place, as the data of a pose shows them."""
    others = [pose for i, pose in enumerate(fit.poses) if i != k]
    causes = _picture_causes(fit, k)
    tilt = _tilt_deg(fit, k)
    if tilt > _STEEP_DEG:
        causes.append(f"the board is tilted by {tilt:.0f} deg: turn it to {_STEEP_DEG:.0f} deg or less")
    side, usual_side = square_px(fit.poses[k]), float(np.median([square_px(pose) for pose in others]))
    if side < _SMALL_PX or side < _SMALL * usual_side:
        causes.append(f"the board is small, {side:.0f} px per square, elsewhere {usual_side:.0f}: show it nearer")
    few = _few_corners(fit, k)
    if few is not None:
        causes.append(
            f"a few corners near {few[0]:.0f}, {few[1]:.0f} px carry most of it: look for gloss, shadow, a finger or a "
            "board that is not flat there"
        )
    return tuple(causes)


def _tilt_deg(fit: BundleAdjustment, k: int) -> float:
    """Return the angle between a board's normal and the ray to its middle."""
    turn, place = np.split(fit.parameters[24 + 6 * k : 30 + 6 * k], 2)
    rotation = cv2.Rodrigues(turn)[0]
    middle = rotation @ fit.poses[k].corners_mm.mean(axis=0) + place
    return float(np.degrees(np.arccos(min(abs(rotation[:, 2] @ middle) / np.linalg.norm(middle), 1.0))))


def square_px(pose: BoardPose) -> float:
    """Return the side of a square in the camera's picture, px: the root of its area."""
    corners, pixels = pose.corners_mm[:, :2], pose.camera_px
    to_px = np.linalg.lstsq(corners - corners.mean(axis=0), pixels - pixels.mean(axis=0), rcond=None)[0]
    steps = np.unique(np.round(corners[:, 0], 6))
    return float(np.sqrt(abs(np.linalg.det(to_px))) * np.diff(steps).min())


def _picture_causes(fit: BundleAdjustment, k: int) -> list[str]:
    """Return the causes that a pose's pictures show: a board that moved, or that is not sharp."""
    evidence = fit.poses[k].evidence
    others = [pose.evidence for i, pose in enumerate(fit.poses) if i != k and pose.evidence is not None]
    if evidence is None:
        return []
    causes = []
    usual_move = float(np.median([other.moved_px for other in others])) if others else 0.0
    if evidence.moved_px > max(_MOVED_PX, _MOVED * usual_move):
        causes.append(
            f"it moved: from {evidence.moved_before} on its corners lie up to {evidence.moved_px:.2f} px from those "
            "of the white picture: let board and camera stand still"
        )
    sharp = [other.blur_px for other in others if np.isfinite(other.blur_px)]
    usual_blur = float(np.median(sharp)) if sharp else 0.0
    if evidence.blur_px > max(_BLURRED_PX, _BLURRED * usual_blur):
        causes.append(
            f"it is blurred (edges have a sigma of {evidence.blur_px:.1f} px"
            + (f", elsewhere {usual_blur:.1f}" if sharp else "")
            + "): show the board in focus, and let it stand still"
        )
    return causes


def corners_off(fit: BundleAdjustment) -> Cause | None:
    """Say that corners lie off, and whether in the projector's picture alone; None: they do not.

    A board that is bent, or whose squares are of another size, shows in both pictures, and one that moved in its own.
    """
    camera, projector = fit.camera_rms_px, fit.projector_rms_px
    if max(camera, projector) <= _MAX_CORNER_PX:
        return None
    larger = max(1.0, float(fit.parameters[9] / fit.parameters[0]))  # a board's error in the projector's picture
    moved = [pose.evidence.moved_px for pose in fit.poses if pose.evidence is not None]
    off = f"corners are off by {projector:.2f} px RMS in the projector and {camera:.2f} in the camera"
    if projector > _WARPED * larger * camera and max(moved, default=0.0) <= _MOVED_PX:
        words = "the projector warps its picture: switch off keystone, corner correction and zoom, and capture again"
        return Cause("warped picture", f"{off}: {words}")
    return Cause("corners off", f"{off}: take sharper pictures, larger squares, a flat board")


def _few_corners(fit: BundleAdjustment, k: int) -> FloatArray | None:
    """Return the middle, camera px, of the few corners that carry most of a pose's error; None: many share it."""
    squared = fit.corner_distances_px(k) ** 2
    device = int(np.argmax(squared.sum(axis=0) / fit.sigma_px**2))
    errors = squared[:, device]
    worst = np.argsort(errors)[-max(round(_FEW * len(errors)), 1) :]
    if errors[worst].sum() < _FEW_SHARE * errors.sum():
        return None
    return np.asarray(fit.poses[k].camera_px[worst].mean(axis=0))


def depth_bias_mm(
    parameters: FloatArray, covariance: FloatArray, camera_size_px: tuple[int, int], axis: int, depth_mm: float
) -> float:
    """Return the standard deviation of depth that the calibration's own uncertainty leaves, RMS over the image.

    Parameters
    ----------
    parameters, covariance, camera_size_px, axis, depth_mm
        As for `depth_slopes`.
    """
    slopes = depth_slopes(parameters, covariance, camera_size_px, axis, depth_mm)
    return float(np.sqrt(np.einsum("ik,ij,jk->k", slopes, covariance, slopes).mean()))


def depth_slopes(
    parameters: FloatArray, covariance: FloatArray, camera_size_px: tuple[int, int], axis: int, depth_mm: float
) -> FloatArray:
    """Return how far each parameter moves depth, (24, 9): mm per unit at nine places of the picture.

    Parameters
    ----------
    parameters : (24,)
        Camera, projector (fx, fy, cx, cy, k1, k2, p1, p2, k3 each), rotation vector, translation.
    covariance : (24, 24)
        Their covariance, which sets the steps of the differences.
    camera_size_px : (width, height)
        The camera's.
    axis : int
        Projector axis along which the phase changes.
    depth_mm : float
        Depth of the object.
    """
    width, height = camera_size_px
    grid = np.stack(np.meshgrid(np.linspace(0.2, 0.8, 3) * width, np.linspace(0.2, 0.8, 3) * height), -1).reshape(
        -1, 1, 2
    )

    def coordinate(p: FloatArray, depth: FloatArray) -> FloatArray:
        matrix = np.array([[p[0], 0, p[2]], [0, p[1], p[3]], [0, 0, 1]])
        rays = cv2.undistortPoints(grid, matrix, p[4:9]).reshape(-1, 2)
        points = np.concatenate([rays, np.ones((len(rays), 1))], axis=1) * depth[:, None]
        return project_points(points, p[18:21], p[21:24], p[9:18])[0][:, axis]

    depth = np.full(len(grid), depth_mm)
    # A pixel's projector coordinate is measured, so an error of the parameters that changes it shows as depth.
    by_depth = coordinate(parameters, depth + 0.5) - coordinate(parameters, depth - 0.5)
    steps = 1e-3 * np.sqrt(np.diag(covariance))
    by_parameter = np.stack(
        [
            (coordinate(parameters + step, depth) - coordinate(parameters - step, depth)) / (2 * size)
            for size, step in zip(steps, np.diag(steps), strict=True)
        ]
    )
    return np.asarray(by_parameter / by_depth)


@dataclass(frozen=True)
class GeometryVerdict(Verdict):
    """The quality of a geometry."""

    distance_mm: float  # where it is judged: the middle of the depth range, or else where the boards stood
    bias_mm: float  # one standard deviation of depth by what the calibration is uncertain of; smooth over the picture
    random_mm: float  # by the noise of a frame of `FRAME_NOISE_RAD`, a point
    poses: tuple[PoseJudgement, ...]  # the worst, and others whose pictures show a fault

    def in_words(self) -> str:
        """Return one line with the grade and its figures."""
        part = round(self.distance_mm / self.bias_mm, -2) if self.bias_mm > 0 else np.inf
        return (
            f"{self.grade}: {self.distance_mm:.0f} mm away the calibration leaves depth off by {self.bias_mm:.2f} mm "
            f"(one standard deviation, smooth over the picture; 1 part in {part:.0f}), and the noise of a frame, "
            f"{FRAME_NOISE_RAD:g} rad, adds {self.random_mm:.2f} mm per point"
        )

    def lines(self) -> list[str]:
        """Return the complete verdict, one line each."""
        worst, *faulty = self.poses
        poses = [f"worst pose: {worst.in_words()}", *(f"look at {pose.in_words()}" for pose in faulty)]
        return [*poses, *super().lines()]


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
        Pattern of the frames.
    depth_range_mm : (nearest, farthest), optional
        Where objects will be; None: where the boards were.
    """
    depths = fit.depths_mm()
    distance = float(np.median(depths) if depth_range_mm is None else np.mean(depth_range_mm))
    axis = 1 if pattern.stripes == "horizontal" else 0
    bias = depth_bias_mm(fit.parameters[:24], fit.covariance(), camera_size_px, axis, distance)
    across, _ = fit.px_per_mm(pattern, distance)
    random = FRAME_NOISE_RAD * pattern.period_px / (2 * np.pi) / across
    grade = grade_of(max(bias, random) / distance, _GOOD, _USABLE)
    advice = () if grade == "good" else _advice(fit, camera_size_px, pattern, depths, distance, bias, random)
    return GeometryVerdict(grade, advice, distance, bias, random, judge_poses(fit))


def _advice(
    fit: BundleAdjustment,
    camera_size_px: tuple[int, int],
    pattern: Pattern,
    depths: FloatArray,
    distance: float,
    bias: float,
    random: float,
) -> tuple[str, ...]:
    """Return what would improve a geometry."""
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
        off = corners_off(fit)
        if off is not None:
            advice.append(off)
        pictures = len(multishot_sequence(camera_size_px).names)
        advice.append(
            f"show more poses than {len(fit.poses)}: twice as many take three tenths off the bias; more than "
            f"{pictures} pictures per pose take off 1 %"
        )
    return tuple(advice)
