"""Where two surfaces meet the phase is less sure, by what taking one for the other does to it."""

import numpy as np
import pytest
from support.colored_boards import MATRIX, PAINTS, light, surface_matrix

from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.surface_edges import edge_variance, turns_by_confusion
from tikernels.phase.surfaces import NO_SURFACE, Surfaces

WHITE, ORANGE, BLUE = range(3)


def board() -> Crosstalk:
    """Two columns of white and orange, and blue in a corner; below, nothing is lit."""
    matrices = np.array([surface_matrix(PAINTS[name]) for name in ("white", "orange", "blue")])
    labels = np.zeros((40, 60), np.uint8)
    labels[:, 30:] = ORANGE
    labels[:8, 50:] = BLUE
    labels[30:] = NO_SURFACE
    mixing = matrices @ np.linalg.inv(MATRIX)
    return Crosstalk.of(MATRIX, surfaces=Surfaces.of(mixing, labels))


def test_a_surface_is_not_confused_with_itself(cpu):
    turns = turns_by_confusion(board())
    assert turns.shape == (3, 3)
    assert np.abs(np.diag(turns)).max() < 1e-6
    assert (turns[~np.eye(3, dtype=bool)] > 0.02).all()


def test_the_turn_is_that_of_light_decoded_as_another_surface_s(cpu):
    """Orange as white: by the arctangent of the channels, balanced."""
    crosstalk, phase = board(), np.linspace(-np.pi, np.pi, 360, endpoint=False)
    seen = light(phase, gamma=1.0) @ surface_matrix(PAINTS["orange"]).T
    channels = seen / seen.mean(axis=0) * MATRIX.sum(axis=1)
    cosine, sine, _ = crosstalk.weights.astype(float) @ (channels / MATRIX.sum(axis=1)).T
    expected = np.sqrt((np.angle((cosine + 1j * sine) * np.exp(-1j * phase)) ** 2).mean())
    mixing = crosstalk.surfaces.mixing
    assert np.allclose(mixing[WHITE], mixing[WHITE][0, 0] * np.eye(3), atol=1e-6)
    assert turns_by_confusion(crosstalk)[ORANGE, WHITE] == pytest.approx(expected, rel=0.02)


def test_only_edges_are_less_sure(cpu):
    variance = edge_variance(board())
    assert variance.shape == (40, 60) and variance.dtype == np.float32
    assert (variance[12:27, 27:33] > 0).all()
    assert not variance[12:27, :26].any() and not variance[12:27, 34:].any()
    assert not variance[28:, :26].any()  # where nothing is lit there is no other surface
    assert variance[7, 55] > 0
    assert variance[7, 55] != variance[20, 30]
