"""Colour scales: limits, round ticks, and the bar."""

import numpy as np
import pytest

from pipeline.output.pictures.picture_overlay import ColorScale, color_bar_width, draw_color_bar, round_step


@pytest.mark.parametrize(
    ("low", "high", "texts"),
    [
        (0.0, 1.0, ["0.0", "0.2", "0.4", "0.6", "0.8", "1.0"]),
        (752.0, 871.0, ["760", "780", "800", "820", "840", "860"]),
        (-0.013, 0.013, ["-0.010", "-0.005", "0.000", "0.005", "0.010"]),
    ],
)
def test_ticks_are_round(low, high, texts):
    assert [text for _, text in ColorScale(low, high, "depth", "mm").ticks()] == texts


def test_deviations_have_a_sign_and_zero_in_the_middle():
    scale = ColorScale.over(np.linspace(-0.1, 0.9, 1001), "deviation", "mm", diverging=True)
    assert scale.low == -scale.high == pytest.approx(-0.89, abs=0.001)
    assert [text for _, text in scale.ticks()] == ["-0.5", "0.0", "+0.5"]
    below, zero, above = scale.colors(np.array([-0.9, 0.0, 0.9])).astype(int)
    assert below[2] > below[0] + 100 and above[0] > above[2] + 100 and np.ptp(zero) < 5


def test_outliers_and_a_constant():
    values = np.append(np.linspace(0, 1, 999), [1e9, np.nan])
    assert ColorScale.over(values, "depth", "mm").high < 1.0
    constant = ColorScale.over(np.full(5, 7.0), "depth", "mm")
    assert constant.high > constant.low == 7.0
    nothing = ColorScale.over(np.array([np.nan]), "depth", "mm")
    assert (nothing.low, nothing.high) == (0.0, 1.0)


def test_what_is_far_outside_is_grey_only_if_asked():
    values = np.array([0.0, 1.0, 1.05, 1.5])
    grey = ColorScale(0, 1, "depth", "mm", grey_beyond=True).colors(values)
    plain = ColorScale(0, 1, "depth", "mm").colors(values)
    np.testing.assert_array_equal(grey[:3], plain[:3])
    assert np.ptp(grey[3]) == 0 and np.ptp(plain[3]) > 100


def test_a_bar_has_the_scales_colours_and_keeps_to_its_width():
    scale = ColorScale(0, 1, "depth", "mm")
    image = np.zeros((400, 300, 3), np.uint8)
    draw_color_bar(image, scale, (20, 10), 380)
    drawn = np.flatnonzero(image.any(axis=(0, 2)))
    assert drawn[0] >= 20 and drawn[-1] <= 20 + color_bar_width(scale, 380)
    column = image[:, 25].astype(int)
    rows = np.flatnonzero(column.any(axis=1))
    assert column[rows[60], 0] > column[rows[60], 2] and column[rows[-5], 2] > column[rows[-5], 0]


@pytest.mark.parametrize(("step", "expected"), [(1.0, 1.0), (1.01, 2.0), (2.1, 5.0), (0.0051, 0.01)])
def test_round_steps(step, expected):
    assert round_step(step) == pytest.approx(expected)
