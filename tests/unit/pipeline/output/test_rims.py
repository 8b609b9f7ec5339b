"""The line in which a surface ends."""

import numpy as np
import pytest

from pipeline.output.range_surface import rim_shifts

SHAPE = (60, 80)


def half_plane(slant):
    """Return what lies below a line that falls by `slant` px a column, and how far above the line each pixel is, px."""
    y, x = np.indices(SHAPE)
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
    assert not rim_shifts(np.ones(SHAPE, bool)).any()


def test_only_rims_move():
    kept = np.zeros(SHAPE, bool)
    kept[10:50, 20:60] = True
    shifts = rim_shifts(kept)
    assert not shifts[12:48, 22:58].any() and not shifts[~kept].any()
    # Corners are rounded: they move inwards.
    assert (shifts[10, 20] > 0.2).all() and (shifts[49, 59] < -0.2).all()


def test_what_is_thin_has_no_line():
    kept = np.zeros(SHAPE, bool)
    kept[30, 10:70] = True
    assert np.abs(rim_shifts(kept)[30, 20:60]).max() < 1e-3
