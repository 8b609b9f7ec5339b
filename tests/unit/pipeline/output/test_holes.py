"""Small holes in surfaces."""

import numpy as np
import pytest

from pipeline.output.range_surface import RangeSurface, fill_holes

SHAPE = (60, 60)
SIGMA_MM = 0.05


def surface_with(hole, depth=None, region=None):
    """Return a bowl with a hole, whose noise is known, and its true depth."""
    y, x = np.indices(SHAPE) - 30.0
    true = (800 + 0.01 * (x**2 + y**2) if depth is None else depth).astype(np.float32)
    noise = np.random.default_rng(1).normal(0, SIGMA_MM, SHAPE).astype(np.float32)
    known = np.ones(SHAPE, np.int32) if region is None else region.copy()
    known[hole] = 0
    sigma, width = np.full(SHAPE, SIGMA_MM, np.float32), np.full(SHAPE, 0.6, np.float32)
    return RangeSurface(np.where(known, true + noise, 0).astype(np.float32), sigma, width, known), true


def test_a_hole_in_a_smooth_surface_is_filled_within_its_sigma():
    surface, true = surface_with(np.s_[20:25, 30:34])
    found = fill_holes(surface)
    assert len(found.filled) == 20 and found.surface.region.all()
    off = (found.surface.depth - true).ravel()[found.filled]
    assert np.abs(off).max() < 3 * found.surface.sigma.ravel()[found.filled].max()
    assert (found.surface.sigma.ravel()[found.filled] < 2 * SIGMA_MM).all()
    assert surface.region[20, 30] == 0  # what was given stays as it was


def test_each_filled_pixel_has_a_measured_one_beside_it():
    surface, _ = surface_with(np.s_[20:25, 30:34])
    found = fill_holes(surface)
    assert surface.region.ravel()[found.beside].all()
    apart = np.array(np.unravel_index(found.filled, SHAPE)) - np.array(np.unravel_index(found.beside, SHAPE))
    assert np.abs(apart).max() <= 2 and (np.diff(found.filled) > 0).all()


@pytest.mark.parametrize(
    "hole",
    [np.s_[10:23, 10:23], np.s_[0:4, 20:24]],
    ids=["more than 144 px", "open to the border"],
)
def test_what_is_no_small_hole_stays_open(hole):
    assert len(fill_holes(surface_with(hole)[0]).filled) == 0


def test_no_hole_is_filled_across_a_step():
    step = np.where(np.arange(60) < 30, 800, 801) * np.ones((60, 1))
    assert len(fill_holes(surface_with(np.s_[20:24, 28:32], depth=step)[0]).filled) == 0


def test_no_hole_is_filled_between_regions():
    region = np.where(np.arange(60) < 30, 1, 2) * np.ones((60, 1), np.int32)
    assert len(fill_holes(surface_with(np.s_[20:24, 28:32], region=region)[0]).filled) == 0


def test_a_hole_beside_another_surface_tells_nothing_of_it():
    """Only the region around it does: the other one may lie anywhere."""
    region = np.where(np.arange(60) < 36, 1, 2) * np.ones((60, 1), np.int32)
    depth = np.where(region == 1, 800.0, 900.0)
    surface, true = surface_with(np.s_[20:23, 30:33], depth=depth, region=region)
    found = fill_holes(surface)
    assert len(found.filled) == 9
    assert np.abs(found.surface.depth - true).ravel()[found.filled].max() < 0.2


def test_nothing_to_fill():
    surface, _ = surface_with(np.s_[:0])
    assert len(fill_holes(surface).filled) == 0
    assert len(fill_holes(surface_with(np.s_[:])[0]).filled) == 0
