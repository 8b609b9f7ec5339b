"""Light that a rig's channels are expected to show, against the pattern as it is projected."""

import numpy as np
import pytest

from pipeline.calibration import Calibration, ColorShift, Pattern
from pipeline.diagnosis.channel_spectra import LINEAR, PHASES, ExpectedLight, KnownLight
from pipeline.pattern import make_pattern
from pipeline.settings import DecodeSettings
from pipeline.simulation import TYPICAL_CROSSTALK, simulated_rig

MIXING = np.array(TYPICAL_CROSSTALK)
SQUARE = np.tile(np.linspace(0, 1, 256) ** 2, (3, 1))


@pytest.mark.parametrize("code", [None, "contrast"])
def test_it_is_the_pattern_through_response_and_crosstalk(code):
    """At the phase of every projector row, to the 0.2 % by which two samples differ from a line."""
    pattern = Pattern(period_px=16.0, code=code)
    codes = make_pattern((4, 768), pattern)[:, 0].astype(np.float64)
    known = KnownLight(MIXING, (SQUARE, LINEAR), None, code)
    seen = ExpectedLight(known, coded=code is not None).at(2 * np.pi * np.arange(768) / 16.0)
    parts = MIXING / MIXING.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(seen[..., 0], codes**2 @ parts.T, atol=2e-3)
    np.testing.assert_allclose(seen[..., 1], codes @ parts.T, atol=2e-3)


def test_a_lag_delays_its_channel():
    lag = np.array([0.2, 0.0, -0.1])
    phase = np.linspace(0, 40, 200)
    seen = ExpectedLight(KnownLight(lag_rad=lag), coded=False).at(phase)[..., 0]
    np.testing.assert_allclose(seen, 0.5 + 0.5 * np.cos(phase[:, None] + PHASES - lag), atol=1e-3)


@pytest.mark.parametrize(
    "compensated, expected", [(True, [LINEAR]), (False, [SQUARE]), (None, [SQUARE, LINEAR])], ids=str
)
def test_a_response_counts_unless_the_pattern_has_undone_it(compensated, expected):
    rig = simulated_rig(code="contrast")
    pattern = rig.geometry().pattern.model_copy(update={"compensated": compensated})
    shift = ColorShift(camera=np.zeros((3, 2)), projector=np.array([[0, 1.0], [0, 0], [0, -1.0]]))
    light = {"crosstalk_matrix": MIXING, "response": SQUARE, "pattern": pattern, "color_shift_px": shift}
    known = KnownLight.of(DecodeSettings(), rig.model_copy(update=light))
    assert len(known.responses) == len(expected)
    for one, other in zip(known.responses, expected, strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_allclose(known.lag_rad, 2 * np.pi / pattern.period_px * np.array([1.0, 0.0, -1.0]))
    assert known.code == "contrast"


def test_settings_overrule():
    known = KnownLight.of(
        DecodeSettings(crosstalk_matrix=np.eye(3), code="contrast"), Calibration(crosstalk_matrix=MIXING)
    )
    np.testing.assert_array_equal(known.matrix, np.eye(3))
    assert known.code == "contrast" and known.lag_rad is None
