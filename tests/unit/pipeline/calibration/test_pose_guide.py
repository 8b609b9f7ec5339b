"""Where to hold a board next: fewer poses for the same depth, and faults that its poses show."""

import cv2
import numpy as np
import pytest
from support.posed_boards import CAMERA_PX, CHESSBOARD, PATTERN, PROJECTOR_PX, exact_poses, rig

from pipeline.calibration.bundle_adjustment import BundleAdjustment
from pipeline.calibration.pose_guide import MOST_POSES, BentBoardError, PoseGuide
from pipeline.errors import CalibrationError

RIG = rig().geometry()


def guide():
    return PoseGuide(CHESSBOARD, CAMERA_PX, PROJECTOR_PX, PATTERN)


def held(suggestion, rng, geometry=RIG, bow_mm=0.0):
    """Return the pose of a board that somebody holds where it was suggested, some degrees and millimetres off."""
    lens = geometry.camera
    _, turn, place = cv2.solvePnP(CHESSBOARD.outline_mm(), suggestion.outline_px, lens.matrix, lens.distortion)
    turn, place = turn.ravel() + np.radians(3) * rng.normal(size=3), place.ravel() + 4 * rng.normal(size=3)
    seed = int(rng.integers(1000))
    return exact_poses(seed=seed, turns=[turn], places=[place], geometry=geometry, bow_mm=bow_mm)[0]


def guided(until, geometry=RIG, bow_mm=0.0, seed=0):
    rng, found = np.random.default_rng(seed), guide()
    while not until(found):
        found.add(held(found.suggest(), rng, geometry, bow_mm))
    return found


def with_focal(factor):
    matrix = RIG.camera.matrix * np.array([[factor, 1, 1], [1, factor, 1], [1, 1, 1]])
    camera = rig().camera.model_copy(update={"matrix": matrix})
    return rig().model_copy(update={"camera": camera}).geometry()


def test_it_ends_with_less_uncertainty_than_as_many_poses_at_random_leave():
    found = guided(lambda guide: guide.enough)
    assert 8 <= len(found.poses) <= MOST_POSES
    assert np.all(np.diff(found.depth_mm) < 0)
    fit = BundleAdjustment(exact_poses(len(found.poses)), CAMERA_PX, PROJECTOR_PX)
    fit.refine()
    at_random = guide()
    for pose in fit.poses:
        at_random.add(pose)
    assert found.depth_mm[-1] < 0.8 * at_random.depth_mm[-1]


def test_every_suggestion_is_seen_whole_and_says_where_it_is():
    rng, found = np.random.default_rng(1), guide()
    for _ in range(6):
        suggestion = found.suggest()
        assert (suggestion.outline_px > 0).all() and (suggestion.outline_px < np.array(CAMERA_PX) - 1).all()
        middle = suggestion.outline_px.mean(axis=0) / CAMERA_PX
        assert ("on the left" in suggestion.words) == (middle[0] < 0.42)
        assert ("at the bottom" in suggestion.words) == (middle[1] > 0.58)
        found.add(held(suggestion, rng))
    words = {held_words.words for held_words in (found.suggest(), guide().suggest())}
    assert all("edge towards the camera by 28 deg" in each for each in words)


def test_the_edges_that_are_named_are_nearer_to_the_camera():
    found, rng, words = guide(), np.random.default_rng(3), ""
    for _ in range(4):
        suggestion = found.suggest()
        upper_left, upper_right, lower_right, lower_left = suggestion.outline_px
        lengths = {
            "top": np.linalg.norm(upper_right - upper_left),
            "bottom": np.linalg.norm(lower_right - lower_left),
            "left": np.linalg.norm(lower_left - upper_left),
            "right": np.linalg.norm(lower_right - upper_right),
        }
        tilt = suggestion.words.split(", its ")[1]
        for near, far in (("top", "bottom"), ("left", "right")):
            for edge, other in ((near, far), (far, near)):
                assert f"{edge} " not in tilt or lengths[edge] > lengths[other]
        words += tilt
        found.add(held(suggestion, rng))
    assert len({edge for edge in lengths if edge in words}) >= 3


@pytest.mark.parametrize("bow_mm", [-1.0, 1.0])
def test_a_bent_board_is_named_at_the_fourth_pose(bow_mm):
    found = guide()
    rng = np.random.default_rng(2)
    with pytest.raises(BentBoardError, match=r"the board is bent by (0\.9|1\.0|1\.1) ± 0\.[01] mm: glue it on glass"):
        for _ in range(4):
            found.add(held(found.suggest(), rng, bow_mm=bow_mm))
    assert len(found.poses) == 4


def test_a_flat_boards_bow_is_its_noise():
    for seed in range(3):
        fit = BundleAdjustment(exact_poses(seed=seed), CAMERA_PX, PROJECTOR_PX)
        fit.refine()
        bow = fit.board_bow()
        assert abs(bow.height_mm) < 4 * bow.sigma_mm < 0.1


@pytest.mark.parametrize("factor", [0.995, 1.005])
def test_a_lens_that_has_moved_is_named_at_the_next_pose_which_is_not_taken(factor):
    found = guided(lambda guide: len(guide.poses) == 5)
    with pytest.raises(CalibrationError, match=r"contradicts the poses before it .*If nothing was touched, show the"):
        found.add(held(found.suggest(), np.random.default_rng(5), with_focal(factor)))
    assert len(found.poses) == 5
    found.add(held(found.suggest(), np.random.default_rng(6)))
    assert len(found.poses) == 6


def test_poses_that_are_alike_determine_nothing_yet():
    found, again = guide(), exact_poses(turns=[np.zeros(3)] * 4, places=[np.array([0, 0, 900.0])] * 4)
    for pose in again:
        found.add(pose)
    assert not found.enough
