"""Causes of ripple: harmonics by which one undoes them, contrasts and phases by how well each cause fits."""

import numpy as np
import pytest

from pipeline.diagnosis.channel_spectra import (
    LINEAR,
    PHASES,
    KnownLight,
    Tiles,
    expected_light,
    fit_tiles,
    mean_spectrum,
)
from pipeline.diagnosis.ripple_causes import (
    decide,
    explain_fundamental,
    explain_harmonics,
    ideal,
    left_by_mixing,
    own_harmonics,
)
from pipeline.simulation import TYPICAL_CROSSTALK

PERIOD_PX = 12.0


MIXING = np.array([[0.9, 0.1, 0.0], [0.1, 0.75, 0.15], [0.0, 0.2, 0.8]])
#: The sum of each row is one, as the balance makes it.
TYPICAL = np.array(TYPICAL_CROSSTALK) / np.sum(TYPICAL_CROSSTALK, axis=1, keepdims=True)


def power_law(gamma):
    return np.tile(np.linspace(0, 1, 4096) ** gamma, (3, 1))


def frame(gamma=1.0, matrix=None):
    """Return light, 120x160 px, of codes with an amplitude of half, with noise, and its phase."""
    phase = 2 * np.pi * np.indices((120, 160))[0] / PERIOD_PX
    light = (0.5 + 0.5 * np.cos(phase[..., None] + PHASES)) ** gamma
    light = 0.05 + 0.8 * light @ (np.eye(3) if matrix is None else matrix).T
    return light + 2e-3 * np.random.default_rng(2).standard_normal(light.shape), phase


def tiles_of(light, phase, known=LINEAR):
    expected = expected_light(KnownLight(responses=(known,)), coded=False)
    return fit_tiles(light, phase, np.ones(phase.shape, bool), PERIOD_PX, None, expected)


@pytest.mark.parametrize("gamma", [1.5, 2.0, 2.4])
def test_a_power_law_has_the_harmonics_of_the_binomial_series(gamma):
    """((1 + cos) / 2)**gamma: c_2 / c_1 = (gamma - 1) / (gamma + 2), and c_3 / c_2 = (gamma - 2) / (gamma + 3)."""
    tiles = tiles_of(*frame(), power_law(gamma))
    harmonics = own_harmonics(tiles.expected[..., 0], tiles.weight, np.eye(3)).value[0]
    np.testing.assert_allclose(harmonics[:, 0], (gamma - 1) / (gamma + 2), atol=2e-3)
    third = (gamma - 1) / (gamma + 2) * (gamma - 2) / (gamma + 3)
    np.testing.assert_allclose(harmonics[:, 1], third, atol=2e-3)


def spectra_of(tiles):
    """Return what the channels show, (3, K), and the light that is expected, (R, 3, K)."""
    return mean_spectrum(tiles), np.moveaxis(tiles.expected, -1, 0).mean(axis=1)


def test_a_blur_takes_harmonics_by_their_squares():
    """exp(-s (k**2 - 1)) is left of the k-th over the fundamental: of the second, a fifth less here."""
    _, lights = spectra_of(tiles_of(*frame(), power_law(2.0)))
    orders = np.arange(1, lights.shape[-1] + 1)
    blurred = lights[0] * np.exp(-np.log(1.25) / 3 * (orders**2 - 1))
    assert abs(left_by_mixing(blurred, lights, PERIOD_PX)[0]).max() < 4e-3
    assert abs(left_by_mixing(lights[0] * np.where(orders > 1, 1.5, 1), lights, PERIOD_PX)[0]).max() > 0.1


def test_harmonics_that_a_crosstalk_mixes_are_left_by_none():
    """Those of a response that is not the known one are; of several, the one is found that makes them."""
    mixed, known = spectra_of(tiles_of(*frame(gamma=2.0, matrix=MIXING), power_law(2.0)))
    assert abs(left_by_mixing(mixed, known, PERIOD_PX)[0]).max() < 5e-3
    _, other = spectra_of(tiles_of(*frame(), power_law(1.2)))
    assert abs(left_by_mixing(mixed, other, PERIOD_PX)[0]).max() > 0.05
    assert left_by_mixing(mixed, np.concatenate([other, known]), PERIOD_PX)[1] == 1


