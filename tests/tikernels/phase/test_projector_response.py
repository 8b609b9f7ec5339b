"""A known response of the projector: what it does to the phase, and that its table undoes it."""

import numpy as np
import pytest
import reference

from tikernels.phase.projector_response import pattern_light, prefers_response, response_map, response_table


def gamma(exponent: float) -> np.ndarray:
    return np.tile(np.linspace(0, 1, 4096) ** exponent, (3, 1))


def test_a_linear_response_does_nothing():
    phase, bare = response_map(gamma(1.0))
    np.testing.assert_allclose(bare, phase, atol=1e-6)
    assert np.abs(response_table(gamma(1.0))).max() < 1e-6


def test_gamma_two_is_the_third_harmonic():
    """cos^4 of half the phase has a second harmonic of a quarter of its first: atan2 bends by asin(1/4) at the most."""
    phase, bare = response_map(gamma(2.0))
    error = bare - phase
    assert np.abs(error).max() == pytest.approx(np.arcsin(1 / 4), rel=1e-3)
    spectrum = np.abs(np.fft.rfft(error[:-1])) / len(error)
    assert spectrum[3] > 10 * spectrum[[1, 2, 4, 5]].max()
    np.testing.assert_allclose(bare[-1] - bare[0], 2 * np.pi)


@pytest.mark.parametrize("lag", [None, np.array([0.1, 0.0, -0.1])])
def test_the_table_undoes_the_map(lag):
    """The true phase comes back from what the camera sees, to 2e-3 rad: what 256 straight lines leave of the map."""
    phase, bare = response_map(gamma(2.2), lag)
    table = response_table(gamma(2.2), lag)
    edges = np.linspace(-np.pi, np.pi, len(table))
    wrapped = reference.wrapped_difference(bare, 0)
    back = wrapped + np.interp(wrapped, edges, table)
    assert np.abs(reference.wrapped_difference(back, phase)).max() < 2e-3


def test_the_mean_light_of_a_pattern():
    """The mean of (1 + cos)^2 / 4 is 3/8."""
    np.testing.assert_allclose(pattern_light(gamma(1.0)), 0.5, atol=1e-4)
    np.testing.assert_allclose(pattern_light(gamma(2.0)), 3 / 8, atol=1e-4)


def test_the_phases_tell_whether_the_response_was_compensated():
    phase, bare = response_map(gamma(2.0))
    bent = np.histogram(reference.wrapped_difference(bare, 0), 256, (-np.pi, np.pi))[0]
    even = np.histogram(phase, 256, (-np.pi, np.pi))[0]
    assert prefers_response(bent, gamma(2.0))
    assert not prefers_response(even, gamma(2.0))
