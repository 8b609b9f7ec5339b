"""Lateral colour undone: shifted sinusoids come back to their places."""

import numpy as np
import pytest

import tikernels
from tikernels.raw.lateral_color import align_channels

SHIFT = np.array([[-0.4, -0.5], [0.0, 0.0], [1.3, 0.6]])


def fringes(shift, shape=(61, 83), period=12.0):
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    # What lands at (x, y) belongs to (x, y) less the shift.
    phase = 2 * np.pi / period * (y[..., None] - shift[:, 1]) + 0.05 * (x[..., None] - shift[:, 0])
    return (0.5 + 0.4 * np.cos(phase)).astype(np.float32)


def test_a_shifted_fringe_comes_back(arch):
    """Inside the border to 0.2 % of its amplitude, a phase of 0.002 rad."""
    aligned = align_channels(fringes(SHIFT), SHIFT)
    expected = fringes(np.zeros((3, 2)))
    inside = (slice(3, -3), slice(3, -3))
    np.testing.assert_allclose(aligned[inside], expected[inside], atol=0.4 * 0.003)


def test_whole_pixels_are_exact(arch):
    image = np.random.default_rng(0).integers(0, 256, (20, 31, 3)).astype(np.uint8)
    aligned = align_channels(image, [[1, 0], [0, 0], [0, -2]])
    np.testing.assert_allclose(aligned[:, :-1, 0], image[:, 1:, 0], atol=1e-3)
    np.testing.assert_array_equal(aligned[..., 1], image[..., 1])
    np.testing.assert_allclose(aligned[2:, :, 2], image[:-2, :, 2], atol=1e-3)


def test_menu(menu):
    image = np.random.default_rng(1).random((9, 11, 3), np.float32)
    menu(lambda image, out=None: align_channels(image, SHIFT, out=out), np.empty_like(image), image=image)


def test_a_wrong_shift(arch):
    with pytest.raises(tikernels.ShapeError, match="3x2"):
        align_channels(np.zeros((4, 4, 3), np.float32), np.zeros((2, 2)))
