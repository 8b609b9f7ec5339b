"""Cells of an image, and the numbers of the patches that are drafted in them."""

import numpy as np
import pytest

from tikernels.unwrapping.tables import CELL_HEIGHT, CELL_WIDTH, Cell, cells_of, numbers_of


@pytest.mark.parametrize(
    ("size", "cells"),
    [
        ((CELL_HEIGHT, CELL_WIDTH), (1, 1)),
        ((CELL_HEIGHT + 1, CELL_WIDTH), (2, 1)),
        ((1, 3 * CELL_WIDTH), (1, 3)),
        ((5 * CELL_HEIGHT - 1, 2 * CELL_WIDTH + 1), (5, 3)),
    ],
)
def test_cells_cover_an_image_and_no_more(size, cells):
    assert cells_of(*size) == cells


@pytest.mark.parametrize("bits", [3, 7])
def test_patches_are_numbered_cell_by_cell(bits):
    """The second cell holds two patches and the third none: the fourth one's follow the second's."""
    cells = np.zeros((len(Cell), 5), np.int32)
    cells[Cell.PATCHES] = [0, 1, 3, 3, 4]  # of the cells before
    drafts = np.array([0, 1 << bits, (1 << bits) + 1, 3 << bits])
    np.testing.assert_array_equal(numbers_of(drafts, cells, bits), [0, 1, 2, 3])
