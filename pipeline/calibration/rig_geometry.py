"""Where camera and projector stand, and what their lenses do, from a board in several poses.

In each pose the camera sees the board's corners, and phase patterns tell which projector pixel every camera pixel sees;
a homography between the two around a corner gives the corner's place in the projector without interpolating at a black
edge (D. Moreno and G. Taubin, Simple, accurate, and robust projector-camera calibration, 2012,
doi:10.1109/3DIMPVT.2012.77). The projector is then a second camera. Both lenses, where they stand, and all poses of the
board are refined together by least squares, whose normal matrix gives the standard deviations.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.calibration.board import Board
from pipeline.calibration.model import Calibration, ColorShift, Lens, Pattern, Uncertainty
from pipeline.calibration.multishot import ProjectorMap, decode_multishot
from pipeline.errors import CalibrationError
from pipeline.models import FloatArray, ImageArray

MIN_POSES = 8
_MIN_CORNERS = 12
# Around a corner, this part of a square's side on the camera's picture: inside the four squares that meet there.
_WINDOW, _MIN_WINDOW_PX, _MIN_WINDOW_PIXELS = 0.9, 6, 60
# What lenses do: standard deviations of k1, k2, p1, p2, k3 before anything was measured. A projector's or a machine
# lens's stay well inside; without them, terms that no corner shows would run away.
_LENS_PRIOR = np.array([1.0, 1.0, 0.02, 0.02, 1.0])
# A pose that fits worse than the median by this factor, and by more than noise, is left out.
_OUTLIER, _OUTLIER_PX = 3.0, 0.2
# Corners further from the fit than this many deviations are left out.
_CORNER_SIGMAS = 4.5
# Two poses closer than this add nothing.
_SAME_DEG, _SAME_PART = 2.0, 0.02
# Poses that are all alike leave the focal lengths open: more than this part is no calibration.
_MAX_FOCAL_SIGMA = 0.02
# Where depth moves the light this much less across the stripes than along them, they run along the baseline.
_MIN_ACROSS = 0.3
# A baseline that is known to the user shows a wrong square size beyond this.
_MAX_BASELINE_ERROR = 0.02
# Lateral colour below this, px, changes nothing that could be measured: 0.03 px is 0.016 rad at 12 px a cycle.
_MIN_COLOR_SHIFT_PX = 0.03


@dataclass(frozen=True)
class BoardPose:
    """The corners of one pose, as camera and projector see them."""

    name: str
    corners_mm: FloatArray  # (N, 3)
    camera_px: FloatArray  # (N, 2)
    projector_px: FloatArray  # (N, 2)
    camera_shift_px: FloatArray  # (3, 2) what R, G and B say more than their mean; NaN where squares are too small
    projector_shift_px: FloatArray  # (3, 2) the same in the projector, at the same camera pixel
    jacobian: FloatArray  # (2, 2) projector px a camera px, mean


@dataclass(frozen=True)
class GeometryFit:
    """A calibrated geometry, and how far it can be trusted."""

    calibration: Calibration
    poses: tuple[str, ...]  # that were used
    left_out: tuple[tuple[str, str], ...]  # names, and why
    camera_rms_px: float
    projector_rms_px: float


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
        What the pose is called in messages.
    captures : mapping from name to (H, W, 3)
        The captures of `multishot_sequence`.
    board : Board
        What stands there.
    projector_size_px : (width, height)
        The projector's.
    white_level : float, optional
        Full scale; None: the type's.

    Raises
    ------
    CalibrationError
        The board is not seen, or not lit, or the pictures are mirrored.
    """
    seen = decode_multishot(captures, projector_size_px, name, white_level)
    grey = seen.white.mean(axis=-1)
    found = board.find(grey)
    if found is None:
        if board.kind == "charuco" and board.find(np.ascontiguousarray(grey[:, ::-1])) is not None:
            raise CalibrationError(f"{name}: the camera's pictures are mirrored: switch that off")
        whole = "whole, " if board.kind == "chessboard" else ""
        columns, rows = board.squares
        raise CalibrationError(
            f"{name}: no {columns}x{rows} {board.kind} is seen: it must be {whole}sharp and lit, and as described"
        )
    numbers, corners = found
    side = _square_px(corners, board.corners_mm()[numbers], board.square_mm)
    window = _half_window(side, board)
    corners = _refined(grey, corners, window)
    radius = max(_WINDOW * side, _MIN_WINDOW_PX)
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
        # A chessboard looks the same in a mirror; a ChArUco board's markers have said that the camera is right.
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
    )


