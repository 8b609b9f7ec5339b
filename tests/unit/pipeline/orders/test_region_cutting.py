"""Regions that have joined surfaces across steps of whole cycles."""

import numpy as np
import pytest
from support.coded_blocks import CODES, WIDTH, grid, reader_of

from pipeline.orders.posterior import OrderRange
from pipeline.orders.region_cutting import cut_regions

pytestmark = [pytest.mark.usefixtures("cpu"), pytest.mark.parametrize("name", CODES)]

ROWS, COLUMNS = 14, 12
TWO = [20] * 7 + [23] * 5


def cut(reader, rows=ROWS, columns=COLUMNS, order_range=None):
    reader.learn()
    roots, main = cut_regions(reader, grid(rows, columns), WIDTH, order_range)
    return roots.reshape(rows, columns), main


@pytest.mark.parametrize("gamma", [1.0, 2.0])
def test_two_surfaces_are_cut_apart(name, gamma):
    side, main = cut(reader_of(name, ROWS, COLUMNS, TWO, gamma=gamma))
    left, right = side[0, 0], side[0, -1]
    assert left != right and not (side[:, :7] == right).any() and not (side[:, 7:] == left).any()
    # A few patches at the border may be like neither.
    assert (side[:, :7] == left).mean() > 0.95 and (side[:, 7:] == right).mean() > 0.9
    assert main[0] == left and (main[1:] == -1).all()


def test_one_surface_stays_whole(name):
    roots, main = cut(reader_of(name, ROWS, COLUMNS, 20))
    assert not roots.any() and (main == -1).all()


@pytest.mark.parametrize("seed", range(3))
def test_a_large_surface_is_cut_off_in_one_piece(name, seed):
    """Its own steps are not taken for the factor, though it is larger than what that is averaged over."""
    reader = reader_of(name, 8, 60, [15] * 36 + [19] * 24, gamma=1.0, noise=0.02, seed=seed)
    side = cut(reader, 8, 60)[0]
    left, right = side[0, 0], side[0, -1]
    assert (side[:, :36] == left).mean() > 0.95 and (side[:, 36:] == right).mean() > 0.95 and left != right


@pytest.mark.parametrize("of_depth", [False, True])
def test_what_the_projector_does_not_show_is_not_looked_for(name, of_depth):
    """The picture holds the left surface's orders alone. A depth range, which may be wrong, leaves the cut alone."""
    ends = np.full((2, ROWS * COLUMNS), 20.0)
    roots, _ = cut(reader_of(name, ROWS, COLUMNS, TWO), order_range=OrderRange(*ends, of_depth))
    assert (roots[0, 0] != roots[0, -1]) == of_depth


@pytest.mark.parametrize("noise", [0.05, 0.15])
def test_noise_cuts_nothing(name, noise):
    """In the dark, single blocks deviate from the code by noise alone."""
    roots, _ = cut(reader_of(name, ROWS, 4 * COLUMNS, 20, noise=noise), columns=4 * COLUMNS)
    assert not roots.any()


def test_what_a_factor_of_its_own_cuts_off_shows_the_same_offset(name):
    """Light from a wall close by lowers the contrast of a quarter of the surface by a tenth."""
    block = np.arange(ROWS * 4 * COLUMNS * 2) % (4 * COLUMNS * 2)
    reader = reader_of(name, ROWS, 4 * COLUMNS, 20, factor=np.where(block < 2 * COLUMNS, -0.1, 0.0))
    roots = cut(reader, columns=4 * COLUMNS)[0].ravel()
    assert (roots > 0).mean() < 0.05
    for part in np.unique(roots):
        assert reader.read(np.flatnonzero(roots[reader.blocks.patch] == part)).best == 20


def test_a_surface_that_is_seen_well_before_a_noisy_wall(name):
    columns = 6 * COLUMNS
    lacks = [20] * 4 * COLUMNS + [25] * 2 * COLUMNS
    reader, dark = reader_of(name, ROWS, columns, lacks), reader_of(name, ROWS, columns, lacks, noise=0.06)
    wall = reader.blocks.place[:, 1] < 8 * 4 * COLUMNS
    reader.blocks.contrast[wall] = dark.blocks.contrast[wall]
    reader.blocks.variance[wall] = dark.blocks.variance[wall]
    roots, _ = cut(reader, columns=columns)
    surface = roots[:, 4 * COLUMNS + 1 :]
    assert len(np.unique(surface)) == 1 and surface[0, 0] != roots[0, 0]


def test_few_blocks_tell_nothing(name):
    """Nor do blocks of a region that is too small to be parted."""
    roots, main = cut(reader_of(name, 1, 5, [20, 20, 20, 23, 23]), 1, 5)
    assert not roots.any() and (main == -1).all()
