"""What is written, and what is left out beside steps."""

import numpy as np
import pytest
import reference
from support.wrapped_surfaces import flat_rates, join, written

from tikernels import ShapeError, runtime
from tikernels.phase.wrapped_phase import STEP_PHASE
from tikernels.unwrapping.region_writing import write_unwrapped
from tikernels.unwrapping.tables import BETWEEN, HAS_STEPS, HIDES_STEP, NOTHING, ORDER_ZERO, Final


def outputs(shape):
    return tuple(runtime.empty(shape, dtype) for dtype in (np.float32, np.uint8, np.int32))


def pixels_of(labels, phase, final):
    """Return the region of every pixel that the kernel writes."""
    outs = outputs(phase.shape)
    write_unwrapped(phase, flat_rates(), labels, final, *outs)
    return [np.array(runtime.to_host(out)) for out in outs]


def two_cells(order: int, region: tuple[int, int], steps: tuple[int, int]):
    """Return labels of two cells, one patch each, and what is final of them: the right one has an order more."""
    labels = np.full((16, 16), ORDER_ZERO, np.int32)
    labels[:, 8:] = (1 << 6) + ORDER_ZERO
    return labels, np.array([region, (-ORDER_ZERO, order - ORDER_ZERO), steps], np.int32)


@pytest.mark.parametrize("steps", [0, HAS_STEPS, HIDES_STEP])
@pytest.mark.parametrize("order", [0, 1])
def test_pixels_beside_a_step_of_whole_cycles(arch, steps, order):
    """Only cells that have steps are looked at: there the last pixel on either side; all of one that hides a step."""
    phase = np.full((16, 16), 0.25, np.float32)
    labels, final = two_cells(order, (1, 1), (steps, 0))
    unwrapped, mask, region = pixels_of(labels, phase, final)
    expected = np.ones((16, 16), int)
    if steps == HIDES_STEP:
        expected[:, :8] = 0
    elif steps == HAS_STEPS and order == 1:
        expected[:, 7] = 0
    np.testing.assert_array_equal(region, expected)
    np.testing.assert_array_equal(mask, expected)
    value = 0.25 + 2 * np.pi * order * (np.arange(16) >= 8)
    np.testing.assert_allclose(unwrapped, np.where(expected, value, np.nan), atol=1e-6)


def test_neighbours_that_leave_pixels_out(arch):
    """A pixel between surfaces and too small a region do, a pixel without a phase and another region do not."""
    phase = np.zeros((16, 16), np.float32)
    for label, number, left_out in ((BETWEEN, 1, True), (NOTHING, 1, False), (None, 0, True), (None, 2, False)):
        labels, final = two_cells(5, (1, number), (HAS_STEPS, 0))
        if label is not None:
            labels[:, 8:] = label
        region = pixels_of(labels, phase, final)[2]
        assert (region[:, 7] == 0).all() == left_out
        assert (region[:, :7] == 1).all()


def test_cells_with_steps_and_their_neighbours_are_known(arch):
    """A pixel between surfaces marks its cell and the four beside it."""
    phase = reference.wrapped(reference.ramp(80, 40))
    phase[40, 20] = STEP_PHASE
    patches, rates = join(phase)
    _, _, region = written(patches, phase, rates)
    steps = runtime.to_host(patches.final)[Final.STEPS, : patches.cells].reshape(5, 5)
    cross = np.zeros((5, 5), int)
    cross[2, 1:4] = cross[1:4, 2] = HAS_STEPS
    np.testing.assert_array_equal(steps, cross)
    out = np.argwhere(region == 0)
    np.testing.assert_array_equal(out, [[39, 20], [40, 19], [40, 20], [40, 21], [41, 20]])


def test_outputs_are_checked(arch):
    phase = reference.wrapped(reference.ramp(32, 40))
    patches, rates = join(phase)
    for i, bad in enumerate(outputs((32, 39))):
        outs = list(outputs(phase.shape))
        outs[i] = bad
        with pytest.raises(ShapeError, match=r"expected \(32, 40\)"):
            patches.write(phase, np.ones_like(phase), rates, *outs)
