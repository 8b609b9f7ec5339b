"""The surface's colour without fringes: against the frame that the same rig takes under white."""

import warnings

import numpy as np
import pytest
from support.textures import DECIBELS, linear_light, ripple_below_frame_db, white_frame

from pipeline import Decoder, DecodeSettings
from pipeline.simulation import SKIN, TYPICAL_CROSSTALK, WHITE, SimulationSettings, simulate_frame, simulated_rig
from tikernels import ShapeError, runtime
from tikernels.phase.texture import BRIGHTEST, measure_texture, srgb_table

SIZE = (320, 240)
WHITES = np.array(TYPICAL_CROSSTALK).sum(axis=1)


def decoded(settings, *, code=None, calibrated=True, size=SIZE):
    """Return a frame, decoded, and what the camera sees under white."""
    rig = simulated_rig(size, period_px=640 / size[0] * 768 / 44, code=code)  # 12 camera px a cycle
    frame = simulate_frame(rig, settings)
    known = rig.model_copy(update={"crosstalk_matrix": settings.crosstalk_matrix}) if calibrated else None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        result = Decoder(DecodeSettings(code=code), known, arch=runtime.started()).decode(frame.image)
    return frame, result, white_frame(rig, settings)


@pytest.mark.parametrize("code", [None, "contrast"])
@pytest.mark.parametrize("gamma", [1.0, 2.0])
def test_reflectance_times_shading_without_a_stripe(cpu, code, gamma):
    """Correlation over the lit pixels, and what is left of the fringe, harmonics 1 to 3, below the frame's own."""
    frame, result, under_white = decoded(SimulationSettings(gamma=gamma), code=code, size=(480, 360))
    texture, lit = linear_light(result.texture), result.mask & frame.mask
    for channel in range(3):
        assert np.corrcoef(texture[lit][:, channel], under_white[lit][:, channel])[0, 1] > 0.97
    assert ripple_below_frame_db(texture, under_white, frame, lit, result.period_px) < -DECIBELS


@pytest.mark.parametrize(("color", "tolerance"), [(WHITE, 0.02), (SKIN, 0.05)])
def test_with_a_calibration_a_white_surface_is_neutral(cpu, color, tolerance):
    _, result, _ = decoded(SimulationSettings(scene="plane", reflectance=color, texture=0.0))
    shown = linear_light(result.texture)[result.mask].mean(axis=0) / color
    np.testing.assert_allclose(shown / shown.mean(), 1, atol=tolerance)


def test_a_frame_without_fringes_has_no_colour(cpu):
    rig = simulated_rig(SIZE)
    with pytest.warns(match="fringe"):
        result = Decoder(arch="cpu").decode(np.full((240, 320, 3), 90, np.uint8))
    assert result.texture.shape == (240, 320, 3) and result.texture.dtype == np.uint8 and not result.texture.any()
    assert rig.pattern is not None


def test_it_is_zero_off_the_mask(cpu):
    _, result, _ = decoded(SimulationSettings(scene="objects"))
    assert not result.texture[~result.mask].any() and (~result.mask).any()
    assert result.texture[result.mask].any(axis=-1).mean() > 0.999


def test_the_table_is_srgb():
    """An 18 % grey is level 118, half the light 188."""
    table = srgb_table()
    at = np.rint(np.sqrt([0, 0.18, 0.5, 1]) * (len(table) - 1)).astype(int)
    assert table[at].tolist() == [0, 118, 188, 255]
    assert BRIGHTEST > 1


def test_arguments_are_checked(arch):
    _, result, _ = decoded(SimulationSettings(), size=(160, 120))
    light, shape = result._measured.light, result.mask.shape
    phase, mask = result.unwrapped_phase, result.mask
    out = np.empty((*shape, 3), np.uint8)
    assert measure_texture(light, phase, mask, result.period_px, out=out) is out
    np.testing.assert_array_equal(out, result.texture)
    for bad in (out[:-1], out.astype(np.float32), out[..., :2]):
        with pytest.raises(ShapeError):
            measure_texture(light, phase, mask, result.period_px, out=bad)
    with pytest.raises(ShapeError, match="phase has shape"):
        measure_texture(light, phase[1:], mask, result.period_px)
