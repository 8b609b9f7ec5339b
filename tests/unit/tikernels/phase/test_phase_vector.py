"""A pixel's mathematics against NumPy's float64."""

import numpy as np
import pytest
import reference

from pipeline.simulation import TYPICAL_CROSSTALK
from tikernels._taichi import F32Array1, F32Array2, ti, vec3
from tikernels.phase.phase_vector import (
    PI,
    arctangent,
    channel_delays,
    channel_waves,
    cosine_and_sine,
    modulation_of,
    phase_vector,
    phase_weights,
    wrap,
)

MATRIX = np.array(TYPICAL_CROSSTALK)


@ti.kernel
def angles_kernel(
    y: F32Array1,
    x: F32Array1,
    out: F32Array2,  # (N, 4) angle of (x, y), its cosine and sine, y wrapped
):
    for i in range(out.shape[0]):
        angle = arctangent(y[i], x[i])
        cosine, sine = cosine_and_sine(angle)
        out[i, 0] = angle
        out[i, 1] = cosine
        out[i, 2] = sine
        out[i, 3] = wrap(y[i])


def angles(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    out = np.empty((len(y), 4), np.float32)
    angles_kernel(y.astype(np.float32), x.astype(np.float32), out)
    return out.T


def test_the_arctangent_all_around(arch):
    """2e-6 rad, whatever the length; a thousandth of the best frame's noise is 1e-5."""
    angle = np.concatenate([np.linspace(-np.pi, np.pi, 4001), np.arange(-4, 5) * np.pi / 4])
    for length in (1e-3, 1.0, 1e4):
        found, cosine, sine, _ = angles(length * np.sin(angle), length * np.cos(angle))
        assert np.abs(reference.wrapped_difference(found, angle)).max() < 3e-6
        np.testing.assert_allclose(cosine, np.cos(angle), atol=5e-6)
        np.testing.assert_allclose(sine, np.sin(angle), atol=5e-6)


def test_the_arctangent_of_nothing(arch):
    assert angles(np.zeros(1), np.zeros(1))[0, 0] == pytest.approx(np.pi / 4)


def test_angles_are_wrapped_once(arch):
    angle = np.linspace(-2.99 * np.pi, 2.99 * np.pi, 1001)
    found = angles(angle, np.ones(1001))[3]
    assert np.abs(found).max() <= np.float32(PI)
    # float32 leaves 5e-7 rad of three half cycles.
    np.testing.assert_allclose(reference.wrapped_difference(found, angle), 0, atol=1e-6)


@pytest.mark.parametrize("lag", [None, np.array([0.2, 0.0, -0.1])])
def test_weights_undo_waves_and_crosstalk(lag):
    """What three lagging sinusoids and the crosstalk make of a phase, the weights take apart again."""
    phase = np.linspace(-np.pi, np.pi, 41)
    seen = MATRIX @ (0.4 + 0.25 * np.cos(phase + channel_delays(lag)[:, None]))
    vector = phase_weights(np.linalg.inv(MATRIX), lag) @ seen
    np.testing.assert_allclose(vector, [0.25 * np.cos(phase), 0.25 * np.sin(phase), np.full(41, 0.4)], atol=1e-12)
    np.testing.assert_allclose(channel_waves(lag) @ vector[[2, 0, 1]], np.linalg.inv(MATRIX) @ seen, atol=1e-12)


@ti.kernel
def vector_kernel(
    light: F32Array2,  # (N, 3)
    out: F32Array2,  # (N, 4) the phase vector, its modulation
):
    for i in range(light.shape[0]):
        vector = phase_vector(vec3(light[i, 0], light[i, 1], light[i, 2]))
        for k in ti.static(range(3)):
            out[i, k] = vector[k]
        out[i, 3] = modulation_of(vector)


def test_the_plain_vector_is_that_of_the_weights(arch):
    """What is written out for channels without crosstalk is what the decoder's weights give; float32 leaves 1e-6."""
    light = np.random.default_rng(1).random((200, 3), np.float32)
    out = np.empty((200, 4), np.float32)
    vector_kernel(light, out)
    expected = light @ phase_weights(np.eye(3)).T
    np.testing.assert_allclose(out[:, :3], expected, atol=1e-6)
    np.testing.assert_allclose(out[:, 3], np.hypot(expected[:, 0], expected[:, 1]), atol=1e-6)
