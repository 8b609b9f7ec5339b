"""Colour crosstalk and its inverse."""

import numpy as np
import pytest
import reference

import tikernels
from pipeline.simulation import TYPICAL_CROSSTALK
from tikernels.phase.crosstalk import Crosstalk, invert_crosstalk

MATRIX = np.array(TYPICAL_CROSSTALK)


@pytest.mark.parametrize("shape", [(1, 1, 3), (1, 9, 3), (13, 7, 3)])
def test_as_the_twin(arch, shape):
    image = np.random.default_rng(1).random(shape, np.float32)
    projector = tikernels.correct_crosstalk(image, MATRIX)
    # A thousandth of a grey level of an 8-bit camera.
    np.testing.assert_allclose(projector, reference.correct_crosstalk(image, MATRIX), atol=4e-6)


def test_there_and_back(arch):
    """Phase through crosstalk and back; 1e-5 rad is a hundredth of the best camera's noise."""
    phase = reference.ramp(40, 30)
    seen = reference.fringes(phase, crosstalk_matrix=MATRIX)
    found, _, _ = tikernels.compute_wrapped_phase(tikernels.correct_crosstalk(seen, MATRIX))
    assert np.abs(reference.wrapped_difference(found, phase)).max() < 1e-5


def test_pure_primaries(arch):
    """The matrix' columns are what the camera sees of each primary alone."""
    seen = np.transpose(MATRIX)[None].astype(np.float32)
    np.testing.assert_allclose(tikernels.correct_crosstalk(seen, MATRIX)[0], np.eye(3), atol=1e-6)


def test_missing_values_spread_to_no_other_pixel(arch):
    image = np.full((3, 4, 3), 0.5, np.float32)
    image[1, 2, 0] = np.nan
    missing = np.isnan(tikernels.correct_crosstalk(image, MATRIX))
    assert missing[1, 2].all() and missing.sum() == 3


def test_normalized_rows_keep_grey():
    inverse = invert_crosstalk(MATRIX, normalize_rows=True)
    np.testing.assert_allclose(inverse @ np.ones(3), 1, atol=1e-12)


def test_menu(menu):
    image = np.random.default_rng(2).random((5, 7, 3), np.float32)
    menu(lambda image, out=None: tikernels.correct_crosstalk(image, MATRIX, out=out), np.empty_like(image), image=image)


@pytest.mark.parametrize(
    "matrix, message",
    [
        (np.ones((3, 3)), "two of its rows are alike"),
        (np.eye(2), r"3x3 finite numbers, got shape \(2, 2\)"),
        (np.diag([1, np.nan, 1]), "finite"),
    ],
)
def test_impossible_matrices(arch, matrix, message):
    with pytest.raises(tikernels.ShapeError, match=message):
        tikernels.correct_crosstalk(np.zeros((2, 2, 3), np.float32), matrix)


def test_a_row_in_the_wrong_order():
    with pytest.raises(tikernels.ShapeError, match="does not sum to a positive number"):
        invert_crosstalk([[1, 0, 0], [0, -1, 0], [0, 0, 1]], normalize_rows=True)


def test_what_decoding_needs_of_a_matrix():
    """Grey stays grey; weights find the phase behind what is left to undo."""
    crosstalk = Crosstalk.of(MATRIX)
    np.testing.assert_allclose(crosstalk.matrix @ crosstalk.inverse, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(crosstalk.matrix.sum(axis=1), 1, atol=1e-6)
    phase = np.linspace(-3, 3, 31)
    light = 0.4 + 0.25 * np.cos(phase + reference.CHANNEL_PHASES[:, None])
    vector = crosstalk.weights @ (crosstalk.matrix @ light)
    np.testing.assert_allclose(vector, [0.25 * np.cos(phase), 0.25 * np.sin(phase), np.full(31, 0.4)], atol=1e-6)
