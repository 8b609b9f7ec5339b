"""Regions that have joined surfaces across steps of whole cycles."""

from dataclasses import replace

import numpy as np
import pytest
from support.coded_steps import grid, shown

from pipeline.orders.posterior import OrderRange
from pipeline.orders.region_cutting import cut_regions

ROWS, COLUMNS = 14, 12


@pytest.mark.usefixtures("cpu")
def test_two_surfaces_are_cut_apart():
    _, steps = shown(ROWS, COLUMNS, [30] * 7 + [33] * 5)
    roots, main = cut_regions(steps, grid(ROWS, COLUMNS))
    side = roots.reshape(ROWS, COLUMNS)
    assert len(np.unique(side[:, :7])) == len(np.unique(side[:, 7:])) == 1
    assert side[0, 0] != side[0, -1]
    assert main[0] == side[0, 0]


@pytest.mark.usefixtures("cpu")
def test_one_surface_stays_whole():
    _, steps = shown(ROWS, COLUMNS, [30] * COLUMNS)
    roots, main = cut_regions(steps, grid(ROWS, COLUMNS))
    assert not roots.any() and (main == -1).all()


@pytest.mark.usefixtures("cpu")
@pytest.mark.parametrize("of_depth", [False, True])
def test_what_the_projector_does_not_show_is_not_looked_for(of_depth):
    """A depth range, which may be wrong, leaves the cut alone."""
    _, steps = shown(ROWS, COLUMNS, [30] * 7 + [33] * 5)
    ends = np.full((2, ROWS * COLUMNS), [[25.0], [31.0]])
    roots, _ = cut_regions(steps, grid(ROWS, COLUMNS), OrderRange(*ends, of_depth))
    assert (roots[0] != roots[COLUMNS - 1]) == of_depth


@pytest.mark.usefixtures("cpu")
@pytest.mark.parametrize("noise", [0.05, 0.15])
def test_noise_cuts_nothing(noise):
    """In the dark, single columns deviate from the code by noise alone."""
    _, steps = shown(ROWS, 4 * COLUMNS, [30] * 4 * COLUMNS, noise=noise)
    roots, _ = cut_regions(steps, grid(ROWS, 4 * COLUMNS))
    assert not roots.any()


@pytest.mark.usefixtures("cpu")
def test_surfaces_of_other_brightness_scatter_by_themselves():
    """A noisy wall hides no surface before it that is seen well."""
    lacks = [30] * 4 * COLUMNS + [35] * 2 * COLUMNS
    _, dark = shown(ROWS, len(lacks), lacks, noise=0.06)
    _, bright = shown(ROWS, len(lacks), lacks)
    before = bright.column >= 4 * COLUMNS
    rise, brightness = np.where(before, bright.rise, dark.rise), np.where(before, 100.0, 10.0)
    roots, _ = cut_regions(replace(bright, rise=rise, brightness=brightness), grid(ROWS, len(lacks)))
    surface = roots.reshape(ROWS, -1)[:, 4 * COLUMNS + 1 :]
    assert len(np.unique(surface)) == 1 and surface[0, 0] != roots[0]


@pytest.mark.usefixtures("cpu")
def test_few_steps_tell_nothing():
    _, steps = shown(1, COLUMNS, [30] * COLUMNS)
    roots, main = cut_regions(steps, grid(1, COLUMNS))
    assert not roots.any() and (main == -1).all()
