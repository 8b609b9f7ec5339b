"""Letters in pictures: where they are, and that they fit."""

import numpy as np
import pytest

from pipeline.output.pictures.picture_overlay import INK, darken, text_size, write_text


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
