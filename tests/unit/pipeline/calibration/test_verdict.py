"""Verdicts on light, poses and geometry, against errors that were put in."""

from dataclasses import replace

import numpy as np
import pytest
from support.posed_boards import CAMERA_PX, PATTERN, PROJECTOR_PX, exact_poses, rig

from pipeline.calibration.board_poses import PictureEvidence
from pipeline.calibration.bundle_adjustment import BundleAdjustment
from pipeline.calibration.model import Calibration
from pipeline.calibration.radiometry import Radiometry
from pipeline.calibration.rig_geometry import solve_geometry
from pipeline.calibration.simulated_board import board_turns
from pipeline.calibration.verdict import grade_of, judge_poses, judge_radiometry, pose_causes, square_px
from pipeline.simulation import TYPICAL_CROSSTALK, simulated_rig
from tikernels.depth.triangulation import triangulate

MATRIX = 0.6 * np.array(TYPICAL_CROSSTALK)
SHARP = PictureEvidence(0.5, (("04-column-fringe-0", 0.01), ("09-row-fringe-0", 0.01)))
MOVED = PictureEvidence(0.5, (("04-column-fringe-0", 0.01), ("09-row-fringe-0", 0.4)))
BLURRED = PictureEvidence(2.5, SHARP.drift_px)


def test_what_lies_on_a_bound_still_has_the_better_grade():
    assert [grade_of(error, 1.0, 2.0) for error in (1.0, 1.1, 2.0, 2.1)] == ["good", "usable", "usable", "poor"]


def test_an_unknown_error_is_poor():
    assert grade_of(float("nan"), 1.0, 2.0) == "poor"


def measured(sigma=1e-4, gamma=2.2, **values):
    response = np.tile(np.linspace(0, 1, 256) ** gamma, (3, 1))
    found = Radiometry(
        crosstalk_matrix=MATRIX,
        crosstalk_sigma=np.full((3, 3), sigma * 0.6),
        response=response,
        response_sigma=np.full((3, 256), sigma),
        transfer="linear",
        additivity=0.001,
        ambient=np.full(3, 0.02),
        noise=np.full(3, 1.5 / 255),
        ramps=np.zeros((4, 17, 3)),
    )
    return replace(found, **values)


def test_noise_of_three_channels_makes_the_phase_noise_that_it_says():
    """Against the arctangent of noisy light, drawn; to 3 per cent."""
    rng, rows = np.random.default_rng(3), MATRIX.sum(axis=1)
    phase = rng.uniform(-np.pi, np.pi, 100_000)
    light = 0.5 + 0.5 * np.cos(phase[:, None] + np.array([-1, 0, 1]) * 2 * np.pi / 3)
    light += 1.5 / 255 / rows * rng.standard_normal(light.shape)
    vector = light @ np.exp(-1j * np.array([-1, 0, 1]) * 2 * np.pi / 3)
    error = np.angle(vector * np.exp(-1j * phase))
    assert judge_radiometry(measured(), None).noise_rad == pytest.approx(error.std(), rel=0.03)


def test_the_grade_follows_from_the_ripple():
    grades = [judge_radiometry(measured(sigma), None).grade for sigma in (1e-4, 0.006, 0.03)]
    assert grades == ["good", "usable", "poor"]


def test_gamma_is_the_power_of_the_code():
    np.testing.assert_allclose(judge_radiometry(measured(gamma=1.8), None).gamma, 1.8, atol=1e-6)


def test_a_geometry_tells_mm():
    """On this rig a radian is 7.0 mm, 900 mm away: 17.45 px a cycle, 0.398 px a mm."""
    geometry = simulated_rig().geometry()
    verdict = judge_radiometry(measured(), geometry)
    assert verdict.mm_per_rad == pytest.approx(17.4545 / (2 * np.pi) / 0.398, rel=0.05)
    assert "mm)" in verdict.in_words()
    assert "mm)" not in judge_radiometry(measured(), None).in_words()
    parallel = replace(geometry, rotation=np.eye(3))
    assert judge_radiometry(measured(), parallel).mm_per_rad is None


