"""Regions that have joined surfaces across steps of whole cycles."""

import numpy as np
import pytest
from support.coded_steps import grid, shown

from pipeline.orders.posterior import OrderRange
from pipeline.orders.region_cutting import cut_regions, spread_and_strength

ROWS, COLUMNS = 14, 12


@pytest.mark.usefixtures("cpu")
def test_two_surfaces_are_cut_apart():
    _, steps = shown(ROWS, COLUMNS, [30] * 7 + [33] * 5)
    sigma, strength = spread_and_strength(steps)
    assert 0.01 < sigma < 0.03 and 0.95 < strength < 1.05
    roots, main = cut_regions(steps, grid(ROWS, COLUMNS), sigma, strength)
    side = roots.reshape(ROWS, COLUMNS)
    assert len(np.unique(side[:, :7])) == len(np.unique(side[:, 7:])) == 1
    assert side[0, 0] != side[0, -1]
    assert main[0] == side[0, 0]


@pytest.mark.usefixtures("cpu")
def test_one_surface_stays_whole():
    _, steps = shown(ROWS, COLUMNS, [30] * COLUMNS)
    roots, main = cut_regions(steps, grid(ROWS, COLUMNS), *spread_and_strength(steps))
    assert not roots.any() and (main == -1).all()


@pytest.mark.usefixtures("cpu")
@pytest.mark.parametrize("of_depth", [False, True])
def test_what_the_projector_does_not_show_is_not_looked_for(of_depth):
    """A depth range, which may be wrong, leaves the cut alone."""
    _, steps = shown(ROWS, COLUMNS, [30] * 7 + [33] * 5)
    ends = np.full((2, ROWS * COLUMNS), [[25.0], [31.0]])
    roots, _ = cut_regions(steps, grid(ROWS, COLUMNS), *spread_and_strength(steps), OrderRange(*ends, of_depth))
    assert (roots[0] != roots[COLUMNS - 1]) == of_depth


@pytest.mark.usefixtures("cpu")
def test_a_frame_without_the_code():
    _, steps = shown(1, COLUMNS, [30] * COLUMNS)
    sigma, strength = spread_and_strength(steps)
    assert strength == 0
    roots, main = cut_regions(steps, grid(1, COLUMNS), sigma, strength)
    assert not roots.any() and (main == -1).all()
