"""A side of the squares that is wrong by a quarter: caught by the baseline, or by a second board, and only then."""

import numpy as np
import pytest
from support.posed_boards import CAMERA_PX, PATTERN, PROJECTOR_PX, exact_poses, rig, scaled

from pipeline.calibration.board import Board
from pipeline.calibration.bundle_adjustment import BundleAdjustment
from pipeline.calibration.rig_geometry import SecondBoard, board_scale, solve_geometry
from pipeline.errors import CalibrationError
from pipeline.models import SensorPart

SECOND = Board(kind="chessboard", squares=(10, 7), square_mm=20.0)


def second(count=2, factor=1.0, noise_px=0.03, seed=8):
    return SecondBoard(
        scaled(exact_poses(count, noise_px, SECOND, seed), factor), factor * SECOND.square_mm, first_square_mm=26.0
    )


def solved(poses, **proof):
    return solve_geometry(poses, CAMERA_PX, PROJECTOR_PX, PATTERN, **proof).calibration


def test_the_squares_alone_prove_nothing():
    """All lengths are then wrong by a quarter, nothing shows it, and the calibration says so."""
    found = solved(scaled(exact_poses(), 1.25))
    assert found.scale_proof is None
    assert np.linalg.norm(found.translation_mm) == pytest.approx(1.25 * 180, abs=0.3)


def test_a_side_that_is_wrong_by_a_quarter_is_caught_with_either_proof():
    wrong = scaled(exact_poses(), 1.25)
    with pytest.raises(CalibrationError, match=r"baseline comes out as 22.* squares are then 0\.8"):
        solved(wrong, baseline_mm=180.0)
    told = r"if the first's squares are 32\.5 mm, the second's are 2[45]\.\d{3} ± 0\.\d{3} mm, not 20; if the second's"
    with pytest.raises(CalibrationError, match=told) as raised:
        solved(wrong, second=second()._replace(first_square_mm=32.5))
    assert "\n" not in str(raised.value)


def test_a_true_side_is_proven_with_either():
    assert solved(exact_poses(), baseline_mm=180.0).scale_proof == "baseline"
    assert solved(exact_poses(), second=second(1)).scale_proof == "second board"
    assert solved(exact_poses(), baseline_mm=180.0, second=second()).scale_proof == "second board"


def test_an_earlier_proof_does_not_outlive_its_geometry():
    part = SensorPart(sensor_px=(2000, 1500), offset_px=(1, 2), binning=(1, 1))
    base = rig().model_copy(update={"scale_proof": "baseline", "sensor": part})
    found = solve_geometry(exact_poses(), CAMERA_PX, PROJECTOR_PX, PATTERN, base).calibration
    assert found.scale_proof is None and found.sensor is None


def test_the_ratios_deviation_is_honest():
    """Over eight rigs and boards its errors, in its own deviations, have a spread of about one."""
    pulls = []
    for seed in range(8):
        fit = BundleAdjustment(exact_poses(8, seed=seed), CAMERA_PX, PROJECTOR_PX)
        fit.refine()
        ratio, sigma = board_scale(fit, second(1, seed=30 + seed).poses)
        assert sigma < 0.001
        pulls.append((ratio - 1) / sigma)
    assert 0.5 < np.sqrt(np.mean(np.square(pulls))) < 1.6


def test_second_boards_that_prove_nothing():
    alike = second()._replace(square_mm=26.0)
    with pytest.raises(CalibrationError, match="both boards have squares of 26 mm"):
        solved(exact_poses(), second=alike)
    with pytest.raises(CalibrationError, match="no pose of the second board"):
        solved(exact_poses(), second=second()._replace(poses=[]))
    moved = second(noise_px=0.5)
    with pytest.raises(CalibrationError, match=r"pose_00 of the second board does not fit: .* times as far off"):
        solved(exact_poses(), second=moved)
