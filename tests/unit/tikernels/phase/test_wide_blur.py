"""Wide averages on a coarser grid are those of every pixel's own surroundings."""

import cv2
import numpy as np
import pytest

from tikernels.phase.wide_blur import wide_blur


@pytest.mark.parametrize("along_px, across_px", [(1.5, 1.0), (4.8, 3.0), (6.0, 11.0), (30.0, 19.0)])
@pytest.mark.parametrize("shape", [(240, 321), (150, 200, 3)])
def test_averages_are_those_of_a_gaussian(shape, along_px, across_px):
    rng = np.random.default_rng(1)
    values = rng.normal(size=shape).astype(np.float32)
    values[40:90, 50:120] += 3
    given = values.copy()
    expected = cv2.GaussianBlur(values, (0, 0), along_px, sigmaY=across_px, borderType=cv2.BORDER_CONSTANT)
    blurred = wide_blur(values, along_px, across_px)
    assert blurred.shape == shape and blurred.dtype == np.float32
    largest = np.abs(expected).max()
    np.testing.assert_allclose(blurred, expected, atol=0.06 * largest)  # the last half cell at a border is flat
    assert np.sqrt(np.mean((blurred - expected) ** 2)) < 0.006 * largest
    np.testing.assert_array_equal(values, given)


def test_windows_are_as_wide_as_asked_for():
    """A point becomes a spot with the Gaussian's own variance, to which neither cells nor interpolation add."""
    for sigma_px in (2.0, 5.0, 12.0, 40.0):
        spots = []
        for start in range(20):  # wherever it lies in a cell
            values = np.zeros((401, 401), np.float32)
            values[200, 200 + start] = 1
            spots.append(np.roll(wide_blur(values, sigma_px, sigma_px).sum(axis=0), -start))
        spot, x = np.mean(spots, axis=0).astype(np.float64), np.arange(401) - 200
        assert spot.sum() == pytest.approx(1, abs=2e-3)
        assert np.sqrt((spot * x**2).sum() / spot.sum()) == pytest.approx(sigma_px, rel=0.02)
