"""A range image for meshing: widths and scatter, specks and teeth, holes, rims."""

import numpy as np
import pytest
from support.linked_pixels import all_linked

from pipeline.output.range_surface import MAX_SLOPE, RangeSurface, fill_holes, find_surfaces, links_within, rim_shifts
from tikernels.depth.step_cutting import DOWN, RIGHT

SHAPE = (30, 40)

HOLED = (60, 60)
SIGMA_MM = 0.05

RIMMED = (60, 80)


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


def of_pixels(pixels):
    """Return the links of pixels without steps."""
    return links_within(all_linked(pixels.shape), pixels)


def test_a_tooth_at_a_rim_falls():
    pixels = np.zeros((20, 20), bool)
    pixels[5:, :] = True
    pixels[4, 9] = True  # one pixel out of a straight rim
    surfaces, specks = find_surfaces(of_pixels(pixels))
    pixels[4, 9] = False
    np.testing.assert_array_equal(surfaces, pixels)
    assert not specks.any()


def test_a_row_that_is_a_step_away_falls():
    """As the first row of a picture, half of whose area is lit: linked along itself, and to nothing else."""
    links = all_linked((20, 20))
    links[0] &= RIGHT
    surfaces, _ = find_surfaces(links)
    assert not surfaces[0].any() and surfaces[1:].all()


def test_a_slanted_rim_stays():
    """Each pixel of a staircase is the corner of a whole square."""
    y, x = np.indices((24, 24))
    pixels = x <= y
    pixels[0, 0] = pixels[-1, -1] = False
    kept = find_surfaces(of_pixels(pixels), least_squares=1)[0]
    assert (kept & pixels).sum() > pixels.sum() - 24 and kept[12, 11]


@pytest.mark.parametrize(("side", "stays"), [(12, False), (13, True)])
def test_surfaces_of_fewer_than_128_squares_are_specks(side, stays):
    """11 x 11 squares, and 12 x 12."""
    pixels = np.zeros((40, 40), bool)
    pixels[3 : 3 + side, 3 : 3 + side] = True
    surfaces, specks = find_surfaces(of_pixels(pixels))
    assert surfaces.any() == stays and specks.any() != stays
    assert (surfaces | specks).sum() == side**2


def test_a_step_parts_surfaces():
    links = all_linked((30, 30))
    links[:, 4] &= DOWN  # five columns: 4 x 29 squares
    surfaces, specks = find_surfaces(links)
    assert specks[:, :5].all() and surfaces[:, 5:].all()


def test_links_within_lead_nowhere_else():
    pixels = np.ones((6, 7), bool)
    pixels[2, 3] = False
    links = links_within(all_linked((6, 7)), pixels)
    assert links[2, 3] & (RIGHT | DOWN) == 0 and links[2, 2] & RIGHT == 0 and links[1, 3] & DOWN == 0
    assert (links == all_linked((6, 7))).sum() == 6 * 7 - 4  # its eight links are kept by four pixels


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1)])
def test_lines_are_no_surfaces(shape):
    surfaces, specks = find_surfaces(all_linked(shape))
    assert surfaces.shape == shape and not surfaces.any() and not specks.any()


def surface_with(hole, depth=None, region=None):
    """Return a bowl with a hole, whose noise is known, and its true depth."""
    y, x = np.indices(HOLED) - 30.0
    true = (800 + 0.01 * (x**2 + y**2) if depth is None else depth).astype(np.float32)
    noise = np.random.default_rng(1).normal(0, SIGMA_MM, HOLED).astype(np.float32)
    known = np.ones(HOLED, np.int32) if region is None else region.copy()
    known[hole] = 0
    sigma, width = np.full(HOLED, SIGMA_MM, np.float32), np.full(HOLED, 0.6, np.float32)
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
    apart = np.array(np.unravel_index(found.filled, HOLED)) - np.array(np.unravel_index(found.beside, HOLED))
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


def half_plane(slant):
    """Return what lies below a line that falls by `slant` px a column, and how far above the line each pixel is, px."""
    y, x = np.indices(RIMMED)
    above = (20 + slant * x - y) / np.hypot(1, slant)
    return above <= 0, above


@pytest.mark.parametrize("slant", [0.0, 0.13, 0.3, 0.5, 1.0])
def test_stairs_become_a_line(slant):
    """Where the stairs are less than a pixel high, which they are but for one in 45 degrees."""
    kept, above = half_plane(slant)
    shifts = rim_shifts(kept)
    rim = kept & shifts.any(axis=-1)
    rim[:, :6] = rim[:, -6:] = False
    first = kept & ~np.roll(kept, 1, axis=0)
    first[:, :6] = first[:, -6:] = False
    # The vertex's own distance, and what it has moved across the line.
    across = (shifts[..., 1] * slant - shifts[..., 0]) / np.hypot(1, slant)
    assert np.std((above + across)[first]) < 0.5 * np.std(above[first]) + 0.06
    assert np.abs(shifts).max() <= 0.49 + 1e-6
    assert not (shifts[rim & ~kept]).any()


def test_a_straight_rim_stays():
    kept, _ = half_plane(0.0)
    assert np.abs(rim_shifts(kept)).max() < 0.02


def test_the_images_border_is_no_rim():
    assert not rim_shifts(np.ones(RIMMED, bool)).any()


def test_only_rims_move():
    kept = np.zeros(RIMMED, bool)
    kept[10:50, 20:60] = True
    shifts = rim_shifts(kept)
    assert not shifts[12:48, 22:58].any() and not shifts[~kept].any()
    # Corners are rounded: they move inwards.
    assert (shifts[10, 20] > 0.2).all() and (shifts[49, 59] < -0.2).all()


def test_what_is_thin_has_no_line():
    kept = np.zeros(RIMMED, bool)
    kept[30, 10:70] = True
    assert np.abs(rim_shifts(kept)[30, 20:60]).max() < 1e-3
