"""What is known of the light: settings win over the calibration, and that over what a frame tells."""

import numpy as np
import pytest

from pipeline.contrast_code import ContrastCode
from pipeline.decoding.light_model import LightModel
from pipeline.decoding.self_calibration import LightEstimate
from pipeline.errors import DecodeWarning, SettingsError
from pipeline.models import CameraState
from pipeline.settings import DecodeSettings
from pipeline.simulation import TYPICAL_CROSSTALK, simulated_rig

MATRIX = np.array(TYPICAL_CROSSTALK)
NORMAL = MATRIX / MATRIX.sum(axis=1, keepdims=True)
UNIFORM = np.ones((36, 256))
TOLD = LightEstimate(
    crosstalk_matrix=NORMAL,
    crosstalk_sigma=np.full((3, 3), 0.01),
    response=np.linspace(0, 1, 256),
    correction=np.full(257, 0.1, np.float32),
    constant_sigma=0.01,
    constant_known=True,
    cycles=20.0,
    ripple=0.1,
    misfit=0.01,
    reliable=True,
)


def rig(**values):
    return simulated_rig((64, 48)).model_copy(update=values)


def test_settings_win_over_the_calibration():
    path = LightModel(DecodeSettings(crosstalk_matrix=np.eye(3)), rig(crosstalk_matrix=MATRIX))
    np.testing.assert_allclose(path.crosstalk.matrix, np.eye(3), atol=1e-6)
    path = LightModel(DecodeSettings(), rig(crosstalk_matrix=MATRIX))
    np.testing.assert_allclose(path.crosstalk.matrix, NORMAL, atol=1e-6)


def test_nothing_known_asks_one_frame():
    path = LightModel(DecodeSettings(), None)
    assert path.unknown
    assert not path.constant_known
    path.learn(TOLD)
    assert not path.unknown
    assert path.constant_known
    assert path.constant_sigma == 0.01
    np.testing.assert_allclose(path.crosstalk.matrix, NORMAL, atol=1e-6)
    np.testing.assert_array_equal(path.cycle(UNIFORM, 12.0)[0], TOLD.correction)


@pytest.mark.parametrize("light", [None, TOLD.model_copy(update={"reliable": False})])
def test_what_a_frame_could_not_tell_is_not_asked_again(light):
    path = LightModel(DecodeSettings(), None)
    path.learn(light)
    assert not path.unknown
    assert not path.constant_known
    np.testing.assert_allclose(path.crosstalk.matrix, np.eye(3), atol=1e-6)


def test_narrow_bands_ask_no_frame():
    """How bright the camera's channels are to each other matters there, which no frame tells."""
    assert not LightModel(DecodeSettings(reflectance_bands="narrow"), None).unknown


def test_uniform_phases_need_no_correction():
    path = LightModel(DecodeSettings(crosstalk_matrix=np.eye(3)), None)
    assert np.abs(path.cycle(UNIFORM, 12.0)[0]).max() < 1e-3
    off = LightModel(DecodeSettings(crosstalk_matrix=np.eye(3), equalize=False), None)
    assert not off.cycle(UNIFORM + np.arange(256), 12.0)[0].any()


@pytest.mark.parametrize(
    ("setting", "pattern", "code", "unknown"),
    [
        (None, None, "contrast", True),
        (None, "contrast", "contrast", False),
        ("contrast", None, "contrast", False),
        ("none", None, None, False),
        ("none", "contrast", None, False),
    ],
)
def test_the_code_is_the_settings_or_the_patterns(setting, pattern, code, unknown):
    path = LightModel(DecodeSettings(code=setting), simulated_rig((64, 48), code=pattern))
    assert (path.code and path.code.name, path.code_unknown) == (code, unknown)


@pytest.mark.parametrize(
    "known", [{}, {"crosstalk_matrix": MATRIX, "response": np.linspace(0, 1, 256)[None] ** [[2]] * 3}]
)
def test_what_a_frame_shows_of_a_code_is_as_if_it_were_stated(known):
    """Whether the light is learnt before or after."""
    plain, coded = (LightModel(DecodeSettings(code=code), rig(**known)) for code in ("none", "contrast"))
    assert plain.contrast_doubt < coded.contrast_doubt
    for code, stated in ((None, plain), (ContrastCode.named("contrast"), coded)):
        seen = LightModel(DecodeSettings(), rig(**known))
        seen.use_code(code)
        assert seen.code == stated.code and not seen.code_unknown
        assert seen.contrast_doubt == stated.contrast_doubt
        for got, expected in zip(seen.cycle(UNIFORM, 12.0), stated.cycle(UNIFORM, 12.0), strict=True):
            np.testing.assert_array_equal(got, expected)
    late = LightModel(DecodeSettings(), None)
    late.learn(TOLD)
    late.use_code(None)
    np.testing.assert_allclose(late.crosstalk.matrix, NORMAL, atol=1e-6)
    assert late.light_known and not late.unknown


def test_a_camera_that_stands_otherwise():
    before = rig(capture=CameraState(gain=2.0))
    with pytest.warns(DecodeWarning, match=r"gain is 3\.0 but was 2\.0 at calibration"):
        LightModel(DecodeSettings(capture=CameraState(gain=3.0)), before)
    with pytest.raises(SettingsError, match="set stripes to 'horizontal'"):
        LightModel(DecodeSettings(stripes="vertical"), before)
