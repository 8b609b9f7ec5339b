"""Choose the next pose of a calibration board, and decide whether its poses suffice and agree.

Every pose adds to the normal matrix of the bundle adjustment. Its own place, six parameters, is eliminated (Schur's
complement), so that the rest is what the pose shows of the lenses and of the step between them:

    A = K'K - K'J (J'J)^-1 J'K,

with K and J the corners' derivatives, over their standard deviations, by the 24 parameters of the rig and by the place.
The next pose is the one of a set of candidates whose A leaves the least uncertainty of depth.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from pipeline.calibration.board import Board
from pipeline.calibration.board_poses import MIN_POSES, BoardPose
from pipeline.calibration.bundle_adjustment import BundleAdjustment, project_points
from pipeline.calibration.model import Pattern
from pipeline.calibration.verdict import depth_slopes
from pipeline.errors import CalibrationError
from pipeline.models import FloatArray

#: From so many poses on lenses are fitted: 24 parameters and 6 per pose, from two coordinates of dozens of corners in
#: camera and projector.
_FIT_FROM = 4
#: Poses at most: from the tenth on each lowers the uncertainty of depth by less than a tenth.
MOST_POSES = 10
# Another pose is worth its minute while it lowers the uncertainty of depth by this part.
_LEAST_GAIN = 0.06
# Candidates: tilts in deg, towards so many sides, at these parts of the first pose's distance, in the middle and as far
# as the views allow towards so many sides.
_TILT_DEG, _TILT_SIDES = 28.0, 6
_DISTANCES = (0.92, 1.0, 1.1)
_ASIDE_SIDES = 8
# How far from the rim of a view a board should stay, as a part of the view's width: it is held by hand.
_RIM = 0.05
# Steps of a search for the farthest place aside, parts of the distance.
_ASIDE_STEPS = np.linspace(0.36, 0.0, 13)
# Of pictures whose lens is not known yet: focal length over width.
_USUAL_FOCAL = 1.5
# A pose that lies off the lenses of those before it by more than this many standard deviations, RMS, contradicts them.
_CONTRADICTS = 3.0
# A board is bent if its bow exceeds so many standard deviations, and this part of its length: flat ones of glass or
# aluminium keep a tenth of it.
_BOW_SIGMAS, _LEAST_BOW = 5.0, 1 / 1000


class BentBoardError(CalibrationError):
    """The board is bent: none of its poses is of use."""


@dataclass(frozen=True)
class Suggestion:
    """A place to hold the board at."""

    outline_px: FloatArray  # (4, 2) the board's corners in the camera's picture
    words: str


class PoseGuide:
    """The poses of a board so far.

    Parameters
    ----------
    board : Board
        The board that is held.
    camera_px, projector_px : (width, height)
        The sizes of both.
    pattern : Pattern
        Pattern of the frames to be decoded.
    """

    def __init__(
        self, board: Board, camera_px: tuple[int, int], projector_px: tuple[int, int], pattern: Pattern
    ) -> None:
        self.poses: list[BoardPose] = []
        self.depth_mm: list[float] = []  # the predicted uncertainty of depth after each pose that lenses were fitted to
        self.fit: BundleAdjustment | None = None
        self._board, self._camera_px, self._projector_px = board, camera_px, projector_px
        self._axis = 1 if pattern.stripes == "horizontal" else 0

    @property
    def enough(self) -> bool:
        """True where another pose would hardly lower the uncertainty of depth."""
        if len(self.poses) < MIN_POSES or len(self.depth_mm) < 2:
            return False
        return len(self.poses) >= MOST_POSES or self.depth_mm[-1] > (1 - _LEAST_GAIN) * self.depth_mm[-2]

    def add(self, pose: BoardPose) -> None:
        """Take a pose in.

        Raises
        ------
        CalibrationError
            It contradicts the poses before it, and is not taken in.
        BentBoardError
            All poses together show that the board is bent.
        """
        if self.fit is not None:
            self._refuse_contradiction(self.fit, pose)
        self.poses.append(pose)
        if len(self.poses) < _FIT_FROM:
            return
        try:
            fit = BundleAdjustment(self.poses, self._camera_px, self._projector_px)
            fit.refine()
        except (cv2.error, np.linalg.LinAlgError):
            return  # poses that are alike determine no lens yet
        self.fit = fit
        self._refuse_bent(fit)
        covariance = fit.covariance()
        slopes = self._depth_slopes(fit, covariance)
        self.depth_mm.append(_depth_sigma(slopes, covariance))

    def _depth_slopes(self, fit: BundleAdjustment, covariance: FloatArray) -> FloatArray:
        distance = float(np.median(fit.depths_mm()))
        return depth_slopes(fit.parameters[:24], covariance, self._camera_px, self._axis, distance)

    def _refuse_contradiction(self, fit: BundleAdjustment, pose: BoardPose) -> None:
        camera, projector, both = (_misfit(fit, pose, devices) for devices in ((0,), (1,), (0, 1)))
        if both <= _CONTRADICTS:
            return
        if camera > _CONTRADICTS:
            moved = "the camera's lens has changed (focus, zoom or aperture ring), or the board is another one"
        elif projector > _CONTRADICTS:
            moved = "the projector's lens or picture has changed (focus, zoom, keystone)"
        else:
            moved = "a lens has changed (focus, zoom), or camera and projector have moved against each other"
        raise CalibrationError(
            f"{pose.name} contradicts the poses before it ({both:.0f} standard deviations): {moved}. If nothing was "
            "touched, show the board again; else begin in a new folder"
        )

    def _refuse_bent(self, fit: BundleAdjustment) -> None:
        bow = fit.board_bow()
        columns, rows = self._board.squares
        length = float(np.hypot(columns, rows)) * self._board.square_mm
        if abs(bow.height_mm) > max(_BOW_SIGMAS * bow.sigma_mm, _LEAST_BOW * length):
            raise BentBoardError(
                f"the board is bent by {abs(bow.height_mm):.1f} ± {bow.sigma_mm:.1f} mm: glue it on glass, aluminium "
                "or another thing that is flat, and begin in a new folder"
            )

    def suggest(self) -> Suggestion:
        """Return where to hold the board next: where it lowers the uncertainty of depth most."""
        rig = self._rig()
        candidates = list(self._candidates(rig))
        if self.fit is None:
            # Before lenses are known: every second tilt, then those between.
            turn = 2 * len(self.poses)
            chosen = candidates[(turn + turn // _TILT_SIDES) % _TILT_SIDES]
        else:
            covariance = self.fit.covariance()
            known = np.asarray(np.linalg.inv(covariance), np.float64)
            slopes = self._depth_slopes(self.fit, covariance)
            left = [
                _depth_sigma(slopes, np.asarray(np.linalg.inv(known + self._information(self.fit, stands)), np.float64))
                for stands in candidates
            ]
            chosen = candidates[int(np.argmin(left))]
        return self._suggestion(chosen, rig)

    def _rig(self) -> FloatArray:
        """Return the 24 parameters as far as they are known: before, a usual camera's, and a projector at its place."""
        if self.fit is not None:
            return self.fit.parameters[:24]
        lenses = [
            np.array([_USUAL_FOCAL * width, _USUAL_FOCAL * width, (width - 1) / 2, (height - 1) / 2, *np.zeros(5)])
            for width, height in (self._camera_px, self._projector_px)
        ]
        return np.concatenate([*lenses, np.zeros(6)])

    def _candidates(self, rig: FloatArray) -> Iterator[FloatArray]:
        """Yield places of the board, (6,), that both views hold; those in the middle come first."""
        middle = self._middle(rig)
        sides = 2 * np.pi * np.arange(_ASIDE_SIDES) / _ASIDE_SIDES
        asides = [np.zeros(3), *(np.array([np.cos(side), np.sin(side), 0.0]) for side in sides)]
        for aside in asides:
            for distance in _DISTANCES if aside.any() else _DISTANCES[1:2]:
                for side in 2 * np.pi * (np.arange(_TILT_SIDES) + 0.25) / _TILT_SIDES:
                    turn = np.radians(_TILT_DEG) * np.array([np.cos(side), np.sin(side), 0.0])
                    for step in _ASIDE_STEPS:
                        place = distance * middle + step * middle[2] * aside
                        stands = np.concatenate([turn, place])
                        if step == 0 or self._is_seen(stands, rig):
                            yield stands
                            break

    def _middle(self, rig: FloatArray) -> FloatArray:
        """Return where the first pose was, or a board that fills two fifths of the view, in mm on the optical axis."""
        columns, rows = self._board.squares
        if not self.poses:
            side = np.array([columns, rows]) * self._board.square_mm
            return np.array([0.0, 0.0, rig[0] * float((side / (0.6 * np.array(self._camera_px))).max())])
        first = self.poses[0]
        matrix = np.array([[rig[0], 0, rig[2]], [0, rig[1], rig[3]], [0, 0, 1]])
        _, turn, place = cv2.solvePnP(first.corners_mm, first.camera_px, matrix, rig[4:9])
        middle = cv2.Rodrigues(turn)[0] @ first.corners_mm.mean(axis=0) + place.ravel()
        depth = float(middle[2])
        return np.array([0.0, 0.0, depth])

    def _is_seen(self, stands: FloatArray, rig: FloatArray) -> bool:
        """Return whether both views hold the whole board."""
        views = [(stands[:3], stands[3:], rig[:9], self._camera_px)]
        if self.fit is not None:
            turn, place, *_ = cv2.composeRT(stands[:3], stands[3:], rig[18:21], rig[21:24])
            views.append((turn.ravel(), place.ravel(), rig[9:18], self._projector_px))
        for turn, place, lens, size_px in views:
            pixels, _ = project_points(self._board.outline_mm(), turn, place, lens)
            rim = _RIM * size_px[0]
            if (pixels < rim).any() or (pixels > np.array(size_px) - 1 - rim).any():
                return False
        return True

    def _information(self, fit: BundleAdjustment, stands: FloatArray) -> FloatArray:
        """Return the information of a pose on the rig's parameters, (24, 24); see the module."""
        corners = self._board.corners_mm()
        middle = np.array([*self._board.squares, 0]) / 2 * self._board.square_mm
        nowhere = np.zeros((len(corners), 2))
        pose = replace(self.poses[0], corners_mm=corners - middle, camera_px=nowhere, projector_px=nowhere)
        _, slopes = fit.corner_errors(pose, stands)
        weighted = (slopes / fit.sigma_px[None, :, None, None]).reshape(-1, 30)
        normal = weighted.T @ weighted
        rig, own, across = normal[:24, :24], normal[24:, 24:], normal[:24, 24:]
        return np.asarray(rig - across @ np.linalg.solve(own, across.T))

    def _suggestion(self, stands: FloatArray, rig: FloatArray) -> Suggestion:
        pixels, _ = project_points(self._board.outline_mm(), stands[:3], stands[3:], rig[:9])
        across, down = pixels.mean(axis=0) / self._camera_px
        place = " ".join(
            word
            for word in (
                "at the top" if down < 0.42 else "at the bottom" if down > 0.58 else "",
                "on the left" if across < 0.42 else "on the right" if across > 0.58 else "",
            )
            if word
        )
        # How much farther away the board is towards the right and towards the bottom.
        recedes = cv2.Rodrigues(stands[:3])[0][2, :2]
        edges = ("right" if recedes[0] < 0 else "left", "bottom" if recedes[1] < 0 else "top")
        sizes = np.abs(recedes)
        which = [edge for edge, size in zip(edges, sizes, strict=True) if size > 0.4 * sizes.max()]
        tilt = f"its {' and '.join(which)} edge towards the camera by {_TILT_DEG:.0f} deg"
        distance = "" if self.fit is None else f", {stands[5]:.0f} mm away"
        return Suggestion(pixels, f"hold the board {place or 'in the middle'} of the picture{distance}, {tilt}")


