"""Which pose fits worst, and which were taken badly, and why, as far as pictures and places show it.

A cause is named only where the data shows it: corners that are found elsewhere in later pictures, edges that are less
sharp than in the other poses, a board seen at a slant or from afar, or an error that a few corners carry alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from pipeline.calibration.board_poses import BoardPose
from pipeline.calibration.bundle_adjustment import BundleAdjustment
from pipeline.models import FloatArray

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
# Squares of fewer px leave no room for the corners' windows; and what counts as far away beside the other poses.
_SMALL_PX, _SMALL = 12.0, 0.6
# The worst tenth of the corners carries a third of the squared error where it is noise; so much only where it is their
# own.
_FEW_SHARE, _FEW = 0.6, 0.1


@dataclass(frozen=True)
class PoseJudgement:
    """How a pose fits beside the others."""

    name: str
    rms_px: tuple[float, float]  # camera, projector
    usual_px: tuple[float, float]  # the median pose's
    causes: tuple[str, ...]  # that the data shows

    @property
    def stands_out(self) -> bool:
        """Whether it fits worse than chance explains."""
        return any(rms > _STANDS_OUT * usual for rms, usual in zip(self.rms_px, self.usual_px, strict=True))

    def in_words(self) -> str:
        """Return a line that says how it fits, and why."""
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
    beside their place: such poses need not fit badly.
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
    """Return what the data of a pose shows that makes corners lie beside their place, beside the other poses."""
    others = [pose for i, pose in enumerate(fit.poses) if i != k]
    causes = _picture_causes(fit, k)
    tilt = _tilt_deg(fit, k)
    if tilt > _STEEP_DEG:
        causes.append(f"the board is tilted by {tilt:.0f} deg: turn it to {_STEEP_DEG:.0f} deg or less")
    side, usual_side = square_px(fit.poses[k]), float(np.median([square_px(pose) for pose in others]))
    if side < _SMALL_PX or side < _SMALL * usual_side:
        causes.append(f"the board is small, {side:.0f} px a square and elsewhere {usual_side:.0f}: show it nearer")
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
    """Return what a pose's pictures show: a board that moved, or that is not sharp."""
    evidence = fit.poses[k].evidence
    beside = [pose.evidence for i, pose in enumerate(fit.poses) if i != k and pose.evidence is not None]
    if evidence is None:
        return []
    causes = []
    usual_move = float(np.median([other.moved_px for other in beside])) if beside else 0.0
    if evidence.moved_px > max(_MOVED_PX, _MOVED * usual_move):
        causes.append(
            f"it moved: from {evidence.moved_before} on its corners lie up to {evidence.moved_px:.2f} px beside those "
            "of the white picture: let board and camera stand still"
        )
    sharp = [other.blur_px for other in beside if np.isfinite(other.blur_px)]
    usual_blur = float(np.median(sharp)) if sharp else 0.0
    if evidence.blur_px > max(_BLURRED_PX, _BLURRED * usual_blur):
        causes.append(
            f"it is blurred (edges have a sigma of {evidence.blur_px:.1f} px"
            + (f", elsewhere {usual_blur:.1f}" if sharp else "")
            + "): show the board in focus, and let it stand still"
        )
    return causes


def _few_corners(fit: BundleAdjustment, k: int) -> FloatArray | None:
    """Return the middle, camera px, of the few corners that carry most of a pose's error; None: many share it."""
    squared = fit.corner_distances_px(k) ** 2
    device = int(np.argmax(squared.sum(axis=0) / fit.sigma_px**2))
    errors = squared[:, device]
    worst = np.argsort(errors)[-max(round(_FEW * len(errors)), 1) :]
    if errors[worst].sum() < _FEW_SHARE * errors.sum():
        return None
    return np.asarray(fit.poses[k].camera_px[worst].mean(axis=0))
