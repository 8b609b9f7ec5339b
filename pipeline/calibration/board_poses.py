"""The corners of a board in its poses, as the camera and the projector see them.

The camera sees the corners, and phase patterns determine which projector pixel every camera pixel sees. A homography
between the two around a corner gives the corner's place in the projector without interpolating at a black edge
(D. Moreno and G. Taubin, Simple, accurate, and robust projector-camera calibration, 2012,
doi:10.1109/3DIMPVT.2012.77).

The captures also show how sharp they are, and whether the board stood still: the mean of a level's fringes, over its
steps, is a picture evenly lit, for the steps are spread evenly over a cycle. So the board is seen in it as in the white
picture, only later, and its corners can be compared.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from pipeline.calibration.board import Board
from pipeline.calibration.multishot import ProjectorMap, decode_multishot, fringe_groups, multishot_sequence
from pipeline.calibration.picture_matching import find_poses
from pipeline.errors import CalibrationError
from pipeline.models import FloatArray, ImageArray, SensorPart
from pipeline.robust import robust_sigma

# Within this part of a square's side about a corner there are its edges, and no others.
_REACH = 0.4
# The least reach, px: an edge blurred by 1 px is 4 px wide.
_MIN_REACH_PX = 4
# The smoothing, px, before slopes are measured, so that noise does not pass for a sharp edge; and what it and the
# difference of neighbours add to an edge's variance, px^2.
_SMOOTHING_PX, _ADDED_PX2 = 1.0, 1.0 + 1 / 3
#: Poses at least: three determine a lens, and with eight a wrong one stands out from the others.
MIN_POSES = 8
# A pose with fewer corners shows little of the lenses in addition to its own place (six parameters).
_MIN_CORNERS = 12
# The radius around a corner in which projector coordinates are fitted, over a square's side on the camera's image:
# below one, so that it ends before the next corners.
_RADIUS = 0.9
# That radius at least, px, for boards far away.
_MIN_RADIUS_PX = 6
# Lit pixels within it at least: a homography has eight parameters, and noise must average out.
_MIN_LIT_PX = 60
# The half window, px, below which a corner is not refined: OpenCV's fit then sees too few edge pixels.
_MIN_HALF_WINDOW_PX = 3
# The half window, px, at most: a lens bends the edges of a longer one.
_MAX_HALF_WINDOW_PX = 8
# OpenCV's refinement ends after 60 steps, or when a corner moves by less than 1e-4 px.
_REFINEMENT_END = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-4)


@dataclass(frozen=True)
class PictureEvidence:
    """The evidence in the pictures of one pose of how they were taken."""

    blur_px: float  # sigma of the edges at the corners; NaN: there is no room to see it
    drift_px: tuple[tuple[str, float], ...]  # by how much corners have moved since the white picture, and the name of
    # the picture before which they had, in order of projection

    @property
    def moved_px(self) -> float:
        """The largest move of the corners while the pictures were taken; 0 where none was searched for."""
        return max((moved for _, moved in self.drift_px), default=0.0)

    @property
    def moved_before(self) -> str:
        """The first picture by which corners had moved by half as much or more."""
        return next(name for name, moved in self.drift_px if moved >= 0.5 * self.moved_px)


def edge_blur_px(grey: FloatArray, corners: FloatArray, side_px: float) -> float:
    """Return how blurred a picture is at a board's corners, as the sigma of its edges, px.

    Parameters
    ----------
    grey : (H, W)
        Any scale.
    corners : (N, 2)
        Places where black meets white, px.
    side_px : float
        A square's side.

    Notes
    -----
    An edge of height h that is blurred by a Gaussian of sigma has the slope h / (sigma sqrt(2 pi)) in its middle. The
    result is the corners' median; what noise and the edge's own smoothing add is taken off.
    """
    smooth = cv2.GaussianBlur(grey, (0, 0), _SMOOTHING_PX)
    slope = np.hypot(*np.gradient(smooth))
    reach = max(round(_REACH * side_px), _MIN_REACH_PX)
    found = []
    for x, y in np.rint(corners).astype(int):
        if min(x, y) < reach or x + reach >= grey.shape[1] or y + reach >= grey.shape[0]:
            continue
        window = np.s_[y - reach : y + reach + 1, x - reach : x + reach + 1]
        height = float(np.ptp(smooth[window]))
        steepest = float(slope[window].max())
        if steepest > 0:
            found.append((height / steepest) ** 2 / (2 * np.pi) - _ADDED_PX2)
    return float(np.sqrt(max(np.median(found), 0.0))) if found else float("nan")


def find_drift(
    captures: Mapping[str, ImageArray],
    grey: FloatArray,
    corners: FloatArray,
    refine: Callable[[FloatArray, FloatArray], FloatArray],
) -> tuple[tuple[str, float], ...]:
    """Return how far a board's corners have moved since the white picture, group by group of fringes.

    Parameters
    ----------
    captures : mapping from name to (H, W, 3)
        The captures of `multishot_sequence`.
    grey : (H, W)
        The white one, 0..1.
    corners : (N, 2)
        Its corners, px.
    refine : callable
        From a picture and corners nearby to the corners in it.

    Returns
    -------
    tuple of (str, float)
        A group's first picture, and the median distance, px, of its corners from those of the white picture.
    """
    before = refine(grey, corners)
    found = []
    for names in fringe_groups():
        lit = sum(captures[name].astype(np.float64).mean(axis=-1) for name in names)
        # As bright as the white picture, which the refinement's smoothing and thresholds are made for.
        after = refine(lit * (grey.max() / max(float(np.max(lit)), 1e-9)), before)
        found.append((names[0], float(np.median(np.linalg.norm(after - before, axis=1)))))
    return tuple(found)


@dataclass(frozen=True)
class BoardPose:
    """The corners of one pose, as camera and projector see them."""

    name: str
    corners_mm: FloatArray  # (N, 3)
    camera_px: FloatArray  # (N, 2)
    projector_px: FloatArray  # (N, 2)
    camera_shift_px: FloatArray  # (3, 2) how R, G and B differ from their mean; NaN where squares are too small
    projector_shift_px: FloatArray  # (3, 2) the same in the projector, at the same camera pixel
    jacobian: FloatArray  # (2, 2) projector px a camera px, mean
    evidence: PictureEvidence | None = None  # what else the pictures show; None: not examined


def measure_pose(
    name: str,
    captures: Mapping[str, ImageArray],
    board: Board,
    projector_size_px: tuple[int, int],
    white_level: float | None = None,
) -> BoardPose:
    """Find a board's corners in camera and projector.

    Parameters
    ----------
    name : str
        Name for messages.
    captures : mapping from name to (H, W, 3)
        The captures of `multishot_sequence`.
    board : Board
        The board in the pose.
    projector_size_px : (width, height)
        The projector's.
    white_level : float, optional
        Full scale; None: the type's.

    Raises
    ------
    CalibrationError
        The board is not seen, or not lit, or the camera's images or the projector's picture are mirrored.
    """
    seen = decode_multishot(captures, projector_size_px, name, white_level)
    grey = seen.white.mean(axis=-1)
    try:
        numbers, corners = board.find(grey)
    except CalibrationError as error:
        raise CalibrationError(f"{name}: {error}") from None
    side = _square_px(corners, board.corners_mm()[numbers], board.square_mm)
    window = _half_window(side, board)
    corners = _refined(grey, corners, window)

    def refine(picture: FloatArray, start: FloatArray) -> FloatArray:
        # Where the corner's own edges leave no room, others in the window turn all pictures' corners alike.
        return _refined(picture, start, max(window, _MIN_HALF_WINDOW_PX))

    radius = max(_RADIUS * side, _MIN_RADIUS_PX)
    projector = np.full(corners.shape, np.nan)
    jacobians = []
    for k, corner in enumerate(corners):
        local = _local_homography(seen, corner, radius)
        if local is not None:
            projector[k] = local[:2, 2] / local[2, 2]
            jacobians.append((local[:2, :2] - np.outer(projector[k], local[2, :2])) / local[2, 2])
    good = ~np.isnan(projector).any(axis=1)
    if np.count_nonzero(good) < _MIN_CORNERS or not board.spans(numbers[good]):
        raise CalibrationError(
            f"{name}: only {np.count_nonzero(good)} of the board's corners are seen and lit by the projector, "
            f"{_MIN_CORNERS} are needed: turn the board to both"
        )
    jacobian = np.mean(jacobians, axis=0)
    if np.linalg.det(jacobian) < 0:
        # A chessboard looks the same in a mirror; a ChArUco board's markers have shown that the camera is right.
        who = "the projector's picture" if board.kind == "charuco" else "the camera's picture or the projector's"
        raise CalibrationError(f"{name}: {who} is mirrored: switch off mirror, rear-projection or ceiling mode")
    return BoardPose(
        name=name,
        corners_mm=board.corners_mm()[numbers][good],
        camera_px=corners[good],
        projector_px=projector[good],
        camera_shift_px=_channel_corners(seen.white, corners[good], window),
        projector_shift_px=_projector_shift(seen, corners[good]),
        jacobian=jacobian,
        evidence=PictureEvidence(edge_blur_px(grey, corners, side), find_drift(captures, grey, corners, refine)),
    )


def _half_window(side_px: float, board: Board) -> int:
    """Return the half window, px, in which a corner is refined: in it there must be nothing but the corner's edges."""
    marker = board.marker_mm or 0.75 * board.square_mm
    free = 0.4 if board.kind == "chessboard" else 0.5 * (1 - marker / board.square_mm)
    return int(np.clip(free * side_px - 1, 0, _MAX_HALF_WINDOW_PX))


