"""Thresholds follow the noise and the light, unless the settings say otherwise."""

import numpy as np
import pytest

from pipeline.decoding.thresholds import frame_levels
from pipeline.settings import DecodeSettings
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.frame_statistics import FrameStatistics

NONE = Crosstalk.of(np.eye(3))


def levels(statistics, crosstalk=NONE, **options):
    return frame_levels(DecodeSettings(**options), statistics, 255.0, crosstalk)


def seen(noise, brightness=0.5):
    return FrameStatistics(
        period_px=12.0, noise=(noise, 0.0), brightness=brightness, modulation=brightness / 2, clipped=0.0
    )


def test_a_noisy_frame_needs_a_stronger_fringe():
    quiet, noisy = levels(seen(0.001)), levels(seen(0.02))
    # Three hundredths of the brightness where there is hardly any noise, five standard deviations where there is.
    assert quiet.modulation == pytest.approx(0.03 * 0.5 * 255)
    assert noisy.modulation == pytest.approx(5 * NONE.noise_amplification * 0.02 * 255)
    assert noisy.intensity > quiet.intensity


def test_undoing_crosstalk_makes_noise_larger():
    mixed = Crosstalk.of(np.array([[0.8, 0.2, 0], [0.2, 0.6, 0.2], [0, 0.2, 0.8]]))
    assert levels(seen(0.02), mixed).modulation > 1.2 * levels(seen(0.02)).modulation


def test_what_is_given_wins():
    given = levels(seen(0.02), noise=(3.0, 0.1), min_intensity=7.0, min_modulation=8.0)
    assert (given.read_noise, given.noise_gain, given.intensity, given.modulation) == (3.0, 0.1, 7.0, 8.0)
    # At half of the brightest the variance is the read noise's and the photons'.
    assert given.noise == pytest.approx(np.sqrt(9 + 0.1 * 0.5 * 255 / 2))


def test_no_noise_at_all_is_not_believed():
    assert levels(seen(0.0)).read_noise > 0