_MIN_HALF_WINDOW_PX = 3
_SUBPIX = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-4)


def _half_window(side_px: float, board: Board) -> int:
    """Return the half window, px, in which a corner is refined: in it there must be nothing but the corner's edges."""
    marker = board.marker_mm or 0.75 * board.square_mm
    free = 0.4 if board.kind == "chessboard" else 0.5 * (1 - marker / board.square_mm)
    return int(np.clip(free * side_px - 1, 0, 8))


def _refined(grey: FloatArray, corners: FloatArray, half: int) -> FloatArray:
    """Return corners to a few hundredths of a pixel, (N, 2); as they are where there is no room."""
    if half < _MIN_HALF_WINDOW_PX:
        return corners
    # Edges sharper than a pixel pull corners towards pixel centres: smoothed, the error halves.
    picture = cv2.GaussianBlur((255 * grey).astype(np.float32), (0, 0), 1.2)
    start = corners.astype(np.float32).copy()
    return np.asarray(cv2.cornerSubPix(picture, start, (half, half), (-1, -1), _SUBPIX), np.float64)


def _square_px(corners: FloatArray, corners_mm: FloatArray, square_mm: float) -> float:
    """Return how long a square's side is on the picture, roughly."""
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
    if np.count_nonzero(inside) < _MIN_WINDOW_PIXELS:
        return None
    from_px = np.stack([x[inside] - corner[0], y[inside] - corner[1]], axis=1).astype(np.float64)
    to_px = values[inside]
    for _ in range(2):
        matrix, _ = cv2.findHomography(from_px, to_px)
        if matrix is None:
            return None
        misfit = np.linalg.norm(cv2.perspectiveTransform(from_px[None], matrix)[0] - to_px, axis=1)
        keep = misfit < max(3 * 1.4826 * np.median(misfit), 0.02)
        from_px, to_px = from_px[keep], to_px[keep]
        if len(from_px) < _MIN_WINDOW_PIXELS // 2:
            return None
    return np.asarray(matrix)


def _channel_corners(white: FloatArray, corners: FloatArray, half: int) -> FloatArray:
    """Return by how much the corners of R, G and B alone lie beside those of their mean, (3, 2) px; NaN: no room."""
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


def solve_geometry(
    poses: list[BoardPose],
    camera_size_px: tuple[int, int],
    projector_size_px: tuple[int, int],
    pattern: Pattern,
    base: Calibration | None = None,
    baseline_mm: float | None = None,
) -> GeometryFit:
    """Calibrate both lenses and where they stand.

    Parameters
    ----------
    poses : list of BoardPose
        At least eight that differ.
    camera_size_px, projector_size_px : (width, height)
        Sizes.
    pattern : Pattern
        What will be projected when frames are decoded.
    base : Calibration, optional
        A calibration whose light is kept.
    baseline_mm : float, optional
        The distance between camera and projector where it is known: a wrong square size shows in it.

    Raises
    ------
    CalibrationError
        Too few poses, all alike, or they do not fit together; sizes, pattern, baseline or base are another rig's.
    """
    _check_rig(poses, camera_size_px, projector_size_px, pattern, base)
    if baseline_mm is not None and not baseline_mm > 0:
        raise CalibrationError(f"the baseline is given as {baseline_mm:g} mm: measure it from lens to lens")
    left_out: list[tuple[str, str]] = []
    kept = _without_repeats(poses, camera_size_px, left_out)
    while True:
        _need(kept, left_out)
        try:
            fit = _Bundle(kept, camera_size_px, projector_size_px)
            fit.refine()
        except (cv2.error, np.linalg.LinAlgError):
            raise CalibrationError(
                "no lens fits these poses: tilt the board by 15-35 deg, a different way in each pose, and fill the view"
            ) from None
        errors = fit.pose_errors_px()
        worst = int(np.argmax(errors))
        limit = max(_OUTLIER * float(np.median(errors)), _OUTLIER_PX)
        if errors[worst] <= limit:
            break
        left_out.append(
            (kept[worst].name, f"its corners lie {errors[worst]:.2f} px off, others {np.median(errors):.2f}")
        )
        kept = kept[:worst] + kept[worst + 1 :]
    if fit.camera_rms_px > 1.0 or fit.projector_rms_px > 1.0:
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
    across, along = fit.px_per_mm(pattern)
    if across < _MIN_ACROSS * along:
        other = "vertical" if pattern.stripes == "horizontal" else "horizontal"
        raise CalibrationError(
            f"{pattern.stripes} stripes run along the line from camera to projector, where their phase tells no depth: "
            f"calibrate for {other} ones"
        )
    found = float(np.linalg.norm(fit.stereo[3:]))
    if baseline_mm is not None and abs(found / baseline_mm - 1) > _MAX_BASELINE_ERROR:
        raise CalibrationError(
            f"the baseline comes out as {found:.1f} mm but is {baseline_mm:.1f} mm: the squares are then "
            f"{baseline_mm / found:.4f} times as large as given"
        )
    calibration = _calibration(fit, camera_size_px, projector_size_px, pattern, base)
    # An earlier calibration's lateral colour goes with its lenses.
    shift = _color_shift(kept, calibration.crosstalk_matrix)
    calibration = calibration.model_copy(update={"color_shift_px": shift})
    names = tuple(pose.name for pose in kept)
    return GeometryFit(calibration, names, tuple(left_out), fit.camera_rms_px, fit.projector_rms_px)


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
    """Leave out poses that repeat an earlier one; a rough lens is good enough to see it."""
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
    return [pose for pose, _, _ in kept]


