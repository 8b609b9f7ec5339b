"""Which pose is the worst, and why: a cause is named where it was put in, and nowhere else."""

import numpy as np
import pytest
from support.posed_boards import CAMERA_PX, PROJECTOR_PX, exact_poses

from pipeline.calibration.board_poses import PictureEvidence
from pipeline.calibration.bundle_adjustment import BundleAdjustment
from pipeline.calibration.verdict import judge_poses, pose_causes, square_px

SHARP = PictureEvidence(0.5, (("02-column-coarse-0", 0.01), ("16-row-coarse-0", 0.01)))
MOVED = PictureEvidence(0.5, (("02-column-coarse-0", 0.01), ("16-row-coarse-0", 0.4)))
BLURRED = PictureEvidence(2.5, SHARP.drift_px)


def changed(pose, **values):
    return type(pose)(**{**pose.__dict__, **values})


def fitted(poses):
    fit = BundleAdjustment(poses, CAMERA_PX, PROJECTOR_PX)
    fit.refine()
    return fit


def poses_with(evidence, noise_px):
    """Return ten poses, the fifth of which has this evidence and additional noise."""
    rng = np.random.default_rng(5)
    poses = [changed(pose, evidence=SHARP) for pose in exact_poses()]
    noisy = poses[4].projector_px + noise_px * rng.standard_normal(poses[4].projector_px.shape)
    poses[4] = changed(poses[4], evidence=evidence, projector_px=noisy)
    return poses


@pytest.mark.parametrize(
    ("evidence", "named"),
    [
        (MOVED, "it moved: from 16-row-coarse-0 on its corners lie up to 0.40 px beside"),
        (BLURRED, "it is blurred (edges have a sigma of 2.5 px, elsewhere 0.5)"),
        (SHARP, "no cause shows but the error itself"),
    ],
)
def test_the_worst_pose_and_what_its_pictures_show(evidence, named):
    (judged,) = judge_poses(fitted(poses_with(evidence, 0.12)))
    assert judged.name == "pose_04" and judged.stands_out
    assert named in judged.in_words() and len(judged.causes) == (evidence is not SHARP)
    assert judged.rms_px[1] > 2.5 * judged.usual_px[1]


def test_a_pose_like_the_others_has_no_cause():
    (judged,) = judge_poses(fitted(poses_with(SHARP, 0.0)))
    assert not judged.stands_out and judged.causes == () and "it does not stand out" in judged.in_words()


def test_a_pose_that_was_taken_badly_is_named_though_it_fits():
    """Beside the worst one, which is another."""
    worst, moved = judge_poses(fitted(poses_with(MOVED, 0.0)))
    assert worst.name != "pose_04" and worst.causes == ()
    assert moved.name == "pose_04" and not moved.stands_out and "it moved" in moved.in_words()


def test_blur_that_all_poses_share_is_no_poses_own():
    poses = [changed(pose, evidence=BLURRED) for pose in exact_poses()]
    assert pose_causes(fitted(poses), 4) == ()


def test_a_few_corners_that_carry_the_error():
    """Three corners 0.3 px off, as a finger's shadow makes them, and where they are."""
    poses = exact_poses()
    pixels = poses[2].camera_px.copy()
    pixels[[0, 1, 2]] += [0.0, 0.3]
    poses[2] = changed(poses[2], camera_px=pixels)
    (cause,) = pose_causes(fitted(poses), 2)
    x, y = pixels[[0, 1, 2]].mean(axis=0)
    assert cause.startswith("a few corners near")
    found = np.array(cause.split("near ")[1].split(" px")[0].split(", "), float)
    assert np.linalg.norm(found - [x, y]) < 40


def test_a_board_that_is_far_away_or_steep():
    turns = list(np.random.default_rng(2).uniform(-0.5, 0.5, (10, 3)))
    places = np.random.default_rng(3).uniform((-30, -20, 850), (30, 20, 950), (10, 3))
    places[3], turns[6] = (0.0, 0.0, 1700.0), np.array([0.0, 1.0, 0.0])
    fit = fitted(exact_poses(turns=turns, places=places))
    assert any("the board is small" in cause for cause in pose_causes(fit, 3))
    assert any("tilted by 5" in cause for cause in pose_causes(fit, 6))
    assert pose_causes(fit, 0) == ()
    side = [square_px(pose) for pose in fit.poses]
    assert side[3] == pytest.approx(26 * 1232 / 1700, rel=0.15) and side[0] > 1.5 * side[3]