def explained(gamma=1.0, transfer=False, known=LINEAR, matrix=None):
    """Explain a frame, of which no crosstalk is known."""
    light, phase = frame(gamma, matrix)
    levels = light ** (1 / 2.2) if transfer else light

    def otherwise():
        return tiles_of(levels**2.2 if transfer else levels ** (1 / 2.2), phase, known)

    return explain_harmonics(tiles_of(levels, phase, known), np.eye(3), 0.01, PERIOD_PX, "srgb", otherwise)


def contrasts(expected):
    return np.median(abs(expected), axis=0)


def test_sinusoids_need_no_explanation():
    findings, _, expected = explained()
    assert findings == []
    np.testing.assert_allclose(contrasts(expected), 1, atol=0.02)


def test_a_response_is_named_with_its_gamma():
    """It raises the contrast to 2 gamma / (gamma + 1)."""
    (finding,), _, expected = explained(gamma=2.0)
    assert finding.causes == ("response",)
    assert "R 2.0" in finding.size and finding.ripple_rad[3] > 0.1
    np.testing.assert_allclose(contrasts(expected), 4 / 3, rtol=0.02)


def test_a_response_that_is_undone_is_no_fault():
    """Nor is it where a crosstalk that is not known mixes its harmonics; another response is."""
    assert explained(gamma=2.0, known=power_law(2.0))[0] == []
    assert explained(gamma=2.0, known=power_law(2.0), matrix=MIXING)[0] == []
    (finding,), *_ = explained(gamma=2.0, known=power_law(1.2))
    assert finding.causes == ("response",)


@pytest.mark.parametrize("known_gamma", [1.0, 2.0])
def test_a_transfer_is_named_and_undone(known_gamma):
    """Whether the pattern's codes go through a response or not: a gamma of 2.2 makes 2 look linear."""
    (finding,), tiles, _ = explained(gamma=known_gamma, transfer=True, known=power_law(known_gamma))
    assert "transfer" in finding.causes
    assert "sRGB-coded" in finding.size and "transfer='srgb'" in finding.advice
    if finding.causes == ("transfer",):
        second = abs(tiles.spectrum[..., 1] / tiles.spectrum[..., 0])
        np.testing.assert_allclose(second.mean(), (known_gamma - 1) / (known_gamma + 2), atol=0.02)


def tiles_with(fundamental, frequency=0.5):
    """Return tiles of a picture, 12 x 16 of them, with these fundamentals (3,) or (T, 3) and a little noise."""
    rng = np.random.default_rng(3)
    place = np.argwhere(np.ones((12, 16)))
    count = len(place)
    noise = 1e-3 * rng.standard_normal((2, count, 3))
    spectrum = np.broadcast_to(fundamental, (count, 3)) * (1 + noise[0] + 1j * noise[1])
    mean = np.broadcast_to([0.3, 0.4, 0.5], (count, 3)) + 0.1 * rng.random((count, 1))
    across = (place[:, 0] - 5.5) / 10
    frequency = frequency * (1 + 0.2 * rng.random(count))
    none = np.empty((count, 3, 1, 0), complex)
    return Tiles(mean, spectrum[..., None], np.full(count, 1e-3), frequency, place, across, np.ones(count), none)


def causes_of(fundamental, matrix=None, lag=(0.0, 0.0, 0.0)):
    matrix = np.eye(3) if matrix is None else matrix
    tiles = tiles_with(fundamental)
    expected = np.broadcast_to(ideal(matrix, np.exp(-1j * np.array(lag))), (len(tiles.mean), 3))
    return explain_fundamental(tiles, expected, matrix, 0.005)