def _refined(grey: FloatArray, corners: FloatArray, half: int) -> FloatArray:
    """Return corners to a few hundredths of a pixel, (N, 2); as they are where there is no room."""
    if half < _MIN_HALF_WINDOW_PX:
        return corners
    # Edges sharper than a pixel pull corners towards pixel centres: smoothed, the error halves.
    smooth = cv2.GaussianBlur((255 * grey).astype(np.float32), (0, 0), 1.2)
    start = corners.astype(np.float32).copy()
    return np.asarray(cv2.cornerSubPix(smooth, start, (half, half), (-1, -1), _REFINEMENT_END), np.float64)


def _square_px(corners: FloatArray, corners_mm: FloatArray, square_mm: float) -> float:
    """Return how long a square's side is in the image, roughly."""
    to_px, _ = cv2.findHomography(corners_mm[:, :2], corners)
    middle = corners_mm[:, :2].mean(axis=0)
    square = middle + square_mm * np.array([[0, 0], [1, 0], [0, 1]])
    a, b, c = cv2.perspectiveTransform(square[None], to_px)[0]
    return float(min(np.linalg.norm(b - a), np.linalg.norm(c - a)))


def _local_homography(seen: ProjectorMap, corner: FloatArray, radius: float) -> FloatArray | None:
    """Return the homography from camera px about a corner to projector px, from the pixels around it that are lit."""
    height, width = seen.position_px.shape[:2]
    left, right = int(max(corner[0] - radius, 0)), int(min(corner[0] + radius + 2, width))
    top, bottom = int(max(corner[1] - radius, 0)), int(min(corner[1] + radius + 2, height))
    y, x = np.mgrid[top:bottom, left:right]
    values = seen.position_px[top:bottom, left:right]
    inside = ~np.isnan(values[..., 0]) & (np.hypot(x - corner[0], y - corner[1]) <= radius)
    # Pixels on both sides of the corner, or the homography is a guess.
    if np.count_nonzero(inside) < _MIN_LIT_PX:
        return None
    from_px = np.stack([x[inside] - corner[0], y[inside] - corner[1]], axis=1).astype(np.float64)
    to_px = values[inside]
    # A cycle that is mistaken is off by its whole length, or many.
    for method in (cv2.LMEDS, 0):
        matrix, _ = cv2.findHomography(from_px, to_px, method)
        if matrix is None:
            return None
        misfit = np.linalg.norm(cv2.perspectiveTransform(from_px[None], matrix)[0] - to_px, axis=1)
        keep = misfit < max(3 * robust_sigma(misfit), 0.02)
        from_px, to_px = from_px[keep], to_px[keep]
        if len(from_px) < _MIN_LIT_PX // 2:
            return None
    return np.asarray(matrix)


