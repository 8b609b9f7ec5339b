"""Cells that hold a hidden step of whole cycles, against their NumPy twin."""

import numpy as np
import reference

from tikernels import runtime
from tikernels.phase.smoothing import MAX_DEPARTURE, measure_rates_kernel, rates_buffer
from tikernels.unwrapping.hidden_steps import TORN
from tikernels.unwrapping.patch_growing import CELL_HEIGHT, CELL_WIDTH, ORDER_BITS, ORDER_MASK
from tikernels.unwrapping.unwrapper import Unwrapper

SHAPE = (150, 203)
CYCLE = 2 * np.pi


def disc_in_front() -> tuple[np.ndarray, np.ndarray]:
    """Return the phase (rad) of a disc about a cycle in front of a wall, exactly one at 9 o'clock, and the disc."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    disc = (y - 140) ** 2 + (x - 101) ** 2 < 55**2
    return reference.ramp(*SHAPE, 12.0) + np.where(disc, CYCLE + 0.03 * (x - 46), 0.0), disc


def unwrapped_with_the_disc_apart() -> tuple[np.ndarray, Unwrapper, np.ndarray, np.ndarray]:
    """Unwrap it as if a frame before had told which patches lie on the disc, and that they lie a cycle in front."""
    true, disc = disc_in_front()
    phase = reference.wrapped(true).astype(np.float32)
    unwrapper = Unwrapper(*SHAPE)
    rates = rates_buffer(SHAPE[0])
    measure_rates_kernel(phase, np.ones(SHAPE, np.float32), rates)
    unwrapper.join(phase, np.ones(SHAPE, np.float32), rates)
    graph = unwrapper.graph()
    y, x = np.divmod(graph.first, SHAPE[1])
    inside = disc[y, x]
    order = np.rint((true[y, x] - phase[y, x]) / CYCLE).astype(int)
    roots = np.array([np.flatnonzero(inside == side)[0] for side in (False, True)])
    unwrapper.split(roots[inside.astype(int)].astype(np.int32))
    own = (runtime.to_host(unwrapper.labels)[y, x] & ORDER_MASK) - ORDER_MASK // 2 - 1
    unwrapper.set_orders(roots, (order - graph.offset - own)[roots])
    result = np.empty(SHAPE, np.float32), np.empty(SHAPE, np.uint8), np.empty(SHAPE, np.int32)
    unwrapper.write(phase, rates, *result)
    return true, unwrapper, result[0], runtime.to_host(rates)


def torn_cells(phase: np.ndarray, labels: np.ndarray, final: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Return (rows, columns) bool: the twin of `mark_torn_cells_kernel`."""
    height, width = phase.shape
    draft = np.maximum(labels, 0) >> ORDER_BITS
    order = (labels & ORDER_MASK) + final[1, draft]
    valid = (labels >= 0) & (final[0, draft] > 0)
    score = np.zeros((-(-height // CELL_HEIGHT), -(-width // CELL_WIDTH)), int)
    for axis, length, weight in ((0, CELL_HEIGHT, CELL_HEIGHT // CELL_WIDTH), (1, CELL_WIDTH, 1)):
        rate = rates[-1, 1 - axis]
        for border in range(length, phase.shape[axis], length):
            pair = [np.take(array, (border - 1, border), axis) for array in (phase, order, valid)]
            change, step = np.diff(pair[0], axis=axis).ravel() - rate, np.diff(pair[1], axis=axis).ravel()
            cycles = -np.rint(change / CYCLE)
            seam = (np.abs(change + CYCLE * cycles) < MAX_DEPARTURE) & (step != cycles) & pair[2].all(axis).ravel()
            across = np.add.reduceat(seam, np.arange(0, len(seam), (CELL_WIDTH, CELL_HEIGHT)[axis]))
            for side in (border // length - 1, border // length):
                score[(side, slice(None)) if axis == 0 else (slice(None), side)] += weight * across
    torn = score >= 6
    # Along the image's border the cells beside a torn one are torn, too.
    for line, wider in (
        (np.s_[0], torn[0]),
        (np.s_[-1], torn[-1]),
        (np.s_[:, 0], torn[:, 0]),
        (np.s_[:, -1], torn[:, -1]),
    ):
        score[line] += 6 * np.convolve(wider, (1, 1, 1), "same")
    return score >= 6


def test_cells_with_a_hidden_step_are_left_out(arch):
    """Where the disc's rim hides, cells lie on both surfaces: no run of wrong pixels may be left."""
    true, unwrapper, unwrapped, _ = unwrapped_with_the_disc_apart()
    cells = -(-SHAPE[0] // CELL_HEIGHT) * -(-SHAPE[1] // CELL_WIDTH)
    torn = (runtime.to_host(unwrapper.final)[2, :cells] == TORN).sum()
    assert 0 < torn < 0.05 * cells
    found = ~np.isnan(unwrapped)
    assert found.mean() > 0.95
    assert np.count_nonzero(np.abs(np.where(found, unwrapped - true, 0)) > np.pi) < 20


def test_as_the_twin(arch):
    true, unwrapper, _, rates = unwrapped_with_the_disc_apart()
    final, labels = runtime.to_host(unwrapper.final), runtime.to_host(unwrapper.labels)
    expected = torn_cells(reference.wrapped(true), labels, final, rates)
    np.testing.assert_array_equal(final[2, : expected.size].reshape(expected.shape) == TORN, expected)
