"""Contacts across the borders of cells, against closed forms and a twin."""

from itertools import groupby

import numpy as np
import pytest
import reference
from support.wrapped_surfaces import cell_of, drafts_and_orders, flat_rates

from tikernels.phase.smoothing import MAX_DEPARTURE
from tikernels.unwrapping.drafts import Drafts
from tikernels.unwrapping.patch_contacts import note_borders_kernel
from tikernels.unwrapping.patch_growing import grow_patches_kernel
from tikernels.unwrapping.tables import GOLDEN, Cell, Contact, cells_of

ACROSS, TILT, BITS = 2 * np.pi / 12, 0.05, 5


def noted(phase, quality):
    """Return labels, and the contacts that were noted across borders, one a row."""
    drafts = Drafts(*phase.shape, BITS)
    labels = np.empty(phase.shape, np.int32)
    tables = [np.zeros(table.shape, np.int32) for table in (drafts.patches, drafts.contacts, drafts.cell_table)]
    rates = flat_rates(TILT, ACROSS)
    grow_patches_kernel(phase, quality, rates, BITS, labels, *tables)
    before = tables[2][Cell.CONTACTS].copy()
    note_borders_kernel(phase, quality, rates, BITS, labels, *tables[1:])
    after = tables[2][Cell.CONTACTS]
    rows = [
        tables[1][:, (cell << (BITS + 2)) + k] for cell in range(drafts.cells) for k in range(before[cell], after[cell])
    ]
    return labels, np.array(rows).reshape(-1, 5)


@pytest.mark.parametrize("shape", [(48, 24), (35, 21)])
def test_on_a_plane_every_border_is_one_contact(arch, shape):
    """Whole sides are worth 64 votes a pixel, twice that on the shorter ones, and say what the orders lack."""
    true = reference.ramp(*shape, 12.0, tilt=TILT)
    phase = reference.wrapped(true)
    labels, contacts = noted(phase, np.ones(shape, np.float32))
    rows, columns = cells_of(*shape)
    assert len(contacts) == rows * (columns - 1) + columns * (rows - 1)
    cell, (drafts, order) = cell_of(shape), drafts_and_orders(labels)
    zero = np.rint((true - phase) / (2 * np.pi)).astype(int) - order
    for a, b, shift, votes, _ in contacts:
        assert zero[drafts == b][0] - zero[drafts == a][0] == shift
        across = (b >> BITS) - (a >> BITS) != 1
        pixels = np.ptp(np.nonzero(cell == a >> BITS)[int(across)]) + 1
        assert abs(votes - 64 * pixels * (1 + across)) <= 2 * pixels  # float32 may round a departure up
    assert len(np.unique(contacts[:, Contact.NAME])) == len(contacts)


@pytest.mark.parametrize("noise", [0.1, 0.3])
def test_as_the_twin(arch, noise):
    """What pixels on either side say, piece by piece; the weights up to float32's rounding."""
    rng = np.random.default_rng(3)
    shape = (50, 43)
    phase = reference.wrapped(reference.ramp(*shape, 12.0, tilt=TILT) + noise * rng.standard_normal(shape))
    quality = rng.uniform(0.5, 1.5, shape).astype(np.float32)
    labels, contacts = noted(phase, quality)
    expected = twin(phase.astype(np.float64), quality.astype(np.float64), labels)
    found = {tuple(row[[0, 1, 2, 4]]): row[3] for row in contacts}
    assert found.keys() == expected.keys()
    for key, votes in expected.items():
        assert abs(found[key] - votes) <= 1 + 0.01 * votes


def twin(phase, quality, labels):
    """Return the votes of each contact, by its two drafts, the shift and the name."""
    height, width = phase.shape
    drafts, order = drafts_and_orders(labels)
    contacts = {}
    for top in range(0, height, 16):
        for left in range(0, width, 8):
            bottom, right = min(top + 16, height) - 1, min(left + 8, width) - 1
            beside = [((y, right), (y, right + 1)) for y in range(top, bottom + 1) if right + 1 < width]
            below = [((bottom, x), (bottom + 1, x)) for x in range(left, right + 1) if bottom + 1 < height]
            for side, pairs, rate in ((0, beside, TILT), (1, below, ACROSS)):

                def said(pair, rate=rate):
                    a, b = pair
                    departure = phase[b] - phase[a] - rate
                    cycles = -np.rint(departure / (2 * np.pi))
                    if not abs(departure + 2 * np.pi * cycles) <= MAX_DEPARTURE:
                        return None
                    return int(drafts[a]), int(drafts[b]), int(order[a] - order[b] + cycles)

                for what, piece in groupby(pairs, said):
                    if what is not None:
                        agreeing = list(piece)
                        (y, x), _ = agreeing[0]
                        name = int(np.int64(3 * (y * width + x) + 1 + side) * GOLDEN + 2**31) % 2**32 - 2**31
                        votes = [weight(phase, quality, *pair, rate) for pair in agreeing]
                        contacts[(*what, name)] = (1 + side) * sum(votes)
    return contacts


def weight(phase, quality, a, b, rate):
    departure = phase[b] - phase[a] - rate
    going_on = 1 - abs(departure - 2 * np.pi * np.rint(departure / (2 * np.pi))) / MAX_DEPARTURE
    low, high = sorted((quality[a], quality[b]))
    return 1 + int(63 * going_on**2 * (low / high) ** 2 * min(4 * low, 1))