def test_a_rig_that_is_as_it_is_known_to_be():
    assert causes_of(0.5 * ideal(np.eye(3))) == []
    assert causes_of(0.5 * ideal(TYPICAL), TYPICAL) == []
    assert causes_of(0.5 * np.exp(1j * (PHASES - [0.1, 0, -0.1])), lag=(0.1, 0.0, -0.1)) == []


def test_one_channel_with_less_contrast():
    (finding,) = causes_of(0.5 * np.array([1, 0.8, 1]) * np.exp(1j * PHASES))
    assert "projector amplitude" in finding.causes and "G's modulation -20" in finding.size
    assert finding.ripple_rad[2] == pytest.approx(0.2 / 3 / (1 - 0.2 / 3), rel=0.1)


def test_crosstalk_changes_contrasts_and_phases_together():
    (finding,) = causes_of(0.5 * ideal(TYPICAL))
    assert finding.causes == ("crosstalk",)


def test_a_lag_that_is_the_same_everywhere_is_the_projectors():
    (finding,) = causes_of(0.5 * np.exp(1j * (PHASES + np.array([0.1, 0, 0.05]))))
    assert finding.causes == ("lateral colour of the projector",)
    assert "R +0.100 rad, B +0.050 rad from G" in finding.size


def test_what_moves_in_a_part_is_found_beside_crosstalk():
    """A lag of 0.3 rad a field in a third of the picture, which no matrix makes of a third alone."""
    place = np.argwhere(np.ones((12, 16)))
    lag = np.where(place[:, 1:] < 5, [0.3, 0, -0.3], 0.0)
    crosstalk, motion = sorted(causes_of(0.5 * ideal(TYPICAL) * np.exp(1j * lag)), key=lambda finding: finding.causes)
    assert crosstalk.causes == ("crosstalk",)
    assert motion.causes == ("motion between colour fields",) and motion.ripple_rad[2] > 0.1


def test_what_fits_as_well_as_the_best_stays_possible():
    possible, confidence = decide([1.01, 1.0, 2.0], 100.0, [0.0, 0.0, 0.0])
    assert possible == [1, 0] and confidence > 0.99
    assert decide([1.0, 1.01], 100.0, [20.0, 0.0])[0] == [1]


def test_a_black_level_weighs_most_where_it_is_dark():
    """To first order: its size is found to a fifth, though it is up to a third of the light there."""
    tiles = tiles_with(0.5 * ideal(np.eye(3)))
    light = np.geomspace(0.1, 0.6, len(tiles.mean))[:, None] * np.ones(3)
    level = np.array([0.05, 0, 0])
    spectrum = tiles.spectrum * (light / (light + level))[..., None]
    tiles = tiles._replace(mean=light + level, spectrum=spectrum)
    (finding,) = explain_fundamental(tiles, np.broadcast_to(ideal(np.eye(3)), light.shape), np.eye(3), 0.005)
    assert finding.causes == ("black level", "coloured ambient light")
    assert finding.size.endswith("of full scale added to R")
    assert float(finding.size.split()[0]) == pytest.approx(0.05, rel=0.2)


@pytest.mark.parametrize("shift_px", [0.1, 0.5])
def test_a_lens_shifts_by_pixels_and_not_by_phases(shift_px):
    """The finer the fringe, the more of a cycle; red and blue to opposite sides may have moved in between as well."""
    tiles = tiles_with(0.5 * ideal(np.eye(3)), frequency=np.linspace(0.3, 0.7, 192))
    lag = shift_px * tiles.frequency[:, None] * np.array([1, 0, -1])
    tiles = tiles._replace(spectrum=tiles.spectrum * np.exp(1j * lag)[..., None])
    (finding,) = explain_fundamental(tiles, np.broadcast_to(ideal(np.eye(3)), lag.shape), np.eye(3), 0.005)
    assert set(finding.causes) == {"lateral colour of the camera", "motion between colour fields"}
    assert f"R {-shift_px:+.2f} px, B {shift_px:+.2f} px of G" in finding.size
