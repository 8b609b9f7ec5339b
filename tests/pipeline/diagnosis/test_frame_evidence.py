"""What frames show of how they were taken, on light whose change is known."""

import numpy as np
import pytest

from pipeline.diagnosis.frame_evidence import KeptFrame, as_light, decoder_settings, measure_gains
from pipeline.settings import DecodeSettings

pytestmark = pytest.mark.usefixtures("cpu")


def kept(gain=(1.0, 1.0, 1.0), part=np.s_[:, :]):
    """Return a frame of fringes, brighter by a gain in a part of it."""
    rows = np.indices((120, 160))[0]
    light = 0.4 + 0.3 * np.cos(2 * np.pi * rows[..., None] / 12 + np.array([-2, 0, 2]) * np.pi / 3)
    light[part] *= gain
    light = light.astype(np.float32)
    return KeptFrame(light, light, np.zeros(rows.shape, np.float32), np.ones(rows.shape, bool), 12.0)


def test_a_gain_of_every_place_is_the_cameras():
    np.testing.assert_allclose(measure_gains(kept(), kept((1.2, 1.0, 0.9))), (1.2, 1.0, 0.9), rtol=0.01)


def test_what_becomes_brighter_in_a_part_is_an_object_that_moves():
    np.testing.assert_allclose(measure_gains(kept(), kept((1.3, 1.3, 1.3), np.s_[:, :60])), 1.0)


def test_too_little_in_common_tells_no_gain():
    dark = kept()
    assert measure_gains(kept(), KeptFrame(dark.encoded, dark.light, dark.unwrapped_phase, ~dark.mask, 12.0)) is None


def test_light_is_linear_and_of_full_scale_one():
    levels = np.full((4, 5, 3), 512, np.uint16)
    encoded, light = as_light(levels, DecodeSettings(white_level=1023))
    np.testing.assert_allclose(encoded, 512 / 1023, rtol=1e-6)
    assert light is encoded
    encoded, light = as_light(np.full((4, 5, 3), 128, np.uint8), DecodeSettings(transfer="srgb"))
    np.testing.assert_allclose(encoded, 128 / 255, rtol=1e-6)
    np.testing.assert_allclose(light, 0.2158605, atol=1e-4)  # of sRGB's 128


def test_a_decoder_of_light_has_no_thresholds_in_levels():
    settings = DecodeSettings(transfer="srgb", white_level=1023, noise=(2, 0.1), min_modulation=5, stripes="vertical")
    assert decoder_settings(settings) == DecodeSettings(stripes="vertical", transfer="linear")
