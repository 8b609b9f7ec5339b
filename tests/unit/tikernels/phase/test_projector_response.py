"""A known response of the projector: what it does to the phase, and that its table undoes it."""

import numpy as np
import pytest
import reference

from tikernels.phase.equalization import measure_correction
from tikernels.phase.projector_response import ResponsePrior, blurred, light_spectrum, response_map, response_table


def gamma(exponent: float) -> np.ndarray:
    return np.tile(np.linspace(0, 1, 4096) ** exponent, (3, 1))


def counted(exponent: float, blur: float, cycles: float = 40.0) -> np.ndarray:
    """Return (36, 256) int: how often 36 parts of a picture show each phase, for a response and a blur."""
    phase, bare = response_map(blurred(light_spectrum(gamma(exponent)), blur))
    rng = np.random.default_rng(5)
    tiles = []
    for tile in range(36):
        true = rng.uniform(0, 2 * np.pi * cycles / 6, 4000) + tile
        seen = reference.wrapped_difference(np.interp(reference.wrapped_difference(true, 0), phase, bare), 0)
        tiles.append(np.histogram(seen, 256, (-np.pi, np.pi))[0])
    return np.stack(tiles)


def test_a_linear_response_does_nothing():
    phase, bare = response_map(light_spectrum(gamma(1.0)))
    np.testing.assert_allclose(bare, phase, atol=1e-6)
    assert np.abs(response_table(light_spectrum(gamma(1.0)))).max() < 1e-6


def test_gamma_two_is_the_third_harmonic():
    """cos^4 of half the phase has a second harmonic of a quarter of its first: atan2 bends by asin(1/4) at the most."""
    phase, bare = response_map(light_spectrum(gamma(2.0)))
    error = bare - phase
    assert np.abs(error).max() == pytest.approx(np.arcsin(1 / 4), rel=1e-3)
    spectrum = np.abs(np.fft.rfft(error[:-1])) / len(error)
    assert spectrum[3] > 10 * spectrum[[1, 2, 4, 5]].max()
    np.testing.assert_allclose(bare[-1] - bare[0], 2 * np.pi)


@pytest.mark.parametrize("lag", [None, np.array([0.1, 0.0, -0.1])])
def test_the_table_undoes_the_map(lag):
    """The true phase comes back from what the camera sees, to 2e-3 rad: what 256 straight lines leave of the map."""
    spectrum = light_spectrum(gamma(2.2), lag)
    phase, bare = response_map(spectrum, lag)
    table = response_table(spectrum, lag)
    edges = np.linspace(-np.pi, np.pi, len(table))
    wrapped = reference.wrapped_difference(bare, 0)
    back = wrapped + np.interp(wrapped, edges, table)
    assert np.abs(reference.wrapped_difference(back, phase)).max() < 2e-3


def test_the_mean_light_of_a_pattern():
    """The mean of (1 + cos)^2 / 4 is 3/8; at half the contrast, of (1 + cos / 2)^2 / (3 / 2)^2, 1/2."""
    np.testing.assert_allclose(light_spectrum(gamma(1.0))[:, 0], 0.5, atol=1e-4)
    np.testing.assert_allclose(ResponsePrior(gamma(2.0), None).light, 3 / 8, atol=1e-4)
    np.testing.assert_allclose(ResponsePrior(gamma(2.0), None, contrast=0.5).light, 1 / 2, atol=1e-4)


def test_blur_is_a_gaussian():
    """The second harmonic of gamma 2, a quarter of the first, loses four times as much as the first."""
    light = blurred(light_spectrum(gamma(2.0)), 0.1)
    np.testing.assert_allclose(np.abs(light[:, 2] / light[:, 1]), 0.25 * np.exp(-0.3), rtol=1e-4)


@pytest.mark.parametrize("blur", [0.0, 0.06, 0.2])
def test_the_frame_tells_the_blur(blur):
    """Strong blur is held back by the usual one; what is missing of it the frame adds to the correction itself."""
    prior = ResponsePrior(gamma(2.0), None)
    measured = measure_correction(counted(2.0, blur), 9)
    found, _ = prior.fit(measured, 12.0)
    assert found == pytest.approx(blur, abs=0.01 + 0.2 * blur)
    phase, bare = response_map(blurred(light_spectrum(gamma(2.0)), blur))
    table = measured.table(prior.corrected(measured, found))
    seen = reference.wrapped_difference(bare, 0)
    back = seen + np.interp(seen, np.linspace(-np.pi, np.pi, 257), table)
    error = reference.wrapped_difference(back, phase)
    assert np.sqrt(np.mean((error - error.mean()) ** 2)) < 0.005


def test_the_likelier_of_two_responses_fits_better():
    """A pattern in which the response has been undone shows every phase equally often."""
    bent, even = (measure_correction(counted(exponent, 0.06), 9) for exponent in (2.0, 1.0))
    response, linear = ResponsePrior(gamma(2.0), None), ResponsePrior(gamma(1.0), None)
    assert response.fit(bent, 12.0)[1] < linear.fit(bent, 12.0)[1]
    assert linear.fit(even, 12.0)[1] < response.fit(even, 12.0)[1]


def test_a_frame_without_a_word_gets_the_response_with_the_usual_blur():
    """Nothing is counted: the table is that of a fringe blurred by 0.7 px."""
    prior = ResponsePrior(gamma(2.0), None)
    measured = measure_correction(np.zeros((36, 256)), 9)
    blur, _ = prior.fit(measured, 12.0)
    assert blur == pytest.approx(2 * (np.pi / 12) ** 2, abs=0.01)
    table = measured.table(prior.corrected(measured, blur))
    np.testing.assert_allclose(table, response_table(blurred(light_spectrum(gamma(2.0)), blur)), atol=1e-3)


def test_the_frame_has_the_last_word():
    """Told that the light is linear, a frame of gamma 1.1 is still equalised: 0.02 rad of harmonic become 0.004."""
    prior = ResponsePrior(gamma(1.0), None)
    measured = measure_correction(counted(1.1, 0.0), 9)
    table = measured.table(prior.corrected(measured, prior.fit(measured, 12.0)[0]))
    phase, bare = response_map(light_spectrum(gamma(1.1)))
    seen = reference.wrapped_difference(bare, 0)
    back = seen + np.interp(seen, np.linspace(-np.pi, np.pi, 257), table)
    before, after = (np.sqrt(np.mean(reference.wrapped_difference(p, phase) ** 2)) for p in (bare, back))
    assert before > 0.02
    assert after < 0.006
