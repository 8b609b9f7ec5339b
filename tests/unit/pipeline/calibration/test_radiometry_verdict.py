"""What a radiometry is said to be worth, beside the ripple and noise that errors of that size make."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibration.radiometry import Radiometry
from pipeline.calibration.verdict import judge_radiometry
from pipeline.simulation import TYPICAL_CROSSTALK, simulated_rig

MATRIX = 0.6 * np.array(TYPICAL_CROSSTALK)


def measured(sigma=1e-4, gamma=2.2, **values):
    response = np.tile(np.linspace(0, 1, 256) ** gamma, (3, 1))
    found = Radiometry(
        crosstalk_matrix=MATRIX,
        crosstalk_sigma=np.full((3, 3), sigma * 0.6),
        response=response,
        response_sigma=np.full((3, 256), sigma),
        transfer="linear",
        additivity=0.001,
        ambient=np.full(3, 0.02),
        noise=np.full(3, 1.5 / 255),
        ramps=np.zeros((4, 17, 3)),
    )
    return replace(found, **values)


def test_noise_of_three_channels_makes_the_phase_noise_that_it_says():
    """Against the arctangent of noisy light, drawn; to 3 per cent."""
    rng, rows = np.random.default_rng(3), MATRIX.sum(axis=1)
    phase = rng.uniform(-np.pi, np.pi, 100_000)
    light = 0.5 + 0.5 * np.cos(phase[:, None] + np.array([-1, 0, 1]) * 2 * np.pi / 3)
    light += 1.5 / 255 / rows * rng.standard_normal(light.shape)
    vector = light @ np.exp(-1j * np.array([-1, 0, 1]) * 2 * np.pi / 3)
    error = np.angle(vector * np.exp(-1j * phase))
    assert judge_radiometry(measured(), None).noise_rad == pytest.approx(error.std(), rel=0.03)


def test_the_grade_follows_from_the_ripple():
    grades = [judge_radiometry(measured(sigma), None).grade for sigma in (1e-4, 0.006, 0.03)]
    assert grades == ["good", "usable", "poor"]


def test_gamma_is_the_power_of_the_code():
    np.testing.assert_allclose(judge_radiometry(measured(gamma=1.8), None).gamma, 1.8, atol=1e-6)


def test_a_geometry_tells_mm():
    """On this rig a radian is 7.0 mm, 900 mm away: 17.45 px a cycle, 0.398 px a mm."""
    geometry = simulated_rig().geometry()
    verdict = judge_radiometry(measured(), geometry)
    assert verdict.mm_per_rad == pytest.approx(17.4545 / (2 * np.pi) / 0.398, rel=0.05)
    assert "mm)" in verdict.in_words()
    assert "mm)" not in judge_radiometry(measured(), None).in_words()
    parallel = replace(geometry, rotation=np.eye(3))
    assert judge_radiometry(measured(), parallel).mm_per_rad is None


def test_what_would_make_it_better():
    assert judge_radiometry(measured(), None).advice == ()
    (grey,) = judge_radiometry(measured(additivity=0.012), None).advice
    assert "grey differs from red + green + blue by 1.2%" in grey
    (dim,) = judge_radiometry(measured(crosstalk_matrix=0.3 * MATRIX), None).advice
    assert "expose longer" in dim