def test_what_would_make_it_better():
    assert judge_radiometry(measured(), None).advice == ()
    (grey,) = judge_radiometry(measured(additivity=0.012), None).advice
    assert "grey differs from red + green + blue by 1.2%" in grey
    (dim,) = judge_radiometry(measured(crosstalk_matrix=0.3 * MATRIX), None).advice
    assert "expose longer" in dim


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
        (MOVED, "it moved: from 09-row-fringe-0 on its corners lie up to 0.40 px from"),
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


def test_the_depth_bias_is_what_was_foretold(cpu):
    """Over eight noisy rigs the RMS error of depth on a plane 900 mm away is the predicted one, within a third."""
    truth = rig().geometry()
    rays = truth.camera.rays()[48:432:48, 64:576:64]
    points = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=-1).astype(np.float64) * 900
    phase = 2 * np.pi * truth.pattern_cycles(points.reshape(-1, 3)).reshape(rays.shape[:2])
    squared = []
    for seed in range(8):
        found = solve_geometry(exact_poses(10, seed=seed), CAMERA_PX, PROJECTOR_PX, PATTERN).calibration
        geometry = found.geometry()
        seen = geometry.camera.rays()[48:432:48, 64:576:64]
        depth = triangulate(phase.astype(np.float32), np.ascontiguousarray(seen), geometry.for_triangulation())[..., 2]
        squared.append(((depth - 900) ** 2).mean() / found.uncertainty.depth_bias_mm**2)
    assert 0.66 < np.sqrt(np.mean(squared)) < 1.5


def judged(poses, base=None):
    return solve_geometry(poses, CAMERA_PX, PROJECTOR_PX, PATTERN, base).verdict


def test_a_good_one():
    """A pixel's noise of 0.01 rad is 0.028 projector px, and depth moves the light by 0.4 px a mm 900 mm away."""
    verdict = judged(exact_poses(noise_px=0.01))
    assert verdict.grade == "good" and verdict.advice == ()
    assert verdict.bias_mm < verdict.distance_mm / 3000
    assert verdict.random_mm == pytest.approx(0.07, rel=0.1)
    assert f"good: {verdict.distance_mm:.0f} mm away" in verdict.in_words()


def test_noise_makes_it_usable_and_then_poor():
    grades = [judged(exact_poses(noise_px=noise)).grade for noise in (0.06, 0.3)]
    assert grades == ["usable", "poor"]
    advice = " ".join(judged(exact_poses(noise_px=0.3)).advice)
    assert "corners are off by 0.4" in advice and "more poses than 10" in advice
    assert "more than 12 pictures per pose take off 1 %" in advice


def test_poses_that_are_hardly_tilted():
    """A fifth of the usual tilt: three to seven degrees."""
    turns, places = board_turns(10, 3)
    verdict = judged(exact_poses(turns=[turn / 5 for turn in turns], places=places, noise_px=0.02))
    assert verdict.grade != "good"
    assert verdict.advice[0].startswith("the boards' tilts differ by 1")


def test_boards_in_the_middle_of_the_picture_only():
    turns, places = board_turns(10, 3)
    verdict = judged(exact_poses(turns=turns, places=places * [0.1, 0.1, 1.6], noise_px=0.05))
    assert any("of the picture: show the board at its rims" in advice for advice in verdict.advice)


def test_objects_where_no_board_stood():
    """Twice as far away as the boards, what is uncertain of the angles counts twice and more."""
    far = Calibration(crosstalk_matrix=np.eye(3), depth_range_mm=(1700.0, 1900.0))
    near, there = judged(exact_poses()), judged(exact_poses(), far)
    assert there.distance_mm == 1800 and there.bias_mm > 2 * near.bias_mm
    assert any("the boards stood" in advice and "show them 1800 mm away" in advice for advice in there.advice)


def test_a_baseline_that_is_too_short():
    """A tenth of the usual one: a frame's noise is then ten times as much in depth."""
    truth = rig()
    close = truth.model_copy(update={"translation_mm": truth.translation_mm / 10, "rotation": np.eye(3)})
    verdict = judged(exact_poses(noise_px=0.002, geometry=close.geometry()))
    assert verdict.random_mm == pytest.approx(0.7, rel=0.1)
    assert "camera and projector stand only 18 mm apart, 1 part in 5" in verdict.advice[0]
