"""Both lenses, their poses and every pose of a board, refined together by least squares.

The projector is a second camera. What is minimised is the sum of the squared distances, px over their standard
deviation, from measured corners to those that the parameters predict, and of the lenses' distortion over what lenses
have; by Gauss-Newton steps with Levenberg's and Marquardt's damping. The inverse of the normal matrix is the
parameters' covariance (B. Triggs et al., Bundle adjustment, a modern synthesis, 2000, doi:10.1007/3-540-44480-7_21).
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.calibration.board_poses import BoardPose
from pipeline.calibration.model import Pattern
from pipeline.linear_algebra import one_thread
from pipeline.models import FloatArray

# Standard deviations of k1, k2, p1, p2, k3 before anything was measured. Those of projectors and machine lenses stay
# well inside; without them, terms that no corner shows would run away.
_LENS_PRIOR = np.array([1.0, 1.0, 0.02, 0.02, 1.0])
# Corners further from the fit than this many standard deviations are left out; of good ones fewer than one in 10,000.
_CORNER_SIGMAS = 4.5
# A pose with a smaller share of its corners left is bad as a whole.
_LEAST_USED = 0.5
# A corner's standard deviation, px, until the first fit estimates it.
_START_SIGMA_PX = 0.1
# Damping, of the normal matrix's diagonal: at the start; times this where a step makes the fit worse, over that where
# it makes it better; and where it is given up, as steps are then too small to change anything.
_DAMPING, _WORSE, _BETTER, _MAX_DAMPING = 1e-3, 10, 5, 1e8
# A board's corners are lifted by this to see what that does: it bends no line of sight.
_LIFT_MM = 0.1
# Steps at most, and the part of its cost by which a step must lower it for another one to follow.
_MAX_STEPS, _LEAST_GAIN = 60, 1e-9


@dataclass(frozen=True)
class BoardBow:
    """Bow of a board that is assumed to be flat."""

    height_mm: float  # from its middle to its farthest corner, positive where the middle is nearer to the camera
    sigma_mm: float


class BundleAdjustment:
    """A fit of both lenses, the projector's place and every pose of the board.

    Its parameters, in order: fx, fy, cx, cy, k1, k2, p1, p2, k3 of the camera; the same of the projector; rotation
    vector and translation from camera to projector; then rotation vector and translation of each pose.

    Parameters
    ----------
    poses : list of BoardPose
        The corners.
    camera_size_px, projector_size_px : (width, height)
        The two devices' sizes in px.
    start : (24 + 6 poses,), optional
        The parameters to start from, such as the truth of a simulated rig; None: found from the corners.
    """

    def __init__(
        self,
        poses: list[BoardPose],
        camera_size_px: tuple[int, int],
        projector_size_px: tuple[int, int],
        start: FloatArray | None = None,
    ) -> None:
        self.poses = poses
        self.used: list[npt.NDArray[np.bool_]] = [np.ones(len(pose.corners_mm), np.bool_) for pose in poses]
        self.sigma_px = np.full(2, _START_SIGMA_PX)  # of a corner's coordinate in camera and projector
        self.parameters = _start(poses, camera_size_px, projector_size_px) if start is None else start

    @property
    def stereo(self) -> FloatArray:
        """Rotation vector and translation (mm) from camera to projector."""
        return self.parameters[18:24]

    def refine(self) -> None:
        """Fit three times, from the second on without corners far from the last fit, weighted by the noise it left."""
        for _ in range(3):
            with one_thread():
                self._descend()
            residuals = [self._residuals(k)[0] for k in range(len(self.poses))]
            inliers = [r[used] for r, used in zip(residuals, self.used, strict=True)]
            everything = np.concatenate(inliers)  # (N, 2 devices, 2)
            # Each pose takes 6 parameters, the lenses and the step 24; camera and projector share them.
            freedom = max(1 - (24 + 6 * len(self.poses)) / everything.size, 0.2)
            self.sigma_px = np.sqrt((everything**2).mean(axis=(0, 2)) / freedom)
            limit = _CORNER_SIGMAS * self.sigma_px[None, :, None]
            near = [np.asarray((np.abs(r) < limit).all(axis=(1, 2))) for r in residuals]
            # A pose without corners has no place. One that is bad as a whole keeps all, and shows as a pose.
            self.used = [used if used.mean() > _LEAST_USED else np.ones_like(used) for used in near]

    def _descend(self) -> None:
        damping, cost, best = _DAMPING, np.inf, self.parameters
        for _ in range(_MAX_STEPS):
            normal, gradient, now = self._normal_equations()
            if now < cost:
                if cost - now < _LEAST_GAIN * now:
                    break
                cost, best, damping = now, self.parameters.copy(), damping / _BETTER
            else:
                self.parameters = best.copy()
                damping *= _WORSE
                if damping > _MAX_DAMPING:
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
        at = 24 + 6 * k
        residual, slopes = self.corner_errors(self.poses[k], self._stands(k))
        jacobian = np.zeros((*residual.shape, len(self.parameters)))
        jacobian[..., :24], jacobian[..., at : at + 6] = slopes[..., :24], slopes[..., 24:]
        return residual, jacobian

    def corner_errors(self, pose: BoardPose, stands: FloatArray, scale: float = 1.0) -> tuple[FloatArray, FloatArray]:
        """Return the distances of a board's corners from where lenses and step put them.

        Parameters
        ----------
        pose : BoardPose
            Its corners, as they were measured.
        stands : (6,)
            Rotation vector and place, mm.
        scale : float
            Factor by which the board is larger than given.

        Returns
        -------
        (N, 2 devices, 2), (N, 2, 2, 30)
            Errors, px, and their derivatives: by the 24 parameters of lenses and step, and by the board's pose.
        """
        turn, place, p = stands[:3], stands[3:], self.parameters
        corners = scale * pose.corners_mm
        residual, jacobian = np.zeros((len(corners), 2, 2)), np.zeros((len(corners), 2, 2, 30))
        pixels, slopes = project_points(corners, turn, place, p[:9])
        residual[:, 0] = pixels - pose.camera_px
        jacobian[:, 0, :, 24:], jacobian[:, 0, :, :9] = slopes[..., :6], slopes[..., 6:]
        turn3, place3, *chain = cv2.composeRT(turn, place, self.stereo[:3], self.stereo[3:])
        dr_dr1, dr_dt1, dr_dr2, dr_dt2, dt_dr1, dt_dt1, dt_dr2, dt_dt2 = chain
        pixels, slopes = project_points(corners, turn3.ravel(), place3.ravel(), p[9:18])
        residual[:, 1] = pixels - pose.projector_px
        by_turn, by_place = slopes[..., :3], slopes[..., 3:6]
        jacobian[:, 1, :, 24:27] = by_turn @ dr_dr1 + by_place @ dt_dr1
        jacobian[:, 1, :, 27:] = by_turn @ dr_dt1 + by_place @ dt_dt1
        jacobian[:, 1, :, 18:21] = by_turn @ dr_dr2 + by_place @ dt_dr2
        jacobian[:, 1, :, 21:24] = by_turn @ dr_dt2 + by_place @ dt_dt2
        jacobian[:, 1, :, 9:18] = slopes[..., 6:]
        return residual, jacobian

    def board_bow(self) -> BoardBow:
        """Return how far the board is bent, by the residuals that its corners share in all poses.

        A bent board is modelled as z = a x^2 + b x y + c y^2 about its middle: three parameters more, solved for with
        all others by one step of Gauss and Newton.
        """
        size = len(self.parameters)
        system, right = np.zeros((size + 3, size + 3)), np.zeros(size + 3)
        normal, gradient, _ = self._normal_equations()
        system[:size, :size], right[:size] = normal, gradient
        every = np.concatenate([pose.corners_mm for pose in self.poses])
        middle, reach = every.mean(axis=0), np.ptp(every, axis=0).max() / 2
        for k, pose in enumerate(self.poses):
            x, y, _ = ((pose.corners_mm - middle) / reach).T
            residual, jacobian = self._residuals(k)
            lifted = replace(pose, corners_mm=pose.corners_mm + np.array([0.0, 0.0, _LIFT_MM]))
            by_height = (self.corner_errors(lifted, self._stands(k))[0] - residual) / _LIFT_MM
            shapes = np.stack([x * x, x * y, y * y], axis=-1)
            by_bow = (by_height[..., None] * shapes[:, None, None, :]).reshape(-1, 3)
            weight = (self.used[k][:, None, None] / self.sigma_px[None, :, None] ** 2 * np.ones((1, 1, 2))).ravel()
            rows = jacobian.reshape(-1, size)
            system[size:, size:] += by_bow.T @ (by_bow * weight[:, None])
            system[:size, size:] += rows.T @ (by_bow * weight[:, None])
            right[size:] += by_bow.T @ (weight * residual.ravel())
        system[size:, :size] = system[:size, size:].T
        covariance = np.linalg.inv(system)
        bow = -(covariance @ right)[size:]
        x, y, _ = ((every - middle) / reach).T
        shapes = np.stack([x * x, x * y, y * y], axis=-1)
        highest = shapes[int(np.argmax(np.abs(shapes @ bow)))]
        sigma = float(np.sqrt(highest @ covariance[size:, size:] @ highest))
        return BoardBow(float(highest @ bow), sigma)

    def _stands(self, k: int) -> FloatArray:
        """Return a board's pose: rotation vector and place, mm."""
        return self.parameters[24 + 6 * k : 30 + 6 * k]

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
        return np.array([np.median(self.corner_distances_px(k), axis=0).max() for k in range(len(self.poses))])

    def pose_rms_px(self) -> FloatArray:
        """Return the RMS distance of each pose's corners from the fit, (poses, 2 devices); of those that are used."""
        errors = [self._residuals(k)[0][used] for k, used in enumerate(self.used)]
        return np.array([np.sqrt((e**2).sum(axis=-1).mean(axis=0)) for e in errors])

    def corner_residuals_px(self, k: int) -> FloatArray:
        """Return the steps from each of a pose's corners to where the fit puts it, (N, 2 devices, 2)."""
        return self._residuals(k)[0]

    def corner_distances_px(self, k: int) -> FloatArray:
        """Return the distance of each of a pose's corners from the fit, (N, 2 devices)."""
        return np.asarray(np.linalg.norm(self.corner_residuals_px(k), axis=-1))

    def rough_stand(self, pose: BoardPose) -> FloatArray:
        """Return roughly the pose of a board that need not be one of the fit's: rotation vector and place, (6,)."""
        lens = self.parameters[:9]
        matrix = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1]])
        _, turn, place = cv2.solvePnP(pose.corners_mm, pose.camera_px, matrix, lens[4:])
        return np.concatenate([turn.ravel(), place.ravel()])

    def normals(self) -> FloatArray:
        """Return the unit vectors that stand on each pose's board, in the camera's frame, (poses, 3)."""
        return np.array([cv2.Rodrigues(turn[:3])[0][:, 2] for turn in self.parameters[24:].reshape(-1, 6)])

    def focal_sigma(self) -> float:
        """Return the standard deviation of the least certain focal length, over that length."""
        focal = np.array([0, 1, 9, 10])
        return float((np.sqrt(np.diag(self.covariance())[focal]) / self.parameters[focal]).max())

    def px_per_mm(self, pattern: Pattern, depth: float) -> tuple[float, float]:
        """Return how far depth moves the light in the projector at a depth, mm, across and along the stripes."""
        points = np.array([[0, 0, depth - 0.5], [0, 0, depth + 0.5]])
        pixels, _ = project_points(points, self.stereo[:3], self.stereo[3:], self.parameters[9:18])
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


def project_points(
    points: FloatArray, turn: FloatArray, place: FloatArray, lens: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return pixels, and their derivatives by rotation, translation and the lens, (N, 2, 15)."""
    matrix = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1]])
    pixels, slopes = cv2.projectPoints(points, turn, place, matrix, lens[4:])
    return pixels.reshape(-1, 2), slopes[:, :15].reshape(-1, 2, 15)


def _start(poses: list[BoardPose], camera_size_px: tuple[int, int], projector_size_px: tuple[int, int]) -> FloatArray:
    """Return parameters near the fit: each lens calibrated by itself."""
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
    return np.concatenate([*lenses, turn, np.median(steps, axis=0), *boards[0]])
