"""Harmonics of a projector's response, and of a camera's transfer, told apart by which one undoes them."""

import numpy as np
import pytest

from pipeline.diagnosis.channel_spectra import PHASES, fit_tiles
from pipeline.diagnosis.harmonic_causes import explain_harmonics, response_harmonics

PERIOD_PX = 12.0


@pytest.mark.parametrize("gamma", [1.5, 2.0, 2.4])
def test_a_power_law_has_the_harmonics_of_the_binomial_series(gamma):
    """((1 + cos) / 2)**gamma: c_2 / c_1 = (gamma - 1) / (gamma + 2), and the contrast is 2 gamma / (gamma + 1)."""
    response = np.tile(np.linspace(0, 1, 4096) ** gamma, (3, 1))
    harmonics, contrast = response_harmonics(response, 3)
    np.testing.assert_allclose(harmonics[:, 0], (gamma - 1) / (gamma + 2), atol=1e-4)
    third = (gamma - 1) / (gamma + 2) * (gamma - 2) / (gamma + 3)
    np.testing.assert_allclose(harmonics[:, 1], third, atol=1e-4)
    np.testing.assert_allclose(contrast, 2 * gamma / (gamma + 1), atol=1e-3)


def explained(gamma=1.0, transfer=False, known=None):
    """Explain frames of 120x160 px whose codes have an amplitude of half, seen without crosstalk."""
    rows = np.indices((120, 160))[0]
    phase = 2 * np.pi * rows / PERIOD_PX
    light = (0.5 + 0.5 * np.cos(phase[..., None] + PHASES)) ** gamma
    light = 0.05 + 0.8 * light + 2e-3 * np.random.default_rng(2).standard_normal(light.shape)
    levels = light ** (1 / 2.2) if transfer else light
    everywhere = np.ones(phase.shape, bool)

    def tiles(values):
        return fit_tiles(values, phase, everywhere, PERIOD_PX)

    def otherwise():
        return tiles(levels**2.2 if transfer else levels ** (1 / 2.2))

    return explain_harmonics(tiles(levels), np.eye(3), 0.01, "srgb", otherwise, known)


def test_sinusoids_need_no_explanation():
    findings, _, change = explained()
    assert findings == []
    np.testing.assert_array_equal(change, np.ones(3))


def test_a_response_is_named_with_its_gamma():
    (finding,), _, change = explained(gamma=2.0)
    assert finding.causes == ("response",)
    assert "R 2.0" in finding.size and finding.ripple_rad[3] > 0.1
    np.testing.assert_allclose(change, 4 / 3, rtol=0.02)


def test_a_response_that_is_undone_is_no_fault():
    findings, _, _ = explained(gamma=2.0, known=np.tile(np.linspace(0, 1, 256) ** 2.0, (3, 1)))
    assert findings == []


def test_a_transfer_is_named_and_undone():
    (finding,), tiles, _ = explained(transfer=True)
    assert finding.causes == ("transfer",)
    assert "sRGB-coded" in finding.size and "transfer='srgb'" in finding.advice
    assert np.abs(tiles.spectrum[..., 1]).max() < 0.02
