"""What surfaces do to the channels, and what undoes it."""

import numpy as np
from support.colored_boards import MATRIX, PAINTS, PERIOD_PX, board, surface_matrix

from tikernels import runtime
from tikernels.phase.color_balance import Gains
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.frame_statistics import FrameLevels
from tikernels.phase.surfaces import NO_SURFACE, Surfaces

LEVELS = FrameLevels(255.0, 1.0, 0.0, 1.0, 5.0, 5.0)


def test_without_labels_all_show_the_first_one():
    surfaces = Surfaces.of(MATRIX)
    assert surfaces.labels.shape == (1, 1)
    assert surfaces.mixed
    np.testing.assert_allclose(surfaces.mixing[0] @ surfaces.unmixing[0], np.eye(3), atol=1e-6)
    np.testing.assert_array_equal(surfaces.ambient, np.zeros((1, 3)))
    assert not Surfaces.of(np.eye(3)).mixed
    assert Surfaces.of(np.stack([np.eye(3)] * 2), np.zeros((4, 4), np.uint8)).mixed


def test_samples_are_what_a_white_board_would_show(arch):
    """Of a board of two paints: the projector's light through the crosstalk, and nothing where there is no surface."""
    image, phase, numbers = board(["orange", "blue"], (64, 96), noise=0.0, gamma=1.0)
    neutral = MATRIX / MATRIX.sum(axis=1, keepdims=True)
    matrices = np.stack([surface_matrix(PAINTS[paint]) for paint in ("orange", "blue")])
    labels = numbers.astype(np.uint8)
    labels[:16] = NO_SURFACE
    ambient = 6 * matrices.sum(axis=2) + 4
    surfaces = Surfaces.of(matrices @ np.linalg.inv(neutral), labels, ambient)
    gains = Gains(64, 96, PERIOD_PX)
    gains.measure(image, Crosstalk.of(neutral, surfaces=surfaces), LEVELS)
    samples = runtime.to_host(gains.samples)
    rows = np.arange(64)[:, None]
    columns = np.arange(samples.shape[1]) * gains.spacing_px + (rows & 1) * gains.window.rows
    light = 240 * (0.5 + 0.5 * np.cos(phase[rows, columns][..., None] + np.array([-1, 0, 1]) * 2 * np.pi / 3))
    np.testing.assert_allclose(samples[16:], (light @ neutral.T)[16:], atol=0.05)
    assert not samples[:16].any()
    np.testing.assert_allclose(runtime.to_host(gains.gains)[4:], 1, atol=0.04)  # at the cut
