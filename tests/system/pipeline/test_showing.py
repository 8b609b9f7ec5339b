"""A field as a figure: its numbers, its scale, and no window."""

import subprocess
import sys

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure

from pipeline.showing import plot_image


def ramp():
    """Return 0 to 100 with two wild values and a hole."""
    values = np.linspace(0, 100, 48 * 64, dtype=np.float32).reshape(48, 64)
    values[0, 0], values[47, 63], values[20, 30] = -1e6, 1e6, np.nan
    return values


def test_a_scale_names_the_unit_and_leaves_outliers_out():
    figure = plot_image(ramp(), "range image", "mm")
    picture, scale = figure.axes
    assert scale.get_ylabel() == "range image (mm)"
    low, high = picture.images[0].get_clim()
    assert (low, high) == pytest.approx((1, 99), abs=0.2)
    drawn = picture.images[0].get_array()
    assert drawn[10, 10] == pytest.approx(float(ramp()[10, 10]))
    assert drawn.mask[20, 30] and drawn.mask.sum() == 1
    assert picture.get_xlabel() == "x (px)"


@pytest.mark.parametrize("values", [np.eye(9, dtype=bool), np.full((9, 9, 3), 200, np.uint8)])
def test_flags_and_colours_need_no_scale(values):
    (picture,) = plot_image(values, "mask", None).axes
    np.testing.assert_array_equal(picture.images[0].get_array(), values)


def test_nothing_measured_gives_a_picture_too():
    figure = plot_image(np.full((9, 9), np.nan, np.float32), "range image", "rad")
    assert figure.axes[0].images[0].get_clim() == (0, 1)
    figure.canvas.draw()


def test_it_draws_where_it_is_told_to():
    left, right = Figure().subplots(1, 2)
    figure = plot_image(ramp(), "range image", "mm", right)
    assert figure is right.figure
    assert not left.images and len(right.images) == 1


def test_a_figure_of_its_own_shows_itself():
    """As a PNG that notebooks ask for, though nobody has told them of matplotlib."""
    image = cv2.imdecode(np.frombuffer(plot_image(ramp(), "x", "mm")._repr_png_(), np.uint8), cv2.IMREAD_COLOR)
    assert image.shape == (480, 640, 3)
    assert image.std() > 20


def test_no_window_and_no_backend():
    program = (
        "import sys, numpy\n"
        "from pipeline.showing import plot_image\n"
        "assert 'matplotlib' not in sys.modules\n"
        "plot_image(numpy.ones((4, 4)), 'x', None)\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=120)
