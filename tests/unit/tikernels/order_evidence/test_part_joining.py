"""Parts of regions that their evidence tells apart, against the sequential twin."""

import numpy as np
import pytest
import reference

import tikernels
from tikernels.order_evidence import join_parts
from tikernels.order_evidence.part_joining import CANDIDATES


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_parts_as_the_twin(arch, seed):
    """A grid of patches, whose halves prefer different offsets, with noise: the same parts as the sequential twin's."""
    rng = np.random.default_rng(seed)
    rows, columns = 9, 14
    number = np.arange(rows * columns).reshape(rows, columns)
    ends = np.concatenate(
        [
            np.stack([number[:-1].ravel(), number[1:].ravel()]),
            np.stack([number[:, :-1].ravel(), number[:, 1:].ravel()]),
        ],
        axis=1,
    ).astype(np.int32)
    ends = np.ascontiguousarray(ends[:, rng.permutation(ends.shape[1])])
    # Sixteenths: sums of float32 are then exact in any order.
    evidence = np.round(16 * rng.uniform(4, 9, (number.size, CANDIDATES + 1))) / 16
    right = (number % columns >= columns // 2).ravel()
    evidence[~right, 1] /= 8
    evidence[right, 2] /= 8
    evidence[:, -1] = 1
    evidence = (np.round(16 * evidence) / 16).astype(np.float32)
    top = (number // columns).ravel()
    orders = np.stack([top, top + 1], axis=1).astype(np.int32)
    expected = reference.join_parts(ends, 4, 20.0, 0.5, orders, evidence)
    before = orders.copy(), evidence.copy()
    parents = join_parts(ends, 4, 20.0, 0.5, orders, evidence)
    np.testing.assert_array_equal(parents, expected)
    assert len(np.unique(parents)) > 1
    for array, kept in zip((orders, evidence), before, strict=True):
        np.testing.assert_array_equal(array, kept)


def two_parts(span: int, margin: float) -> np.ndarray:
    """Return the parts of two patches that show this many orders, and prefer their own offset by this much."""
    orders = np.array([[0, span], [3, 3 + span]], np.int32)
    evidence = np.full((2, CANDIDATES + 1), 100.0, np.float32)
    evidence[0, 2] = evidence[1, 5] = 100.0 - margin
    evidence[:, CANDIDATES] = 10
    return join_parts(np.array([[0], [1]], np.int32), 4, 20.0, 3.0, orders, evidence)


def test_only_a_clear_margin_keeps_two_patches_apart(arch):
    """Twenty, or three for each of ten pairs; and four orders that each of them shows."""
    for span, margin, apart in ((4, 31.0, True), (4, 29.0, False), (3, 31.0, False), (9, 80.0, True)):
        np.testing.assert_array_equal(two_parts(span, margin), [0, 1] if apart else [0, 0])


def test_what_is_refused(arch):
    ends, orders = np.array([[0], [1]], np.int32), np.zeros((2, 2), np.int32)
    evidence = np.zeros((2, CANDIDATES + 1), np.float32)
    for bad in ((ends[0], orders, evidence), (ends, orders[:1], evidence), (ends, orders, evidence[:, 1:])):
        with pytest.raises(tikernels.ShapeError, match="has shape"):
            join_parts(bad[0], 4, 20.0, 3.0, bad[1], bad[2])