def _depth_sigma(slopes: FloatArray, covariance: FloatArray) -> float:
    return float(np.sqrt(np.einsum("ik,ij,jk->k", slopes, covariance, slopes).mean()))


def _misfit(fit: BundleAdjustment, pose: BoardPose, devices: Sequence[int]) -> float:
    """Return how far a pose lies off the lenses of others, RMS in standard deviations, these being uncertain.

    The pose's place and, within their covariance, the lenses move to where they fit best: one step from where the
    camera sees the board.
    """
    lens = fit.parameters[:9]
    matrix = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1]])
    _, turn, place = cv2.solvePnP(pose.corners_mm, pose.camera_px, matrix, lens[4:])
    stands = np.concatenate([turn.ravel(), place.ravel()])
    known = np.linalg.inv(fit.covariance())
    rig = np.zeros(24)
    weight = 1 / fit.sigma_px[list(devices)]
    for _ in range(3):
        error, slopes = fit.corner_errors(pose, stands)
        rows = (slopes[:, devices] * weight[None, :, None, None]).reshape(-1, 30)
        start = (error[:, devices] * weight[None, :, None]).ravel()
        normal = rows.T @ rows
        normal[:24, :24] += known
        step = np.linalg.solve(normal + 1e-9 * np.diag(np.diag(normal)), -rows.T @ start)
        stands = np.asarray(stands + step[24:], np.float64)
        rig = np.asarray(step[:24], np.float64)
    left = start + rows @ step
    cost = float(left @ left + rig @ known @ rig)
    return float(np.sqrt(cost / max(len(left) - 6, 1)))
