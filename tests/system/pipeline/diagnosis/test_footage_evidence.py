"""What frames show of how they were taken, on light whose change is known."""

import numpy as np
import pytest

from pipeline import Decoder
from pipeline.diagnosis.footage_evidence import (
    InspectedFrame,
    KeptFrame,
    as_light,
    decoder_settings,
    measure_gains,
    measure_quality,
    stands_still,
)
from pipeline.settings import DecodeSettings

pytestmark = pytest.mark.usefixtures("cpu")


def kept(gain=(1.0, 1.0, 1.0), part=np.s_[:, :], moved_rad=0.0):
    """Return a frame of fringes, brighter by a gain and moved by a phase in a part of it."""
    rows = np.indices((120, 160))[0]
    phase = np.zeros(rows.shape, np.float32)
    phase[part] = moved_rad
    light = 0.4 + 0.3 * np.cos(2 * np.pi * rows[..., None] / 12 + np.array([-2, 0, 2]) * np.pi / 3)
    light[part] *= gain
    light = light.astype(np.float32)
    return KeptFrame(light, light, phase, np.ones(rows.shape, bool), 12.0)


def test_a_gain_of_every_place_is_the_cameras():
    np.testing.assert_allclose(measure_gains(kept(), kept((1.2, 1.0, 0.9))), (1.2, 1.0, 0.9), rtol=0.01)


def test_what_becomes_brighter_in_a_part_is_an_object_that_moves():
    np.testing.assert_allclose(measure_gains(kept(), kept((1.3, 1.3, 1.3), np.s_[:, :60])), 1.0)


def test_what_moves_tells_no_exposure():
    """By whole cycles nothing has moved: the orders of two frames need not agree."""
    assert stands_still(kept(), kept(moved_rad=0.1)) and stands_still(kept(), kept(moved_rad=2 * np.pi))
    assert stands_still(kept(), kept(part=np.s_[:, :60], moved_rad=1.0))  # most of it stands
    assert not stands_still(kept(), kept(part=np.s_[:, :100], moved_rad=1.0))


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_what_is_lit_without_a_fringe_is_counted(share):
    """As motion blurs it away in a part of the picture; what is dark is not counted."""
    rows = np.indices((240, 320))[0]
    light = 0.4 + 0.3 * np.cos(2 * np.pi * rows[..., None] / 12 + np.array([-2, 0, 2]) * np.pi / 3)
    light[:, : int(share * 256)] = 0.4
    light[:, 256:] = 0.05
    light += 0.004 * np.random.default_rng(4).standard_normal(light.shape)
    settings = DecodeSettings(transfer="linear")
    light = light.astype(np.float32)
    frame = Decoder(settings, arch="cpu").decode(light)
    quality = measure_quality(InspectedFrame(0, light, light, frame, settings), frame, 8)
    assert quality.faint == pytest.approx(share, abs=0.02)


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
