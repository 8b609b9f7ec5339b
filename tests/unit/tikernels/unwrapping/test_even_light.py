"""Light without a fringe."""

import numpy as np
import reference
from support.wrapped_surfaces import join

from tikernels.unwrapping.even_light import patches_of_even_light
from tikernels.unwrapping.surface_borders import sample_cells
from tikernels.unwrapping.tables import CELL_HEIGHT, CELL_WIDTH, cells_of

SHAPE = (98, 128)


def even_cells(phase):
    """Return (rows, columns) whether a cell's patches are of even light; the patches must agree."""
    patches, rates = join(phase, np.ones(SHAPE, np.float32))
    changes = sample_cells(phase, rates, patches.labels).changes
    even = patches_of_even_light(changes, patches.cell_table, patches.count)
    first = patches.graph().first
    result = np.full(cells_of(*SHAPE), -1)
    for patch, cell in enumerate(zip(first // SHAPE[1] // CELL_HEIGHT, first % SHAPE[1] // CELL_WIDTH, strict=True)):
        assert result[cell] in (-1, even[patch])
        result[cell] = even[patch]
    return result


def test_a_shadow_in_a_lit_room(arch):
    """Beside it a wall, and a side whose phase changes by two thirds of the usual; two rows at the end are too few."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    true = np.where(x < 48, 0.35, 0.52) * y
    shadow = (y >= 64) & (x >= 64)
    true[shadow] = 1.2
    phase = reference.wrapped(true + rng.normal(0, 0.1, SHAPE)).astype(np.float32)
    even = even_cells(phase)
    assert even[4:6, 8:].all() and not even[:4].any() and not even[:, :8].any() and not even[6].any()
