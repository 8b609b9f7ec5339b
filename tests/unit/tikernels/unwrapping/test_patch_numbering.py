"""Numbers without gaps, against NumPy's cumulative sums."""

import numpy as np
import pytest

from tikernels import runtime
from tikernels.unwrapping.patch_numbering import collect_patches_kernel, number_patches_kernel
from tikernels.unwrapping.tables import Cell, Contact, Counter, Patch, numbers_of

CELLS, BITS = 37, 3


def drafted(seed: int):
    """Return counts of patches and contacts, and drafts whose every entry tells where it is from."""
    rng = np.random.default_rng(seed)
    cells = np.zeros((3, CELLS + 1), np.int32)
    cells[Cell.PATCHES, :-1] = rng.integers(0, 9, CELLS)
    cells[Cell.CONTACTS, :-1] = np.where(cells[Cell.PATCHES, :-1] > 0, rng.integers(0, 33, CELLS), 0)
    patches = np.arange(2 * (CELLS << BITS), dtype=np.int32).reshape(2, -1)
    contacts = np.arange(5 * (CELLS << (BITS + 2)), dtype=np.int32).reshape(5, -1)
    full = np.flatnonzero(cells[Cell.PATCHES, :-1])
    for row in (Contact.FROM, Contact.TO):
        cell = rng.choice(full, contacts.shape[1])
        contacts[row] = (cell << BITS) + rng.integers(0, cells[Cell.PATCHES, cell])
    return cells, patches, contacts


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("serial", [True, False])
@pytest.mark.parametrize("at_once", [CELLS, 10])
def test_as_numpy(arch, seed, serial, at_once):
    cells, patches, contacts = drafted(seed)
    counts, counters = cells.copy(), np.full(4, 99, np.int32)
    for first in range(0, CELLS, at_once):
        number_patches_kernel(first, min(first + at_once, CELLS), cells, counters)
    for row in (Cell.PATCHES, Cell.CONTACTS):
        np.testing.assert_array_equal(cells[row], np.concatenate([[0], np.cumsum(counts[row, :-1])]))
    assert counters[Counter.PATCHES] == counts[Cell.PATCHES].sum()
    assert counters[Counter.CONTACTS] == counts[Cell.CONTACTS].sum()
    assert counters[Counter.CROWDED] == max(counts[Cell.PATCHES].max(), -(-counts[Cell.CONTACTS].max() // 4))
    table, collected = (np.full((rows, many), -1, np.int32) for rows, many in ((11, CELLS << BITS), (5, CELLS << 5)))
    tables = [runtime.to_device(array) for array in (patches, contacts, cells, table, collected)]
    collect_patches_kernel(serial, CELLS, BITS, *tables)
    table, collected = (runtime.to_host(array) for array in tables[-2:])
    own = np.concatenate([(cell << BITS) + np.arange(counts[Cell.PATCHES, cell]) for cell in range(CELLS)])
    np.testing.assert_array_equal(table[: Patch.FIRST + 1, : len(own)], patches[:, own])
    for row in (Patch.PARENT, Patch.HEAD):
        np.testing.assert_array_equal(table[row, : len(own)], np.arange(len(own)))
    place = np.concatenate([(cell << (BITS + 2)) + np.arange(counts[Cell.CONTACTS, cell]) for cell in range(CELLS)])
    np.testing.assert_array_equal(collected[Contact.SHIFT :, : len(place)], contacts[Contact.SHIFT :, place])
    ends = collected[[Contact.FROM, Contact.TO], : len(place)]
    np.testing.assert_array_equal(ends, numbers_of(contacts[:2, place], cells, BITS))
    np.testing.assert_array_equal(own[ends], contacts[:2, place])