class _Bundle:
    """Both lenses, the projector's place and every pose of the board, refined together.

    Parameters, in order: fx, fy, cx, cy, k1, k2, p1, p2, k3 of the camera; the same of the projector; rotation vector
    and translation from camera to projector; then rotation vector and translation of each pose.
    """

    def __init__(
        self, poses: list[BoardPose], camera_size_px: tuple[int, int], projector_size_px: tuple[int, int]
    ) -> None:
        self.poses = poses
        self.used: list[npt.NDArray[np.bool_]] = [np.ones(len(pose.corners_mm), np.bool_) for pose in poses]
        self.sigma_px = np.array([0.1, 0.1])  # of a corner's coordinate in camera and projector
        points = [pose.corners_mm.astype(np.float32) for pose in poses]
        lenses, boards = [], []
        for size, pixels in (
            (camera_size_px, [pose.camera_px for pose in poses]),
            (projector_size_px, [pose.projector_px for pose in poses]),
        ):
            views = [view.astype(np.float32) for view in pixels]
            start = cv2.initCameraMatrix2D(points, views, size)
            flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3
            _, matrix, distortion, turns, places = cv2.calibrateCamera(points, views, size, start, None, flags=flags)
            lenses.append(np.array([matrix[0, 0], matrix[1, 1], *matrix[:2, 2], *distortion.ravel()[:5]]))
            boards.append([np.concatenate([t.ravel(), p.ravel()]) for t, p in zip(turns, places, strict=True)])
        # From camera to projector: the mean over the poses of projector pose after camera pose undone. Of matrices, as
        # rotation vectors of a projector that hangs upside down change sign from pose to pose.
        turns = [cv2.Rodrigues(p[:3])[0] @ cv2.Rodrigues(c[:3])[0].T for c, p in zip(*boards, strict=True)]
        left, _, right = np.linalg.svd(np.sum(turns, axis=0))
        steps = [p[3:] - turn @ c[3:] for turn, c, p in zip(turns, *boards, strict=True)]
        turn = cv2.Rodrigues(left @ right)[0].ravel()
        self.parameters = np.concatenate([*lenses, turn, np.median(steps, axis=0), *boards[0]])

    @property
    def stereo(self) -> FloatArray:
        """Rotation vector and translation (mm) from camera to projector."""
        return self.parameters[18:24]

    def refine(self) -> None:
        """Find the least squares; leave out single corners far from it; learn what noise the corners have."""
        for _ in range(3):
            self._descend()
            residuals = [self._residuals(k)[0] for k in range(len(self.poses))]
            inliers = [r[used] for r, used in zip(residuals, self.used, strict=True)]
            everything = np.concatenate(inliers)  # (N, 2 devices, 2)
            # Each pose takes 6 parameters, the lenses and the step 24; camera and projector share them.
            freedom = max(1 - (24 + 6 * len(self.poses)) / everything.size, 0.2)
            self.sigma_px = np.sqrt((everything**2).mean(axis=(0, 2)) / freedom)
            limit = _CORNER_SIGMAS * self.sigma_px[None, :, None]
            self.used = [np.asarray((np.abs(r) < limit).all(axis=(1, 2))) for r in residuals]

    def _descend(self) -> None:
        damping, cost, best = 1e-3, np.inf, self.parameters
        for _ in range(60):
            normal, gradient, now = self._normal_equations()
            if now < cost:
                if cost - now < 1e-9 * now:
                    break
                cost, best, damping = now, self.parameters.copy(), damping / 5
            else:
                self.parameters = best.copy()
                damping *= 10
                if damping > 1e8:
                    break
                normal, gradient, _ = self._normal_equations()
            step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), -gradient)
            self.parameters = self.parameters + step
        self.parameters = best

    def _normal_equations(self) -> tuple[FloatArray, FloatArray, float]:
        size = len(self.parameters)
        normal, gradient, cost = np.zeros((size, size)), np.zeros(size), 0.0
        for k in range(len(self.poses)):
            residual, jacobian = self._residuals(k)
            weight = (self.used[k][:, None, None] / self.sigma_px[None, :, None] ** 2 * np.ones((1, 1, 2))).ravel()
            rows, flat = jacobian.reshape(-1, size), residual.ravel()
            normal += rows.T @ (rows * weight[:, None])
            gradient += rows.T @ (weight * flat)
            cost += float(weight @ flat**2)
        for start in (4, 13):
            terms = slice(start, start + 5)
            normal[range(start, start + 5), range(start, start + 5)] += 1 / _LENS_PRIOR**2
            gradient[terms] += self.parameters[terms] / _LENS_PRIOR**2
            cost += float(((self.parameters[terms] / _LENS_PRIOR) ** 2).sum())
        return normal, gradient, cost

    def _residuals(self, k: int) -> tuple[FloatArray, FloatArray]:
        """Return a pose's errors, (N, 2 devices, 2) px, and their derivatives by every parameter."""
        pose, p = self.poses[k], self.parameters
        at = 24 + 6 * k
        turn, place = p[at : at + 3], p[at + 3 : at + 6]
        count = len(pose.corners_mm)
        residual, jacobian = np.zeros((count, 2, 2)), np.zeros((count, 2, 2, len(p)))
        pixels, slopes = _project(pose.corners_mm, turn, place, p[:9])
        residual[:, 0] = pixels - pose.camera_px
        jacobian[:, 0, :, at : at + 6], jacobian[:, 0, :, :9] = slopes[..., :6], slopes[..., 6:]
        turn3, place3, *chain = cv2.composeRT(turn, place, self.stereo[:3], self.stereo[3:])
        dr_dr1, dr_dt1, dr_dr2, dr_dt2, dt_dr1, dt_dt1, dt_dr2, dt_dt2 = chain
        pixels, slopes = _project(pose.corners_mm, turn3.ravel(), place3.ravel(), p[9:18])
        residual[:, 1] = pixels - pose.projector_px
        by_turn, by_place = slopes[..., :3], slopes[..., 3:6]
        jacobian[:, 1, :, at : at + 3] = by_turn @ dr_dr1 + by_place @ dt_dr1
        jacobian[:, 1, :, at + 3 : at + 6] = by_turn @ dr_dt1 + by_place @ dt_dt1
        jacobian[:, 1, :, 18:21] = by_turn @ dr_dr2 + by_place @ dt_dr2
        jacobian[:, 1, :, 21:24] = by_turn @ dr_dt2 + by_place @ dt_dt2
        jacobian[:, 1, :, 9:18] = slopes[..., 6:]
        return residual, jacobian

    def _rms_px(self, device: int) -> float:
        errors = [self._residuals(k)[0][used, device] for k, used in enumerate(self.used)]
        return float(np.sqrt((np.concatenate(errors) ** 2).sum(axis=-1).mean()))

    @property
    def camera_rms_px(self) -> float:
        """RMS distance of corners from where the camera's model puts them."""
        return self._rms_px(0)

    @property
    def projector_rms_px(self) -> float:
        """The same of the projector."""
        return self._rms_px(1)

    def pose_errors_px(self) -> FloatArray:
        """Return the median distance of each pose's corners, of camera or projector, whichever is worse."""
        errors = [np.linalg.norm(self._residuals(k)[0], axis=-1) for k in range(len(self.poses))]
        return np.array([np.median(e, axis=0).max() for e in errors])

    def focal_sigma(self) -> float:
        """Return the standard deviation of the least certain focal length, over that length."""
        focal = np.array([0, 1, 9, 10])
        return float((np.sqrt(np.diag(self.covariance())[focal]) / self.parameters[focal]).max())

    def px_per_mm(self, pattern: Pattern) -> tuple[float, float]:
        """Return how far depth moves the light in the projector, across and along the pattern's stripes."""
        depth = float(np.median(self.depths_mm()))
        points = np.array([[0, 0, depth - 0.5], [0, 0, depth + 0.5]])
        pixels, _ = _project(points, self.stereo[:3], self.stereo[3:], self.parameters[9:18])
        column, row = np.abs(pixels[1] - pixels[0])
        return (float(row), float(column)) if pattern.stripes == "horizontal" else (float(column), float(row))

    def covariance(self) -> FloatArray:
        """Return the covariance of the lenses' and the step's 24 parameters."""
        return np.asarray(np.linalg.inv(self._normal_equations()[0])[:24, :24])

    def depths_mm(self) -> FloatArray:
        """Return how far the corners are from the camera, all poses together."""
        depths = [
            (cv2.Rodrigues(turn[:3])[0] @ pose.corners_mm.T)[2] + turn[5]
            for pose, turn in zip(self.poses, self.parameters[24:].reshape(-1, 6), strict=True)
        ]
        return np.concatenate(depths)


