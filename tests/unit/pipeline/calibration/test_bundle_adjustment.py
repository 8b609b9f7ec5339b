"""The bundle adjustment: its derivatives against differences, its descent to exact corners."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from support.posed_boards import exact_poses

from pipeline.calibration.board import Board
from pipeline.calibration.board_poses import BoardPose
from pipeline.calibration.bundle_adjustment import BundleAdjustment, project_points
from pipeline.calibration.simulated_board import board_turns
from pipeline.simulation import simulated_rig

CAMERA_PX, PROJECTOR_PX = (640, 480), (1024, 768)
RIG = simulated_rig(CAMERA_PX, camera_distortion=(-0.12, 0.08, 0.001, -0.0008, 0)).geometry()


def lens_values(lens):
    m = lens.matrix
    return np.array([m[0, 0], m[1, 1], m[0, 2], m[1, 2], *lens.distortion])


@pytest.fixture(scope="module")
def poses():
    """Return poses whose corners lie where the rig projects them."""
    corners, found = Board(kind="chessboard", squares=(10, 7), square_mm=26.0).corners_mm(), []
    for k, (turn, place) in enumerate(zip(*board_turns(8, 3), strict=True)):
        rotation = cv2.Rodrigues(turn)[0]
        points = (corners - corners.mean(axis=0)) @ rotation.T + place
        step = cv2.Rodrigues(RIG.rotation)[0].ravel()
        camera, _ = project_points(points, np.zeros(3), np.zeros(3), lens_values(RIG.camera))
        projector, _ = project_points(points, step, RIG.translation_mm, lens_values(RIG.projector))
        nothing = np.full((3, 2), np.nan)
        found.append(BoardPose(f"pose {k}", corners, camera, projector, nothing, nothing, np.eye(2)))
    return found


def test_derivatives_are_those_of_the_residuals(poses):
    fit = BundleAdjustment(poses, CAMERA_PX, PROJECTOR_PX)
    start = fit.parameters.copy()
    _, jacobian = fit._residuals(2)
    for k in (*range(24), *range(24 + 12, 24 + 18)):
        step = 1e-6 * max(1.0, abs(start[k]))
        ends = []
        for sign in (1, -1):
            fit.parameters = start.copy()
            fit.parameters[k] += sign * step
            ends.append(fit._residuals(2)[0])
        difference = (ends[0] - ends[1]) / (2 * step)
        scale = max(1.0, np.abs(difference).max())
        np.testing.assert_allclose(jacobian[..., k] / scale, difference / scale, atol=1e-5, err_msg=f"parameter {k}")


def test_exact_corners_are_met(poses):
    fit = BundleAdjustment(poses, CAMERA_PX, PROJECTOR_PX)
    fit.refine()
    assert max(fit.camera_rms_px, fit.projector_rms_px) < 1e-3
    np.testing.assert_allclose(fit.stereo[3:], RIG.translation_mm, atol=0.05)  # mm
    assert fit.focal_sigma() < 1e-4


def test_a_corner_far_off_is_left_out(poses):
    rng = np.random.default_rng(1)
    noisy = [
        BoardPose(
            pose.name,
            pose.corners_mm,
            pose.camera_px + rng.normal(0, 0.05, pose.camera_px.shape),
            pose.projector_px + rng.normal(0, 0.05, pose.projector_px.shape),
            pose.camera_shift_px,
            pose.projector_shift_px,
            pose.jacobian,
        )
        for pose in poses
    ]
    noisy[0].camera_px[5] += 3.0
    fit = BundleAdjustment(noisy, CAMERA_PX, PROJECTOR_PX)
    fit.refine()
    assert not fit.used[0][5]
    assert sum(np.count_nonzero(~used) for used in fit.used) < 5
    assert fit.sigma_px == pytest.approx(0.05, rel=0.1)


def test_one_bad_pose_of_many_still_has_a_place():
    """All of its corners lie beyond the noise of the others: it fits badly, and the normal matrix is not singular."""
    many, rng = exact_poses(30, 0.02, seed=4), np.random.default_rng(2)
    bad = many[3]
    many[3] = replace(bad, camera_px=bad.camera_px + rng.normal(0, 1.5, bad.camera_px.shape))
    fit = BundleAdjustment(many, CAMERA_PX, PROJECTOR_PX)
    fit.refine()
    assert fit.used[3].all() and np.concatenate(fit.used).mean() > 0.99
    errors = fit.pose_errors_px()
    assert np.argmax(errors) == 3 and errors[3] > 10 * np.median(errors)
