"""Spectra of channels whose waves are known, and the light that a rig's channels are expected to show."""

import numpy as np
import pytest

from pipeline.calibration import Calibration, ColorShift, Pattern
from pipeline.contrast_code import CYCLES
from pipeline.diagnosis.channel_spectra import (
    LINEAR,
    PHASES,
    KnownLight,
    expected_light,
    fit_tiles,
    mean_spectrum,
    neighbours_median,
    ripple_by_harmonic,
    robust_fit,
    seen_ripple,
    smooth_phase,
    waves_of_spectrum,
)
from pipeline.pattern import make_pattern
from pipeline.settings import DecodeSettings
from pipeline.simulation import TYPICAL_CROSSTALK, simulated_rig

MIXING = np.array(TYPICAL_CROSSTALK)
SQUARE = np.tile(np.linspace(0, 1, 256) ** 2, (3, 1))
PERIOD_PX = 12.0


@pytest.mark.parametrize("code", [None, "contrast"])
def test_it_is_the_pattern_through_response_and_crosstalk(code):
    """At the phase of every projector row, to the 0.2 % by which two samples differ from a line."""
    pattern = Pattern(period_px=16.0, code=code)
    codes = make_pattern((4, 768), pattern)[:, 0].astype(np.float64)
    known = KnownLight(MIXING, (SQUARE, LINEAR), None, code)
    seen = expected_light(known, coded=code is not None)(2 * np.pi * np.arange(768) / 16.0)
    parts = MIXING / MIXING.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(seen[..., 0], codes**2 @ parts.T, atol=2e-3)
    np.testing.assert_allclose(seen[..., 1], codes @ parts.T, atol=2e-3)


def test_of_many_cells_it_is_the_mean():
    codes = make_pattern((120, 16 * CYCLES), Pattern(period_px=16, code="contrast2", cell_px=8))
    known = KnownLight(code="contrast2")
    seen = expected_light(known, coded=True)(2 * np.pi * np.arange(16) / 16.0)[..., 0]
    np.testing.assert_allclose(seen, codes.reshape(CYCLES, 16, 120, 3).mean(axis=(0, 2)), atol=2e-3)


def test_a_lag_delays_its_channel():
    lag = np.array([0.2, 0.0, -0.1])
    phase = np.linspace(0, 40, 200)
    seen = expected_light(KnownLight(lag_rad=lag), coded=False)(phase)[..., 0]
    np.testing.assert_allclose(seen, 0.5 + 0.5 * np.cos(phase[:, None] + PHASES - lag), atol=1e-3)


