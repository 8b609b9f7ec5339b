"""Cells that hold a hidden step of whole cycles, against their NumPy twin."""

import numpy as np
import reference
from support.wrapped_surfaces import drafts_and_orders, join, written

from tikernels import runtime
from tikernels.phase.phase_change import RATE_ACROSS, RATE_ALONG
from tikernels.phase.smoothing import MAX_DEPARTURE
from tikernels.unwrapping.hidden_steps import MIN_SEAM_PX, mark_hidden_steps_kernel
from tikernels.unwrapping.patches import Patches
from tikernels.unwrapping.tables import CELL_HEIGHT, CELL_WIDTH, HIDES_STEP, ORDER_ZERO, Final, cells_of

SHAPE = (150, 203)
CYCLE = 2 * np.pi


def disc_in_front() -> tuple[np.ndarray, np.ndarray]:
    """Return the phase (rad) of a disc about a cycle in front of a wall, exactly one at 9 o'clock, and the disc."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    disc = (y - 140) ** 2 + (x - 101) ** 2 < 55**2
    return reference.ramp(*SHAPE, 12.0) + np.where(disc, CYCLE + 0.03 * (x - 46), 0.0), disc


def unwrapped_with_the_disc_apart() -> tuple[np.ndarray, Patches, np.ndarray, np.ndarray]:
    """Unwrap it as if a frame before had told which patches lie on the disc, and that they lie a cycle in front."""
    true, disc = disc_in_front()
    phase = reference.wrapped(true)
    patches, rates = join(phase)
    graph = patches.graph()
    y, x = np.divmod(graph.first, SHAPE[1])
    inside = disc[y, x]
    order = np.rint((true[y, x] - phase[y, x]) / CYCLE).astype(int)
    roots = np.array([np.flatnonzero(inside == side)[0] for side in (False, True)])
    patches.split(roots[inside.astype(int)].astype(np.int32))
    own = drafts_and_orders(runtime.to_host(patches.labels))[1][y, x]
    patches.set_orders(roots, (order - graph.offset - own)[roots])
    return true, patches, written(patches, phase, rates)[0], runtime.to_host(rates)


def cells_with_hidden_steps(phase: np.ndarray, labels: np.ndarray, final: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Return (rows, columns) bool: the twin of `mark_hidden_steps_kernel`."""
    draft, order = drafts_and_orders(labels)
    order = order + ORDER_ZERO + final[Final.ORDER, draft]
    valid = (labels >= 0) & (final[Final.REGION, draft] > 0)
    score = np.zeros(cells_of(*phase.shape), int)
    for axis, length, weight in ((0, CELL_HEIGHT, CELL_HEIGHT // CELL_WIDTH), (1, CELL_WIDTH, 1)):
        rate = rates[-1, (RATE_ACROSS, RATE_ALONG)[axis]]
        for border in range(length, phase.shape[axis], length):
            pair = [np.take(array, (border - 1, border), axis) for array in (phase, order, valid)]
            change, step = np.diff(pair[0], axis=axis).ravel() - rate, np.diff(pair[1], axis=axis).ravel()
            cycles = -np.rint(change / CYCLE)
            seam = (np.abs(change + CYCLE * cycles) < MAX_DEPARTURE) & (step != cycles) & pair[2].all(axis).ravel()
            across = np.add.reduceat(seam, np.arange(0, len(seam), (CELL_WIDTH, CELL_HEIGHT)[axis]))
            for side in (border // length - 1, border // length):
                score[(side, slice(None)) if axis == 0 else (slice(None), side)] += weight * across
    hidden = score >= MIN_SEAM_PX
    # Along the image's border so do the cells beside one that hides a step.
    for line, wider in (
        (np.s_[0], hidden[0]),
        (np.s_[-1], hidden[-1]),
        (np.s_[:, 0], hidden[:, 0]),
        (np.s_[:, -1], hidden[:, -1]),
    ):
        score[line] += MIN_SEAM_PX * np.convolve(wider, (1, 1, 1), "same")
    return score >= MIN_SEAM_PX


def test_cells_with_a_hidden_step_are_left_out(arch):
    """Where the disc's rim hides, cells lie on both surfaces: no run of wrong pixels may be left."""
    true, patches, unwrapped, _ = unwrapped_with_the_disc_apart()
    hidden = (runtime.to_host(patches.final)[Final.STEPS, : patches.cells] == HIDES_STEP).sum()
    assert 0 < hidden < 0.05 * patches.cells
    found = ~np.isnan(unwrapped)
    assert found.mean() > 0.95
    assert np.count_nonzero(np.abs(np.where(found, unwrapped - true, 0)) > np.pi) < 20


def test_as_the_twin(arch):
    true, patches, _, rates = unwrapped_with_the_disc_apart()
    final, labels = runtime.to_host(patches.final), runtime.to_host(patches.labels)
    expected = cells_with_hidden_steps(reference.wrapped(true), labels, final, rates)
    found = final[Final.STEPS, : expected.size].reshape(expected.shape) == HIDES_STEP
    np.testing.assert_array_equal(found, expected)


def test_six_pixels_make_a_seam(arch):
    """Two cells side by side on one plane, the right one's orders a cycle off: only from six border pixels on.

    Where the cells differ in brightness the surface ends between them, and no step hides in either; shading is no edge.
    """
    phase = np.zeros((CELL_HEIGHT, 2 * CELL_WIDTH), np.float32)
    rates = np.zeros((1, 5), np.float32)
    even = np.ones_like(phase)
    edge = np.where(np.arange(2 * CELL_WIDTH) < CELL_WIDTH, even, 1.3).astype(np.float32)
    shaded = np.exp(-0.003 * np.arange(2 * CELL_WIDTH) ** 2 * even).astype(np.float32)
    for count in (5, 6, CELL_HEIGHT):
        labels = np.full(phase.shape, ORDER_ZERO, np.int32)
        labels[:, CELL_WIDTH:] = -1
        labels[:count, CELL_WIDTH:] = (1 << 6) + ORDER_ZERO + 1
        final, seams = np.array([[1, 1], [-ORDER_ZERO, -ORDER_ZERO], [0, 0]], np.int32), np.zeros((2, 2), np.int32)
        for brightness in (even, shaded):
            mark_hidden_steps_kernel(phase, brightness, rates, labels, seams, final)
            np.testing.assert_array_equal(final[Final.STEPS] == HIDES_STEP, count >= 6)
            final[Final.STEPS] = 0
        mark_hidden_steps_kernel(phase, edge, rates, labels, seams, final)
        assert (final[Final.STEPS] == 0).all()
