"""What every stage takes is linear, aligned, and has its stripes along the rows; anything else is refused in a line."""

import numpy as np
import pytest

from pipeline.decoding.frame_reader import FrameReader, size_text
from pipeline.decoding.light_model import LightModel
from pipeline.errors import CalibrationError, FootageError
from pipeline.settings import DecodeSettings
from pipeline.simulation import simulated_rig
from tikernels import ShapeError

LEVELS = np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)


def reader(geometry=None, reference=None, **options):
    settings = DecodeSettings(**options)
    return FrameReader(settings, LightModel(settings, None), geometry, reference)


def test_linear_levels_stay_as_they_are(cpu):
    frame = reader().read(LEVELS)
    np.testing.assert_array_equal(frame.image, LEVELS)
    assert (frame.white, frame.shape) == (255.0, (20, 30))


def test_vertical_stripes_are_turned(cpu):
    frame = reader(stripes="vertical").read(LEVELS)
    np.testing.assert_array_equal(frame.image, LEVELS.transpose(1, 0, 2))
    assert frame.shape == (30, 20)


def test_doubles_are_taken(cpu):
    frame = reader().read(LEVELS / 255.0)
    np.testing.assert_array_equal(frame.image, (LEVELS / 255.0).astype(np.float32))


def test_encoded_light_is_made_linear(cpu):
    frame = reader(transfer="srgb").read(np.full((20, 30, 3), 188, np.uint8))
    assert np.asarray(frame.image).mean() == pytest.approx(255 * ((188 / 255 + 0.055) / 1.055) ** 2.4, rel=1e-3)


@pytest.mark.parametrize(
    "image, error, message",
    [
        (LEVELS[..., 0], ShapeError, "image is grey"),
        (np.zeros((20, 30, 4), np.uint8), ShapeError, "four channels"),
        (LEVELS.tolist(), ShapeError, "image is a list"),
        (LEVELS[:8], ShapeError, "at least 16x16 px"),
        (LEVELS.astype(np.int64), ShapeError, "image is int64"),
        (np.full((20, 30, 3), np.nan, np.float32), FootageError, "holds NaN in 1800 values"),
        (np.full((20, 30, 3), 2, np.float32), FootageError, "1800 values outside 0..1"),
    ],
)
def test_what_is_no_frame(cpu, image, error, message):
    with pytest.raises(error, match=message):
        reader().read(image)


def test_sizes_that_contradict(cpu):
    with pytest.raises(CalibrationError, match="frame is 30x20 but the calibration is for 128x96"):
        reader(simulated_rig((128, 96)).geometry()).read(LEVELS)
    turned = (
        r"frame is 30x20 but the calibration is for 20x30 .width x height, which are swapped.: turn it as the camera"
    )
    with pytest.raises(CalibrationError, match=turned):
        reader(simulated_rig((20, 30)).geometry()).read(LEVELS)
    with pytest.raises(
        ShapeError, match=r"frame is 30x20 but the reference is 20x30 .width x height, which are swapped.$"
    ):
        reader(None, np.zeros((30, 20), np.float32)).read(LEVELS)


def test_sizes_are_width_by_height():
    assert size_text((480, 640, 3)) == "640x480"
