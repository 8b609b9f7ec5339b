"""Patches of single cells: what they hold, and where they end."""

import numpy as np
import pytest
import reference
from support.wrapped_surfaces import cell_of, drafts_and_orders, flat_rates

from tikernels.phase.wrapped_phase import NO_PHASE, STEP_PHASE
from tikernels.unwrapping.drafts import Drafts
from tikernels.unwrapping.patch_growing import grow_patches_kernel
from tikernels.unwrapping.tables import BETWEEN, NOTHING, Cell, Contact, Patch

ACROSS, TILT = 2 * np.pi / 12, 0.05


def grown(phase, quality=None, rates=None, bits=4):
    """Return the drafts of a phase, on the host."""
    drafts = Drafts(*phase.shape, bits)
    quality = np.ones(phase.shape, np.float32) if quality is None else quality.astype(np.float32)
    labels = np.full(phase.shape, -9, np.int32)
    tables = [np.full(table.shape, -9, np.int32) for table in (drafts.patches, drafts.contacts, drafts.cell_table)]
    rates = flat_rates(TILT, ACROSS) if rates is None else rates
    grow_patches_kernel(phase.astype(np.float32), quality, rates, bits, labels, *tables)
    return labels, *tables


def plane(shape):
    true = reference.ramp(*shape, 12.0, tilt=TILT)
    return true, reference.wrapped(true)


@pytest.mark.parametrize("shape", [(16, 8), (64, 48), (33, 21), (1, 40), (40, 1)])
def test_on_a_plane_every_cell_is_one_patch(arch, shape):
    """Its orders are the plane's up to a constant; cells of fewer than eight columns go the long way."""
    true, phase = plane(shape)
    labels, patches, _, cells = grown(phase)
    drafts, order = drafts_and_orders(labels)
    cell = cell_of(shape)
    np.testing.assert_array_equal(drafts, cell << 4)
    cycles = np.rint((true - phase) / (2 * np.pi)).astype(int)
    for number in range(cell.max() + 1):
        inside = cell == number
        first = np.flatnonzero(inside)[0]
        np.testing.assert_array_equal(order[inside], cycles[inside] - cycles.ravel()[first])
        assert patches[Patch.FIRST, number << 4] == first
        assert patches[Patch.PIXELS, number << 4] == inside.sum()
    np.testing.assert_array_equal(cells[:, :-1], [[1], [0], [0]] * np.ones(cell.max() + 1, int))


def test_what_has_no_phase_belongs_to_nothing(arch):
    _, phase = plane((32, 16))
    phase[3, 2], phase[20, 9:12] = NO_PHASE, STEP_PHASE
    labels, patches, _, cells = grown(phase)
    assert labels[3, 2] == NOTHING and (labels[20, 9:12] == BETWEEN).all()
    assert (labels >= 0).sum() == labels.size - 4
    np.testing.assert_array_equal(cells[Cell.STEPS, :-1], [0, 0, 0, 1])
    drafts = np.unique(labels[labels >= 0] >> 6)
    assert patches[Patch.PIXELS, drafts].sum() == labels.size - 4


@pytest.mark.parametrize("step", [1.2, -2.0, 3.1])
def test_a_step_ends_a_patch(arch, step):
    """From the sixth column on the phase lies higher by far more than a surface's noise: two patches, no contact."""
    true = reference.ramp(16, 8, 12.0, tilt=TILT) + step * (np.arange(8) >= 5)
    labels, patches, _, cells = grown(reference.wrapped(true))
    drafts, _ = drafts_and_orders(labels)
    assert (drafts[:, :5] == 0).all() and (drafts[:, 5:] == 1).all()
    np.testing.assert_array_equal(patches[Patch.PIXELS, :2], [80, 48])
    np.testing.assert_array_equal(cells[:2, 0], [2, 0])


def test_a_doubtful_joint_is_a_contact(arch):
    """0.6 rad is too much for one patch and too little for a step: 16 contacts, by as many cycles as the orders lack.

    Every row's runs touch beside each other; each vote weighs 1 + 63 (1 - 0.6 / 0.8)^2.
    """
    true = reference.ramp(16, 8, 12.0, tilt=TILT) + 0.6 * (np.arange(8) >= 5)
    phase = reference.wrapped(true)
    labels, _, contacts, cells = grown(phase)
    drafts, order = drafts_and_orders(labels)
    assert cells[Cell.PATCHES, 0] == 2 and cells[Cell.CONTACTS, 0] == 16
    noted = contacts[:, :16]
    np.testing.assert_array_equal(noted[[Contact.FROM, Contact.TO]], [[0] * 16, [1] * 16])
    cycles = np.rint((true - phase) / (2 * np.pi)).astype(int)
    zero = [(cycles - order)[drafts == draft] for draft in (0, 1)]
    assert all(np.ptp(values) == 0 for values in zero)
    assert (noted[Contact.SHIFT] == zero[1][0] - zero[0][0]).all()
    assert (np.abs(noted[Contact.VOTES] - (1 + 63 / 16)) <= 1).all()
    assert len(np.unique(noted[Contact.NAME])) == 16


def test_a_run_follows_most_of_its_pixels(arch):
    """A run under two patches joins the one that more of its pixels continue, and notes a contact with the other."""
    true = np.zeros((2, 8))
    true[0, :3] = -2.0  # a step above: three pixels on one side, five on the other
    true[1, :3] = -0.1
    rates = flat_rates(0.0, 0.0)
    labels, _, contacts, cells = grown(reference.wrapped(true), rates=rates)
    drafts, _ = drafts_and_orders(labels)
    np.testing.assert_array_equal(drafts[0], [0, 0, 0, 1, 1, 1, 1, 1])
    assert (drafts[1] == 1).all()
    assert cells[Cell.CONTACTS, 0] == 0  # 1.9 rad above the first three is a step
    true[0, :3] = -0.75
    labels, _, contacts, cells = grown(reference.wrapped(true), rates=rates)
    drafts, _ = drafts_and_orders(labels)
    assert (drafts[1] == 1).all()
    assert cells[Cell.CONTACTS, 0] == 2  # beside each other in the row above, and above each other
    np.testing.assert_array_equal(contacts[[Contact.FROM, Contact.TO], 1], [0, 1])


def test_crowded_cells_count_on(arch):
    """Noise makes more patches than there are places: the count tells how many there should be."""
    rng = np.random.default_rng(2)
    phase = rng.uniform(-np.pi, np.pi, (64, 64)).astype(np.float32)
    rates = flat_rates()
    ample, tight = (grown(phase, rates=rates, bits=bits) for bits in (7, 1))
    np.testing.assert_array_equal(tight[3][Cell.PATCHES, :-1], ample[3][Cell.PATCHES, :-1])
    assert ample[3][Cell.PATCHES, :-1].max() > 2