def _channel_corners(white: FloatArray, corners: FloatArray, half: int) -> FloatArray:
    """Return by how much the corners of R, G and B alone differ from those of their mean, (3, 2) px; NaN: no room."""
    if half < _MIN_HALF_WINDOW_PX:
        return np.full((3, 2), np.nan)
    alone = [_refined(white[..., channel], corners, half) - corners for channel in range(3)]
    return np.asarray(np.median(alone, axis=1))


def _projector_shift(seen: ProjectorMap, corners: FloatArray) -> FloatArray:
    """Return by how much R, G and B alone decode another projector pixel than their sum, (3, 2) px, on the board."""
    height, width = seen.position_px.shape[:2]
    board = np.zeros((height, width), np.uint8)
    cv2.fillConvexPoly(board, cv2.convexHull(corners.astype(np.int32)), 1)
    inside = (board > 0) & ~np.isnan(seen.position_px[..., 0])
    return np.asarray(np.median(seen.channel_shift_px[:, inside], axis=1))


@dataclass(frozen=True)
class MeasuredPoses:
    """The poses that could be measured."""

    poses: list[BoardPose]
    refused: tuple[str, ...]  # why others could not, one sentence each
    camera_size_px: tuple[int, int]
    sensor: SensorPart | None = None  # the part of the camera's that all captures are; None: not known of all


