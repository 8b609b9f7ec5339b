"""One cycle of a channel: closed forms, and the kernels' functions against NumPy."""

import numpy as np
import pytest

from pipeline.simulation import TYPICAL_CROSSTALK
from tikernels._taichi import F32Array1, F32Array2, ti
from tikernels.phase.channel_template import (
    HARMONICS,
    TERMS,
    cycle_and_slope,
    cycle_at,
    flat_template,
    known_template,
    load_harmonics,
    template_mismatch,
    waves_of,
)
from tikernels.phase.phase_vector import phase_weights
from tikernels.phase.projector_response import light_spectrum

MATRIX = np.array(TYPICAL_CROSSTALK)
DELAYS = np.array([-1, 0, 1]) * 2 * np.pi / 3


@ti.kernel
def cycles_kernel(
    template: F32Array2,  # (3, terms)
    phases: F32Array1,  # (N,) rad
    out: F32Array2,  # (N, 9) the cycle from all waves, from the harmonics, its slope
):
    for i in range(phases.shape[0]):
        plain = cycle_at(template, waves_of(phases[i]))
        cycle, slope = cycle_and_slope(load_harmonics(template), phases[i])
        for k in ti.static(range(3)):
            out[i, k] = plain[k]
            out[i, 3 + k] = cycle[k]
            out[i, 6 + k] = slope[k]


def test_as_the_twin(arch):
    """Values and derivatives to 1e-5, what float32 and the polynomials leave; both ways to the cycle agree."""
    template = np.random.default_rng(1).normal(size=(3, TERMS)).astype(np.float32)
    template[:, 0] = 1
    phases = np.linspace(-np.pi, np.pi, 201)
    out = np.empty((201, 9), np.float32)
    cycles_kernel(template, phases.astype(np.float32), out)
    n = np.arange(1, HARMONICS + 1)
    waves = np.concatenate([np.ones((201, 1)), np.cos(n * phases[:, None]), np.sin(n * phases[:, None])], axis=1)
    slopes = np.concatenate(
        [np.zeros((201, 1)), -n * np.sin(n * phases[:, None]), n * np.cos(n * phases[:, None])], axis=1
    )
    np.testing.assert_allclose(out[:, :3], waves @ template.T, atol=5e-5)
    np.testing.assert_allclose(out[:, 3:6], waves @ template.T, atol=5e-5)
    np.testing.assert_allclose(out[:, 6:], slopes @ template.T, atol=1e-4)


def test_nothing_known_is_flat():
    template = flat_template()
    np.testing.assert_array_equal(template[:, 0], 1)
    np.testing.assert_array_equal(template[:, 1:], 0)


def test_the_template_of_a_known_rig():
    """Gamma 2 has a first harmonic of 4/3 and a second one of 1/3 of the mean; crosstalk mixes the channels."""
    response = np.tile(np.linspace(0, 1, 4096) ** 2, (3, 1))
    template = known_template(np.eye(3), light_spectrum(response))
    waves = template[:, 1 : 1 + HARMONICS] - 1j * template[:, 1 + HARMONICS :]
    np.testing.assert_allclose(waves[:, 0], 4 / 3 * np.exp(1j * DELAYS), atol=1e-4)
    np.testing.assert_allclose(waves[:, 1], 1 / 3 * np.exp(2j * DELAYS), atol=1e-4)
    mixed = known_template(MATRIX, light_spectrum(response))
    expected = (MATRIX / MATRIX.sum(axis=1, keepdims=True)) @ waves
    np.testing.assert_allclose(mixed[:, 1 : 1 + HARMONICS], expected.real, atol=1e-4)
    lag = np.array([0.2, 0.0, -0.1])
    lagging = known_template(np.eye(3), light_spectrum(response, lag))
    waves = lagging[:, 1] - 1j * lagging[:, 1 + HARMONICS]
    np.testing.assert_allclose(np.angle(waves * np.exp(-1j * (DELAYS - lag))), 0, atol=1e-6)


@pytest.mark.parametrize("contrast", [0.3, 1.0])
def test_fundamentals_as_the_weights_expect_them_match(contrast):
    """Whatever phase and contrast the three have in common; one channel 6 % off is sqrt(2/3) 6 % / sqrt(2) off."""
    waves = contrast * np.exp(1j * (DELAYS + 0.3))
    weights = phase_weights(np.eye(3)).astype(np.float32)

    def mismatch(waves: np.ndarray) -> float:
        template = np.zeros((3, TERMS), np.float32)
        template[:, 0], template[:, 1], template[:, 1 + HARMONICS] = 1, waves.real, -waves.imag
        return template_mismatch(template, weights)

    assert mismatch(waves) < 1e-6
    assert mismatch(waves * [1.06, 1, 1]) == pytest.approx(0.06 / np.sqrt(3), rel=0.03)
    assert np.isnan(template_mismatch(flat_template(), weights))
