"""The figure of what a radiometry measured."""

import cv2
import numpy as np
import pytest

from pipeline.calibration.radiometry import measure_radiometry, plot_radiometry, radiometry_codes, radiometry_sequence
from pipeline.errors import OutputError
from pipeline.simulation import TYPICAL_CROSSTALK


@pytest.fixture(scope="module")
def radiometry():
    names = radiometry_sequence((1024, 768)).names
    light = {name: np.array(TYPICAL_CROSSTALK) @ radiometry_codes(name) ** 2 for name in names}
    noise = np.random.default_rng(0)
    return measure_radiometry(
        {
            name: np.clip(np.rint(200 * np.tile(seen, (40, 50, 1)) + noise.normal(10, 1, (40, 50, 3))), 0, 255).astype(
                np.uint8
            )
            for name, seen in light.items()
        }
    )


def test_four_panels_of_lines_in_the_channels_colours(radiometry, tmp_path):
    plot_radiometry(radiometry, tmp_path / "plot.png")
    picture = cv2.imread(str(tmp_path / "plot.png")).astype(int)
    height, width = picture.shape[:2]
    assert height > 200 and width > 3 * height
    for panel in np.array_split(picture, 4, axis=1)[:3]:  # in the last one three equal responses lie on each other
        for channel in range(3):
            others = [k for k in range(3) if k != channel]
            assert (panel[..., channel] - panel[..., others].max(axis=-1) > 100).any()


def test_a_place_that_cannot_be_written(radiometry, tmp_path):
    with pytest.raises(OutputError, match="create the folder first"):
        plot_radiometry(radiometry, tmp_path / "none" / "plot.png")
