"""Balls among other things, found in points alone, and the uncertainty of their centres."""

from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.diagnosis.artefacts import BallBar, Plate, Volume, positions_in
from pipeline.diagnosis.certificate import find_balls, measure_balls, spread
from pipeline.errors import CalibrationError
from pipeline.simulation import simulated_rig

GEOMETRY = simulated_rig().geometry()
BAR = BallBar(60.0, 160.0)
CENTRES = np.array([[-75.0, 20.0, 880.0], [78.0, -20.0, 905.0]])
CENTRES[1] = CENTRES[0] + (CENTRES[1] - CENTRES[0]) * (BAR.spacing_mm / np.linalg.norm(CENTRES[1] - CENTRES[0]))
NOISE_MM = 0.05


def seen(centres=CENTRES, radius=30.0, wall_mm=1000.0, seed=0):
    """Return points (H, W, 3) mm, with noise along their rays, of balls before a wall, and of a rod above them."""
    rays = np.insert(GEOMETRY.camera.rays(), 2, 1.0, axis=2).astype(np.float64)
    depth = np.full(rays.shape[:2], wall_mm)
    for centre in centres:
        a, b = (rays**2).sum(axis=2), rays @ centre
        square = b**2 - a * (centre @ centre - radius**2)
        depth = np.minimum(depth, np.where(square > 0, (b - np.sqrt(np.maximum(square, 0))) / a, np.inf))
    depth[:40] = 900 - np.sqrt(np.maximum(15.0**2 - (0.73 * (np.arange(40) - 20)) ** 2, 0))[:, None]
    return rays * (depth + NOISE_MM * np.random.default_rng(seed).standard_normal(depth.shape))[..., None]


def frame_of(points):
    return SimpleNamespace(points=points.astype(np.float32), period_px=12.0)


def test_two_balls_are_found_before_a_wall_and_beside_a_rod():
    points = seen()
    for ball in find_balls(points, 30.0, GEOMETRY.camera, 2):
        off = np.abs(np.linalg.norm(points[ball][:, None] - CENTRES, axis=2) - 30.0).min(axis=1)
        assert ball.sum() > 2000 and np.quantile(off, 0.99) < 4 * NOISE_MM


def test_centres_are_off_by_what_their_covariance_says():
    pulls = []
    for seed in range(8):
        for ball in measure_balls(frame_of(seen(seed=seed)), 60.0, 2, GEOMETRY.camera, 7):
            off = ball.centre_mm - CENTRES[np.argmin(np.linalg.norm(CENTRES - ball.centre_mm, axis=1))]
            pulls.append(off @ np.linalg.solve(ball.covariance, off) / 3)
            assert abs(ball.radius_mm - 30.0) < NOISE_MM
    assert 0.6 < np.mean(pulls) < 2.0  # 16 values of chi squared over its three degrees of freedom, and few tiles


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"centres": CENTRES[:0]}, "no ball is found, 60 mm in diameter"),
        ({"centres": CENTRES[:1]}, "only 1 of 2 balls is found"),
        ({"radius": 15.0}, "no ball is found"),
        ({"wall_mm": np.nan, "centres": CENTRES[:0]}, "no ball is found"),
    ],
)
def test_what_is_no_bar_is_refused(changes, message):
    with pytest.raises(CalibrationError, match=message):
        measure_balls(frame_of(seen(**changes)), 60.0, 2, GEOMETRY.camera, 7)


def test_balls_that_are_small_in_the_picture_have_too_few_points():
    with pytest.raises(CalibrationError, match=r"only \d+ points of a ball count"):
        measure_balls(frame_of(seen(radius=7.0)), 14.0, 2, GEOMETRY.camera, 7)


def test_one_error_alone_has_no_precision():
    alone, both = spread("size", [0.3]), spread("size", [0.3, -0.5])
    assert (alone.largest_mm, alone.trueness_mm) == (0.3, 0.3) and np.isnan(alone.precision_mm)
    assert (both.largest_mm, both.trueness_mm) == (-0.5, pytest.approx(-0.1))


def test_camera_and_projector_see_the_bar_whole_in_all_seven_positions():
    volume = Volume.before(GEOMETRY, None)
    positions = positions_in(volume, BAR)
    assert [position.name for position in positions[:2]] == ["bar-1", "bar-2"] and len(positions) == 14
    assert all(np.isclose(np.linalg.norm(np.diff(BAR.centres_mm(at), axis=0)), 160) for at in positions[:7])
    for position in positions:
        assert (position.outline_px > 0).all() and (position.outline_px < GEOMETRY.camera.size_px).all()
    assert Plate.within(volume).size_mm[0] > 0.5 * BAR.spacing_mm
    with pytest.raises(CalibrationError, match="a bar 460 mm long is not seen whole"):
        positions_in(volume, BallBar(60.0, 400.0))
