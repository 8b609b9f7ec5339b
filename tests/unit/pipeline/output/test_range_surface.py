"""A range image as meshing needs it."""

import numpy as np
import pytest

from pipeline.output.range_surface import MAX_SLOPE, RangeSurface

SHAPE = (30, 40)


def sheet(pitch=1e-3):
    """Return points at 800 mm on rays that are a pitch apart."""
    y, x = np.indices(SHAPE, np.float32)
    return np.stack([x * pitch, y * pitch, np.ones(SHAPE)], axis=-1).astype(np.float32) * np.float32(800)


def test_a_pixel_is_as_wide_as_its_ray_is_from_the_next():
    surface = RangeSurface.of(None, np.ones(SHAPE, bool), sheet(), np.full(SHAPE[0] * SHAPE[1], 0.1, np.float32), None)
    np.testing.assert_allclose(surface.width, 0.8, rtol=1e-4)
    np.testing.assert_allclose(surface.sigma, 0.1)


def test_without_points_a_radian_is_the_largest_step():
    surface = RangeSurface.of(np.zeros(SHAPE, np.float32), np.ones(SHAPE, bool), None, None, None)
    np.testing.assert_allclose(surface.width * MAX_SLOPE, 1.0, rtol=1e-6)


def test_scatter_stands_in_for_a_sigma_that_is_not_there():
    points = sheet()
    points[..., 2] += np.random.default_rng(1).normal(0, 0.2, SHAPE)
    surface = RangeSurface.of(None, np.ones(SHAPE, bool), points, None, None)
    assert surface.sigma.max() == surface.sigma.min() == pytest.approx(0.2, rel=0.1)


def test_what_has_no_range_or_no_sigma_is_in_no_region():
    mask, region = np.ones(SHAPE, bool), np.full(SHAPE, 2, np.int32)
    mask[3, 4] = False
    sigma = np.full(mask.sum(), 0.1, np.float32)
    sigma[0] = np.nan
    surface = RangeSurface.of(None, mask, sheet(), sigma, region)
    assert surface.region[3, 4] == surface.region[0, 0] == 0 and (surface.region != 0).sum() == mask.sum() - 1
    assert (surface.sigma > 0).all()
    assert surface.without(mask).region.max() == 0 and surface.region.max() == 2


def test_an_empty_image_is_one():
    surface = RangeSurface.of(None, np.zeros(SHAPE, bool), sheet(), np.empty(0, np.float32), None)
    assert not surface.region.any()
