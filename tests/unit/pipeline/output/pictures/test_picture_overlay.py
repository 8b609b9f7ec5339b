"""What is written into a picture."""

import numpy as np
import pytest

from pipeline.output.pictures.picture_overlay import INK, ColorScale, PictureOverlay, round_length

SCALE = ColorScale(700, 800, "depth", "mm")


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