def measure_poses(
    place: Path,
    board: Board,
    projector_size_px: tuple[int, int],
    white_level: float | None = None,
    least: int = MIN_POSES,
) -> MeasuredPoses:
    """Find the board in every pose.

    Parameters
    ----------
    place : Path
        A folder with a folder per pose, each with the captures of `multishot_sequence`, or footage with all poses; see
        `find_poses`.
    board : Board
        The board in the pose.
    projector_size_px : (width, height)
        The projector's.
    white_level : float, optional
        Full scale; None: the type's.
    least : int
        Number of poses needed.

    Raises
    ------
    CalibrationError
        Captures are missing, they differ in size, or the board is found in too few of them.
    FootageError
        They cannot be read.
    """
    sequence = multishot_sequence(projector_size_px)
    poses: list[BoardPose] = []
    refused: list[str] = []
    camera_px = None
    parts: set[SensorPart | None] = set()
    for name, captures in find_poses(place, sequence):
        height, width = captures[sequence.names[0]].shape[:2]
        if camera_px is not None and camera_px != (width, height):
            raise CalibrationError(f"{name} is {width}x{height}, the poses before are {camera_px[0]}x{camera_px[1]}")
        camera_px = (width, height)
        parts.add(captures.sensor)
        if len(parts - {None}) > 1:
            raise CalibrationError(f"{name} shows another part of the sensor than the poses before: leave it out")
        try:
            # Read once and in order, as videos are read fastest.
            poses.append(measure_pose(name, dict(captures), board, projector_size_px, white_level))
        except CalibrationError as error:
            refused.append(str(error))
    if camera_px is None or len(poses) < least:
        reason = refused[0] if refused else f"{place} holds {len(poses)}"
        raise CalibrationError(f"{len(poses)} usable poses, at least {least} are needed: {reason}")
    return MeasuredPoses(poses, tuple(refused), camera_px, parts.pop() if len(parts) == 1 else None)
