"""Colours that many places have in common."""

import numpy as np
import pytest

from tikernels.phase.surface_colors import color_ratios, common_colors, nearest_colors

PAINTS = np.array([[0.8, 0.8, 0.8], [0.8, 0.35, 0.1], [0.6, 0.42, 0.33]])


def places(counts: list[int], spread: float = 0.01) -> np.ndarray:
    rng = np.random.default_rng(1)
    light = np.concatenate([np.tile(paint, (n, 1)) for paint, n in zip(PAINTS, counts, strict=True)])
    brightness = rng.uniform(0.2, 1, (len(light), 1))
    return color_ratios(light * brightness * np.exp(spread * rng.standard_normal(light.shape)))


def test_a_ratio_has_no_brightness():
    np.testing.assert_allclose(color_ratios([0.2, 0.4, 0.1]), color_ratios([2.0, 4.0, 1.0]))
    np.testing.assert_allclose(color_ratios([[0.3, 0.3, 0.3]]), 0, atol=1e-12)
    assert np.isfinite(color_ratios([0.0, 1.0, 1.0])).all()


def test_colours_are_found_the_commonest_first():
    ratios = places([300, 2000, 700])
    found = common_colors(ratios, np.ones(len(ratios)), 100)
    np.testing.assert_allclose(found, color_ratios(PAINTS[[1, 2, 0]]), atol=0.01)
    assert (np.bincount(nearest_colors(ratios, found)) == [2000, 700, 300]).all()


@pytest.mark.parametrize(("least", "count"), [(30, 3), (80, 2), (5000, 1)])
def test_rare_colours_are_given_to_their_neighbours(least, count):
    ratios = places([500, 60, 300])
    assert len(common_colors(ratios, np.ones(len(ratios)), least)) == count


def test_places_between_two_colours_count_less_where_they_are_given_less_weight():
    ratios = places([520, 0, 480])
    between = np.linspace(ratios[0], ratios[-1], 200)
    together = np.concatenate([ratios, between])
    weights = np.concatenate([np.ones(len(ratios)), np.full(len(between), 1e-3)])
    np.testing.assert_allclose(common_colors(together, weights, 50), color_ratios(PAINTS[[0, 2]]), atol=0.02)
