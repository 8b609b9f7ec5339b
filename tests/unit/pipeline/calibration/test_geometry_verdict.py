"""What a geometry is said to be worth, where its poses, its noise or its baseline are better or worse."""

import numpy as np
import pytest
from support.posed_boards import CAMERA_PX, PATTERN, PROJECTOR_PX, exact_poses, rig

from pipeline.calibration.model import Calibration
from pipeline.calibration.rig_geometry import solve_geometry
from pipeline.calibration.simulated_board import board_turns


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