@pytest.mark.parametrize(
    "compensated, expected", [(True, [LINEAR]), (False, [SQUARE]), (None, [SQUARE, LINEAR])], ids=str
)
def test_a_response_counts_unless_the_pattern_has_undone_it(compensated, expected):
    rig = simulated_rig(code="contrast")
    pattern = rig.geometry().pattern.model_copy(update={"compensated": compensated})
    shift = ColorShift(camera=np.zeros((3, 2)), projector=np.array([[0, 1.0], [0, 0], [0, -1.0]]))
    light = {"crosstalk_matrix": MIXING, "response": SQUARE, "pattern": pattern, "color_shift_px": shift}
    known = KnownLight.of(DecodeSettings(), rig.model_copy(update=light), "contrast")
    assert len(known.responses) == len(expected)
    for one, other in zip(known.responses, expected, strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_allclose(known.lag_rad, 2 * np.pi / pattern.period_px * np.array([1.0, 0.0, -1.0]))
    assert known.code == "contrast"


def test_settings_overrule():
    known = KnownLight.of(DecodeSettings(crosstalk_matrix=np.eye(3)), Calibration(crosstalk_matrix=MIXING), "contrast")
    np.testing.assert_array_equal(known.matrix, np.eye(3))
    assert known.code == "contrast" and known.lag_rad is None


def fringes(second=0.0, noise=0.0, shape=(120, 160)):
    """Return channels with a second harmonic, and their phase; the mean falls from the left to the right."""
    rows, columns = np.indices(shape)
    phase = 2 * np.pi * rows / PERIOD_PX + 0.01 * columns
    wave = np.cos(phase[..., None] + PHASES) + second * np.cos(2 * (phase[..., None] + PHASES))
    light = (0.6 - 0.001 * columns[..., None]) * (1 + 0.5 * wave)
    light += noise * np.random.default_rng(0).standard_normal(light.shape)
    return light, phase


def test_a_tile_tells_mean_contrast_and_harmonics():
    light, phase = fringes(second=0.1)
    tiles = fit_tiles(light, phase, np.ones(phase.shape, bool), PERIOD_PX)
    spectrum = mean_spectrum(tiles)
    np.testing.assert_allclose(np.abs(spectrum[:, 0]), 0.5, atol=2e-3)
    np.testing.assert_allclose(np.abs(spectrum[:, 1]), 0.05, atol=1e-3)
    np.testing.assert_allclose(np.angle(spectrum[:, 0] * np.exp(-1j * PHASES)), 0, atol=1e-3)
    np.testing.assert_allclose(tiles.frequency, np.hypot(2 * np.pi / PERIOD_PX, 0.01), rtol=1e-3)


def test_what_no_wave_explains_is_noise():
    light, phase = fringes(noise=1e-3)
    tiles = fit_tiles(light, phase, np.ones(phase.shape, bool), PERIOD_PX)
    np.testing.assert_allclose(tiles.noise, 1e-3, rtol=0.1)


def test_too_little_of_a_picture_has_no_tiles():
    light, phase = fringes(shape=(20, 20))
    assert len(fit_tiles(light, phase, np.ones(phase.shape, bool), PERIOD_PX).mean) == 0


@pytest.mark.parametrize("second", [0.02, 0.1])
def test_a_second_harmonic_ripples_three_times_a_cycle(second):
    """By its part of the first, to the third order: the phase error of three steps is -c_2 sin(3 phi)."""
    waves = waves_of_spectrum(0.5 * np.stack([np.exp(1j * PHASES), second * np.exp(2j * PHASES)], axis=1))
    ripple = ripple_by_harmonic(waves, np.eye(3))
    assert ripple[3] == pytest.approx(second, rel=0.02)
    assert max(ripple[1], ripple[2]) < 1e-9
    assert ripple[6] == pytest.approx(second**2 / 2, rel=0.05)


def test_a_channel_with_less_contrast_ripples_twice_a_cycle():
    """By a third of what it lacks, where the other two agree."""
    contrast = np.array([1.0, 0.9, 1.0])
    ripple = ripple_by_harmonic(waves_of_spectrum((0.5 * contrast * np.exp(1j * PHASES))[:, None]), np.eye(3))
    assert ripple[2] == pytest.approx(0.1 / 3, rel=0.05)
    assert ripple[3] < 1e-3


def test_smoothing_leaves_the_surface_and_no_ripple():
    _, phase = fringes()
    bent = phase + 0.3 * np.sin(np.indices(phase.shape)[1] / 40)
    rippled = (bent + 0.1 * np.sin(3 * bent)).astype(np.float32)
    smooth, valid, period = smooth_phase(rippled, np.ones(phase.shape, bool))
    assert period == pytest.approx(PERIOD_PX, rel=0.02)
    inside = np.s_[20:-20, 20:-20]
    assert valid[inside].all()
    # What smoothing takes from the surface itself is slow: a sine of 251 px loses 2 % of its 0.3 rad.
    assert np.abs(smooth - bent)[inside].max() < 0.02
    seen = seen_ripple(rippled, smooth, valid)
    assert seen[3] == pytest.approx(0.1, rel=0.05)
    assert max(seen[1], seen[2], seen[6]) < 5e-3


def test_a_step_is_no_ripple():
    _, phase = fringes()
    stepped = np.where(np.indices(phase.shape)[1] > 80, phase + 3, phase).astype(np.float32)
    _, valid, _ = smooth_phase(stepped, np.ones(phase.shape, bool))
    assert not valid[:, 79:82].any() and valid[30:-30, 30:60].all()


def test_outliers_do_not_move_a_fit():
    values = np.full(100, 2.0) + 0.01 * np.random.default_rng(1).standard_normal(100)
    values[:10] = 50.0
    fit = robust_fit(values[:, None], np.ones(100))
    assert fit.value[0, 0] == pytest.approx(2.0, abs=0.01)
    assert 0 < fit.error[0, 0] < 0.01
    turned = robust_fit((values * np.exp(0.5j))[:, None], np.ones(100))
    assert np.angle(turned.value[0, 0]) == pytest.approx(0.5, abs=0.01)


def test_a_median_is_of_a_tile_and_its_neighbours():
    place = np.array([[0, 0], [0, 1], [0, 2], [5, 5]])
    np.testing.assert_array_equal(neighbours_median(np.array([1.0, 2.0, 9.0, 4.0]), place), [1.5, 2.0, 5.5, 4.0])
