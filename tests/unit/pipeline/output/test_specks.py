"""What of linked pixels is a surface."""

import numpy as np
import pytest
from support.linked_pixels import all_linked

from pipeline.output.range_surface import find_surfaces, links_within
from tikernels.depth.step_cutting import DOWN, RIGHT


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
