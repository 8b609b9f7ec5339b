"""The transfer of height of a corrugated plate, from exact heights."""

import cv2
import numpy as np
import pytest

from pipeline.diagnosis.lateral_resolution import PERIODS_MM, measure_transfer, relief
from pipeline.errors import CalibrationError

LIMIT_MM = 4.1
# A Gaussian of this sigma leaves half of a sinusoid of that period.
BLUR_MM = LIMIT_MM * np.sqrt(np.log(2) / 2) / np.pi
NODES, WEIGHTS = np.polynomial.hermite.hermgauss(60)
SIDE_MM, STEP_MM = 100.0, 0.4
PROFILE = np.array([1.0, 0, 0])


def seen(blur_mm, turn_deg=(0, 0, 0), scale=1.0, noise_mm=0.0, seed=0, profile=relief):
    """Return points (N, 3) of a plate whose heights are blurred along the profile, and their tiles of 10 mm."""
    x, y = (each.ravel() for each in np.meshgrid(*[np.arange(-SIDE_MM / 2, SIDE_MM / 2, STEP_MM)] * 2))
    height = sum(
        w * profile(x + np.sqrt(2) * blur_mm * node)[0] for w, node in zip(WEIGHTS / np.sqrt(np.pi), NODES, strict=True)
    )
    height = height + noise_mm * np.random.default_rng(seed).standard_normal(x.size)
    points = np.stack([scale * x, scale * y, -height], axis=1) @ cv2.Rodrigues(np.radians(turn_deg))[0].T
    return points + np.array([10, -20, 900]), ((x + SIDE_MM / 2) // 10 * 100 + (y + SIDE_MM / 2) // 10).astype(np.intp)


@pytest.mark.parametrize("turn_deg", [(0, 0, 0), (5, -4, 7), (-3, 6, -11)])
def test_the_transfer_and_its_half_are_found_however_the_plate_is_held(turn_deg):
    """Also where the plate is printed 0.3 % too small: the transfer within 0.01, the limit within 1 %."""
    found = measure_transfer(*seen(BLUR_MM, turn_deg, scale=0.997, noise_mm=1e-4), PROFILE, 4.0)
    np.testing.assert_allclose(found.transfer, np.exp(-2 * (np.pi * BLUR_MM / PERIODS_MM) ** 2), atol=0.01)
    assert found.limit_mm == pytest.approx(LIMIT_MM, rel=0.01)
    assert found.predicted_mm == 4.0 and found.periods_mm == tuple(PERIODS_MM)


def test_limits_are_off_by_what_their_uncertainty_says():
    true = measure_transfer(*seen(BLUR_MM, noise_mm=1e-4), PROFILE, 4.0).limit_mm
    pulls = []
    for seed in range(10):
        found = measure_transfer(*seen(BLUR_MM, (2, 3, 4), noise_mm=0.1, seed=seed), PROFILE, 4.0)
        assert 0.01 < found.sigma_mm < 0.1
        pulls.append((found.limit_mm - true) / found.sigma_mm)
    assert 0.5 < np.sqrt(np.mean(np.square(pulls))) < 1.7  # of ten values of a standard normal one, 99 %


def test_noise_is_no_transfer():
    found = measure_transfer(*seen(BLUR_MM, noise_mm=0.3), PROFILE, 4.0)
    assert max(np.divide(found.transfer, found.transfer_sigma)[-3:]) < 4


def test_a_rig_that_resolves_all_periods_has_no_limit():
    found = measure_transfer(*seen(0.0, noise_mm=0.01), PROFILE, 0.5)
    assert found.limit_mm is None and found.sigma_mm is None and min(found.transfer) > 0.9


@pytest.mark.parametrize(
    ("changes", "share"),
    [
        ({"turn_deg": (0, 0, 90)}, r"\d"),
        ({"profile": lambda x: (0 * x,)}, r"\d"),
        ({"profile": lambda x: (2 * relief(x)[0],)}, "19[0-9]"),
        ({"blur_mm": 3 * BLUR_MM}, r"3\d"),
    ],
)
def test_what_is_not_the_plate_is_refused(changes, share):
    points, tile = seen(**{"blur_mm": BLUR_MM / 4, "noise_mm": 0.02} | changes)
    with pytest.raises(CalibrationError, match=f"^{share}% of the height of corrugations 10 mm long is seen: show the"):
        measure_transfer(points, tile, PROFILE, 4.0)


def test_slopes_are_those_of_the_heights():
    x = np.linspace(-60, 60, 100001)
    height, slope = relief(x)
    np.testing.assert_allclose(np.gradient(height, x)[1:-1], slope[1:-1], atol=1e-4)
    assert np.ptp(height) < 0.93 and np.abs(slope).max() < 0.68
