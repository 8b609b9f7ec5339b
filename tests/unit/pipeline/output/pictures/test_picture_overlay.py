"""Letters, colour bars and scale bars in pictures."""

import numpy as np
import pytest

from pipeline.output.pictures.picture_overlay import (
    INK,
    ColorScale,
    PictureOverlay,
    color_bar_width,
    darken,
    draw_color_bar,
    round_length,
    round_step,
    text_size,
    write_text,
)

SCALE = ColorScale(700, 800, "depth", "mm")


@pytest.mark.parametrize("size", [11.0, 30.0])
def test_letters_lie_in_their_box(size):
    image = np.zeros((80, 300, 3), np.uint8)
    write_text(image, "frame 12, +0.05 mm", (10, 40), size)
    width, height = text_size("frame 12, +0.05 mm", size)
    rows, columns = np.nonzero(image.any(axis=-1))
    assert 10 <= columns.min() and columns.max() <= 10 + width
    assert 40 - height / 2 - 1 <= rows.min() and rows.max() <= 40 + height / 2 + 1
    assert image.max(axis=(0, 1)).tolist() == list(INK)
    assert len(np.unique(image[..., 0])) > 10, "their edges are smooth"


def test_texts_of_one_size_share_a_baseline():
    bottoms = []
    for text in ("m", "H", "0"):
        image = np.zeros((60, 60, 3), np.uint8)
        write_text(image, text, (5, 30), 30.0)
        bottoms.append(int(np.nonzero((image > 120).any(axis=(1, 2)))[0].max()))
    assert np.ptp(bottoms) <= 1


def test_what_lies_outside_is_left_out():
    image = np.zeros((20, 40, 3), np.uint8)
    write_text(image, "outside", (-30, 2), 14.0)
    write_text(image, "outside", (35, 30), 14.0)
    write_text(image, "outside", (400, 10), 14.0)
    assert image[:10, :20].any()


def test_a_panel_darkens_what_is_below():
    image = np.full((20, 40, 3), 200, np.uint8)
    darken(image, -5, 10, 20, 50)
    assert (image[:10] == 200).all() and (image[10:, 20:] == 200).all()
    assert 60 < image[15, 5, 0] < 120


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


def ground(size):
    return np.full((size[1], size[0], 3), 60, np.uint8)


@pytest.mark.parametrize("size", [(1280, 960), (400, 300)])
@pytest.mark.parametrize("px_per_mm", [3.7, 0.02])
def test_the_scale_bar_has_a_round_length(size, px_per_mm):
    image = ground(size)
    PictureOverlay(size, None).draw(image, px_per_mm)
    (rows, columns) = np.nonzero((image == INK).all(axis=-1))
    line = columns[rows == np.bincount(rows).argmax()]
    length_mm = (np.ptp(line) + 1) / px_per_mm
    step = 10 ** np.floor(np.log10(length_mm * 1.02))
    assert min(abs(length_mm - factor * step) for factor in (1, 2, 5)) < 1.5 / px_per_mm
    assert 0.08 * size[0] < np.ptp(line) < 0.23 * size[0]


def test_an_object_inside_the_margins_is_not_written_over():
    size = (1280, 960)
    overlay = PictureOverlay(size, SCALE)
    image = ground(size)
    overlay.draw(image, 2.0)
    left, top, right, bottom = overlay.margins_px()
    rows, columns = np.nonzero((image != 60).any(axis=-1))
    inside = (rows >= top) & (rows < 960 - bottom) & (columns >= left) & (columns < 1280 - right)
    assert not inside.any()
    assert 0.2 * 1280 > right > PictureOverlay(size, None).margins_px()[2]


def test_without_mm_there_is_no_scale_bar_and_small_pictures_stay_clear():
    image = ground((640, 480))
    PictureOverlay((640, 480), None).draw(image, None)
    assert (image == 60).all()
    small = ground((160, 120))
    PictureOverlay((160, 120), SCALE).draw(small, 1.0, "frame 3")
    assert (small == 60).all()


def test_the_label_is_in_the_upper_left_corner():
    image = ground((640, 480))
    PictureOverlay((640, 480), None).draw(image, None, "frame 12")
    rows, columns = np.nonzero((image != 60).any(axis=-1))
    assert rows.max() < 60 and columns.max() < 150 and (image == INK).all(axis=-1).any()


@pytest.mark.parametrize(("most", "length"), [(73.0, 50.0), (50.0, 50.0), (0.19, 0.1), (2.0, 2.0), (1999.0, 1000.0)])
def test_round_lengths(most, length):
    assert round_length(most) == pytest.approx(length)
