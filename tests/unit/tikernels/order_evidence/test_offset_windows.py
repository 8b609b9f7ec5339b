"""Windows and pieces of a region that show another offset, against NumPy twins."""

import numpy as np

from tikernels.order_evidence.offset_labelling import LANES, OffsetEvidence
from tikernels.order_evidence.offset_windows import Cells, find_other_offsets

ROWS, COLUMNS = 6, 9
COUNT = ROWS * COLUMNS


def random_evidence(own):
    """Return evidence of each patch of a grid for 40 offsets, most against the region's own."""
    rng = np.random.default_rng(3)
    departs, weight = rng.normal(0, 2, (COUNT, 48)), rng.uniform(1, 3, COUNT)
    squares = departs**2 / weight[:, None] + rng.uniform(0, 9, departs.shape)
    squares[:, own] += 6
    sums = np.stack([squares, departs], axis=1).astype(np.float32).reshape(COUNT, 2, 3, LANES).swapaxes(1, 2)
    return OffsetEvidence(np.ascontiguousarray(sums), weight.astype(np.float32), 40)


def test_windows_as_the_twin(arch):
    """The best windows first, none over another one; larger than the region they are as large as it."""
    own, common, windows = 21, 4.0, np.array([[2, 3], [1, 1], [5, 4], [99, 2]])
    evidence, counts = random_evidence(own), np.array([1.0, 1.0, 0.75, 1.0])
    row, column = np.divmod(np.arange(COUNT), COLUMNS)
    squares, departs = (evidence.sums[:, :, kind].reshape(COUNT, -1)[:, :40] for kind in range(2))
    found = []
    for (high, wide), count in zip(np.minimum(windows, [ROWS, COLUMNS]), counts, strict=True):
        for top in range(0, ROWS - high + 1, max(high // 4, 1)):
            for left in range(0, COLUMNS - wide + 1, max(wide // 4, 1)):
                within = (row >= top) & (row < top + high) & (column >= left) & (column < left + wide)
                remains = squares[within].sum(axis=0)
                remains -= departs[within].sum(axis=0) ** 2 / (evidence.weight[within].sum() + 1 / common)
                found.append((count * (remains[own] - remains.min()), within, remains.argmin()))
    expected, named, better = np.full(COUNT, -1), [], []
    for gain, within, offset in sorted(found, key=lambda window: -window[0]):
        if gain > 2.0 and (expected[within] < 0).all():
            expected[within] = len(named)
            named.append(offset)
            better.append(gain)
    assert len(named) > 4
    cells, rule = Cells.of(row + 7, column + 2), {"common": common, "least": 2.0, "most_columns": 3.0}
    window, offsets, gain = find_other_offsets(evidence, cells, evidence.weight, own, windows, **rule)
    np.testing.assert_array_equal(window, expected)
    np.testing.assert_array_equal(offsets, named)
    np.testing.assert_allclose(gain, better, rtol=1e-4)


def test_pieces_of_like_brightness_are_asked(arch):
    """A dark surface that lies aslant on a bright one fills no window, but is a piece of its own."""
    rows, columns, own, other = 24, 30, 3, 9
    row, column = np.divmod(np.arange(rows * columns), columns)
    aslant = np.abs(column - row - 2) < 1
    aslant |= np.abs(column - row - 3) < 1
    dark = aslant & (row > 3) & (row < 20)
    squares = np.full((rows * columns, LANES), 4.0, np.float32)
    squares[:, own] = np.where(dark, 2.5, 1.0)
    squares[dark, other] = 1.0
    weight = np.full(len(row), 2.0, np.float32)
    evidence = OffsetEvidence(np.stack([squares, 0 * squares], axis=1)[:, None], weight, LANES)
    cells, windows = Cells.of(row, column), np.array([[4, 6]], np.int32)
    rule = {"common": 4.0, "least": 16.0, "most_columns": np.inf}
    for brightness in (np.where(dark, 3.0, 4.0), np.where(dark, 4.0, 3.0)):
        piece, offsets, gain = find_other_offsets(evidence, cells, weight * brightness, own, windows, **rule)
        np.testing.assert_array_equal(piece, np.where(dark, 0, -1))
        assert offsets.tolist() == [other]
        np.testing.assert_allclose(gain, [1.5 * dark.sum()], rtol=1e-5)
    # Alike in brightness, windows alone tell; and all of a row count as so many columns at most.
    piece, _, _ = find_other_offsets(evidence, cells, 3 * weight, own, windows, **rule)
    assert (piece < 0).all()
    rule["most_columns"] = 1.0
    _, _, gain = find_other_offsets(evidence, cells, weight * np.where(dark, 3.0, 4.0), own, windows, **rule)
    np.testing.assert_allclose(gain, [0.75 * dark.sum()], rtol=1e-5)
