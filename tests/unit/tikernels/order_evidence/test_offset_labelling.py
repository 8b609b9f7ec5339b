"""Labels of patches by the offsets that their blocks name, against NumPy twins."""

import numpy as np

from tikernels.order_evidence.offset_labelling import (
    connected_parts,
    pool_evidence,
    settle_labels,
    weigh_offsets,
)

ROWS, COLUMNS = 6, 9
COUNT = ROWS * COLUMNS


def grid():
    """Return the ends of the contacts of a grid of patches."""
    number = np.arange(COUNT).reshape(ROWS, COLUMNS)
    beside = np.stack([number[:, :-1].ravel(), number[:, 1:].ravel()])
    below = np.stack([number[:-1].ravel(), number[1:].ravel()])
    return np.concatenate([beside, below], axis=1)


def test_deviations_as_the_twin(arch):
    """Of a code that changes along the stripe, whose columns change with the order; outside it all deviate alike."""
    rng = np.random.default_rng(0)
    code, offsets = rng.normal(0, 0.1, (20, 30)), range(-8, 24)
    order, level, sigma = rng.integers(-4, 9, 120), rng.normal(0, 0.1, 120), rng.uniform(0.02, 0.1, 120)
    columns = (rng.normal(0, 1, (120, 4)) * [3, 0.1, 1e-3, 1e-5]).astype(np.float32)
    held = rng.integers(0, 120, 200), rng.integers(0, COUNT, 200), rng.uniform(0.1, 1, 200)
    evidence = weigh_offsets(held, order, level, sigma, columns, code, offsets, COUNT, 3.0)
    squares, departs = np.zeros((2, COUNT, len(offsets)))
    for k, offset in enumerate(offsets):
        cycle = order + offset
        along = (columns * cycle[:, None] ** np.arange(4)).sum(axis=1)
        shown = code[np.clip(cycle, 0, 19), np.floor(np.mod(along, 1) * 30).astype(int)]
        outside = (cycle < 0) | (cycle >= 20)
        deviation = np.clip((level - shown) / sigma, -3, 3)
        np.add.at(squares[:, k], held[1], held[2] * np.where(outside, 9.0, deviation**2)[held[0]])
        np.add.at(departs[:, k], held[1], held[2] * np.where(outside, 0.0, deviation)[held[0]])
    np.testing.assert_allclose(evidence.of(np.arange(len(offsets))), squares, rtol=1e-4, atol=1e-3)
    seen = evidence.sums[:, :, 1].reshape(COUNT, -1)[:, : len(offsets)]
    np.testing.assert_allclose(seen, departs, rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(evidence.weight, np.bincount(held[1], held[2], COUNT), rtol=1e-5)


def test_what_is_pooled_as_the_twin():
    rng = np.random.default_rng(1)
    ends, weights = grid(), rng.uniform(0, 1, grid().shape[1])
    evidence = rng.uniform(0, 9, (COUNT, 19)).astype(np.float32)
    matrix = np.zeros((COUNT, COUNT))
    matrix[ends[0], ends[1]] = matrix[ends[1], ends[0]] = weights
    expected = evidence.astype(float)
    for _ in range(3):
        expected = evidence + matrix @ expected
    pooled = pool_evidence(evidence, ends, weights)
    np.testing.assert_allclose(pooled, expected, rtol=1e-5)


def test_labels_settle_with_their_neighbours():
    """Two halves that show different offsets, a third of the patches by chance the other one: two halves again."""
    rng = np.random.default_rng(2)
    right = (np.arange(COUNT) % COLUMNS >= 5).astype(int)
    shown = np.where(rng.random(COUNT) < 0.25, 1 - right, right)
    evidence = np.where(np.arange(2) == shown[:, None], 0.0, 6.0).astype(np.float32)
    evidence[shown == right] *= 2
    ends = grid()
    labels = settle_labels(evidence, shown, ends, np.full(ends.shape[1], 4.0))
    assert np.mean(labels == right) > 0.9 > np.mean(shown == right)
    # Where a difference costs nothing, every patch keeps what it shows itself.
    alone = settle_labels(evidence, np.zeros(COUNT, int), ends, np.zeros(ends.shape[1]))
    np.testing.assert_array_equal(alone, shown)


def test_parts_that_are_connected():
    ends = grid()
    cut = (ends % COLUMNS >= 5).sum(axis=0) != 1
    parts = connected_parts(ends[:, cut], COUNT)
    np.testing.assert_array_equal(parts, np.where(np.arange(COUNT) % COLUMNS >= 5, 5, 0))
    np.testing.assert_array_equal(connected_parts(ends[:, :0], 3), [0, 1, 2])
