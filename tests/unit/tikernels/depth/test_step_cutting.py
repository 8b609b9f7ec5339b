"""Which neighbouring pixels are on one surface."""

import numpy as np
import pytest
import reference
from support.linked_pixels import all_linked

from tikernels.depth.step_cutting import DOWN, FALLING, RIGHT, RISING, cut_steep_links, link_pixels

SHAPE = (24, 30)
WIDTH_MM = 0.6
MAX_SLOPE = 4.0


def pictured(depth, sigma_mm=0.05, region=None):
    """Return the arguments for a picture of depths, mm."""
    depth = np.asarray(depth, np.float32)
    sigma, width = np.full(depth.shape, sigma_mm, np.float32), np.full(depth.shape, WIDTH_MM, np.float32)
    return depth, sigma, width, np.ones(depth.shape, np.int32) if region is None else region


def columns(shape=SHAPE):
    return np.arange(shape[1]) * np.ones((shape[0], 1))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_as_the_twin(arch, seed):
    rng = np.random.default_rng(seed)
    shape = (13, 17)
    depth = 800 + 0.9 * columns(shape) + np.where(columns(shape) > 8, 2.5, 0) + rng.normal(0, 0.3, shape)
    region = (1 + (rng.random(shape) > 0.95) - (rng.random(shape) > 0.9)).astype(np.int32)
    arguments = pictured(depth, 0.1, region)
    found = link_pixels(*arguments)
    expected = reference.link_pixels(*arguments)
    assert (found == expected).mean() > 0.995  # float32 and float64 may round to different sides of a bound
    assert 0.05 < (all_linked(shape) != expected).mean() < 0.95


@pytest.mark.parametrize("slope", [0.0, 1.0, 2.0])
def test_a_slope_is_no_step(arch, slope):
    noise = np.random.default_rng(4).normal(0, 0.05, SHAPE)
    depth = 800 + slope * WIDTH_MM * columns() + noise
    assert (link_pixels(*pictured(depth)) == all_linked(SHAPE)).mean() > 0.99


def test_the_same_rise_is_a_step_where_the_surface_beside_it_is_level(arch):
    """1.6 mm, 2.7 widths of a pixel, between flat pieces."""
    depth = 800 + np.where(columns() < 15, 0, 1.6)
    links = link_pixels(*pictured(depth))
    assert not (links[:, 14] & (RIGHT | FALLING | RISING)).any()
    expected = all_linked(SHAPE)
    expected[:, 14] &= DOWN
    np.testing.assert_array_equal(links, expected)


def test_noise_that_is_known_is_no_step(arch):
    """What is a step at 0.05 mm is none at 0.3 mm."""
    depth = 800 + np.where(columns() < 15, 0, 1.6)
    np.testing.assert_array_equal(link_pixels(*pictured(depth, 0.3)), all_linked(SHAPE))


def test_nothing_is_seen_more_obliquely_than_85_degrees(arch):
    links = [link_pixels(*pictured(800 + slope * WIDTH_MM * columns())) & RIGHT for slope in (11.0, 12.0)]
    assert links[0][:, :-1].all() and not links[1].any()


@pytest.mark.parametrize(("sigma_mm", "kept"), [(0.0, True), (0.1, True), (0.2, False)])
def test_a_fitted_surface_is_surely_less_steep_than_a_slope(arch, sigma_mm, kept):
    """3.2 of four widths, and three standard deviations of the difference, which are 0.7 or 1.4 widths."""
    depth, sigma, width, _ = pictured(800 + 3.2 * WIDTH_MM * columns(), sigma_mm)
    links = cut_steep_links(all_linked(SHAPE), depth, sigma, width, MAX_SLOPE)
    expected = all_linked(SHAPE) & (np.uint8(255) if kept else np.uint8(DOWN))
    np.testing.assert_array_equal(links, expected)


def test_a_diagonal_is_no_steeper_than_a_side(arch):
    """Both slopes are three widths, and the two together six."""
    rising = 800 + 3.0 * WIDTH_MM * (columns() + np.arange(SHAPE[0])[:, None])
    depth, sigma, width, _ = pictured(rising, 0.01)
    links = cut_steep_links(all_linked(SHAPE), depth, sigma, width, MAX_SLOPE)
    np.testing.assert_array_equal(links, all_linked(SHAPE) & np.uint8(RIGHT | DOWN | RISING))


def test_what_is_not_linked_stays_so(arch):
    rng = np.random.default_rng(5)
    depth, sigma, width, _ = pictured(800 + rng.normal(0, 1.0, SHAPE), 0.1)
    links = all_linked(SHAPE) & rng.integers(0, 16, SHAPE).astype(np.uint8)
    found = cut_steep_links(links, depth, sigma, width, MAX_SLOPE)
    whole = cut_steep_links(all_linked(SHAPE), depth, sigma, width, MAX_SLOPE)
    np.testing.assert_array_equal(found, links & whole)
    assert 0.05 < (found != links).mean() < 0.95


def test_regions_stay_apart(arch):
    region = np.where(columns() < 12, 1, 2).astype(np.int32)
    region[:, 20:] = 0
    links = link_pixels(*pictured(np.full(SHAPE, 800.0), region=region))
    assert not (links[:, 11] & (RIGHT | FALLING | RISING)).any()
    assert not links[:, 20:].any() and not (links[:, 19] & ~np.uint8(DOWN)).any()


def test_menu(menu):
    rng = np.random.default_rng(3)
    depth, sigma, width, region = pictured(800 + rng.normal(0, 0.5, (7, 9)), 0.1)
    menu(
        link_pixels,
        np.empty((7, 9), np.uint8),
        depth=depth,
        sigma=sigma,
        width=width,
        region=region,
    )


def test_menu_of_steep_links(menu):
    rng = np.random.default_rng(3)
    depth, sigma, width, _ = pictured(800 + rng.normal(0, 0.5, (7, 9)), 0.1)
    menu(
        lambda out=None, **inputs: cut_steep_links(**inputs, max_slope=MAX_SLOPE, out=out),
        np.empty((7, 9), np.uint8),
        links=all_linked((7, 9)),
        depth=depth,
        sigma=sigma,
        width=width,
    )