def _project(
    points: FloatArray, turn: FloatArray, place: FloatArray, lens: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return pixels, and their derivatives by rotation, translation and the lens, (N, 2, 15)."""
    matrix = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1]])
    pixels, slopes = cv2.projectPoints(points, turn, place, matrix, lens[4:])
    return pixels.reshape(-1, 2), slopes[:, :15].reshape(-1, 2, 15)


def _lens(size_px: tuple[int, int], values: FloatArray) -> Lens:
    matrix = np.array([[values[0], 0, values[2]], [0, values[1], values[3]], [0, 0, 1]])
    return Lens(size_px=size_px, matrix=matrix, distortion=values[4:])


def _calibration(
    fit: _Bundle,
    camera_size_px: tuple[int, int],
    projector_size_px: tuple[int, int],
    pattern: Pattern,
    base: Calibration | None,
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
        }
    )


def depth_bias_mm(
    parameters: FloatArray, covariance: FloatArray, camera_size_px: tuple[int, int], axis: int, depth_mm: float
) -> float:
    """Return the standard deviation of depth that the calibration's own uncertainty leaves, RMS over the picture.

    Parameters
    ----------
    parameters : (24,)
        Camera, projector (fx, fy, cx, cy, k1, k2, p1, p2, k3 each), rotation vector, translation.
    covariance : (24, 24)
        Theirs.
    camera_size_px : (width, height)
        The camera's.
    axis : int
        Projector axis along which the phase changes.
    depth_mm : float
        Where the object is.
    """
    width, height = camera_size_px
    grid = np.stack(np.meshgrid(np.linspace(0.2, 0.8, 3) * width, np.linspace(0.2, 0.8, 3) * height), -1).reshape(
        -1, 1, 2
    )

    def coordinate(p: FloatArray, depth: FloatArray) -> FloatArray:
        matrix = np.array([[p[0], 0, p[2]], [0, p[1], p[3]], [0, 0, 1]])
        rays = cv2.undistortPoints(grid, matrix, p[4:9]).reshape(-1, 2)
        points = np.concatenate([rays, np.ones((len(rays), 1))], axis=1) * depth[:, None]
        return _project(points, p[18:21], p[21:24], p[9:18])[0][:, axis]

    depth = np.full(len(grid), depth_mm)
    # A pixel's projector coordinate is measured, so a change of it that the parameters make is taken for depth.
    by_depth = coordinate(parameters, depth + 0.5) - coordinate(parameters, depth - 0.5)
    steps = 1e-3 * np.sqrt(np.diag(covariance))
    by_parameter = np.stack(
        [
            (coordinate(parameters + step, depth) - coordinate(parameters - step, depth)) / (2 * size)
            for size, step in zip(steps, np.diag(steps), strict=True)
        ]
    )
    slopes = by_parameter / by_depth
    return float(np.sqrt(np.einsum("ik,ij,jk->k", slopes, covariance, slopes).mean()))


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
