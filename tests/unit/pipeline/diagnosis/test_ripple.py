"""Bands across a picture's rows, on light whose colours are known."""

import numpy as np
import pytest

from pipeline.diagnosis.ripple import BANDS, find_bands


def fringes(color=1.0, period_px=12.0):
    """Return light, (240, 320, 3), of horizontal stripes times a colour, and where it is lit."""
    rows = np.indices((240, 320))[0]
    light = 0.4 + 0.35 * np.cos(2 * np.pi * rows[..., None] / period_px + np.array([-2, 0, 2]) * np.pi / 3)
    light = light * color + 0.005 * np.random.default_rng(5).standard_normal(light.shape)
    return light, np.ones(rows.shape, bool)


def banded(step, part=np.s_[:]):
    """Return a colour (240, 320, 3) whose red is brighter by a part in every other 30 rows, over a part of them."""
    color = np.ones((240, 320, 3))
    color[np.arange(240) // 30 % 2 == 1, part, 0] += step
    return color


@pytest.mark.parametrize("step", [0.1, 0.3])
def test_rows_that_are_balanced_otherwise_all_along_are_bands(step):
    finding = find_bands(*fringes(banded(step)), 12.0)
    assert finding is not None and finding.causes == BANDS
    said = float(finding.size.split()[-2])
    assert 0.5 < said / (100 * step) <= 1.05  # means over three cycles take something off


@pytest.mark.parametrize("period_px", [10.5, 12.0, 13.8])
def test_a_fringe_is_no_band_though_its_period_is_not_quite_known(period_px):
    assert find_bands(*fringes(period_px=period_px), 12.0) is None


def test_a_surface_that_is_painted_in_a_part_is_not_banded():
    """Stripes over a third of the picture, as on a shirt before a wall."""
    assert find_bands(*fringes(banded(0.3, np.s_[:107])), 12.0) is None


def test_what_is_too_small_tells_nothing():
    light, mask = fringes(banded(0.3))
    assert find_bands(light[:50], mask[:50], 12.0) is None
    assert find_bands(light, mask & (np.indices(mask.shape)[1] < 60), 12.0) is None
