"""Thresholds follow the noise and the light, unless the settings say otherwise."""

import numpy as np
import pytest

from pipeline.decoding.thresholds import frame_levels
from pipeline.settings import DecodeSettings
from tikernels.phase.frame_statistics import FrameStatistics
from tikernels.phase.smoothing import left_of_variance


def levels(statistics, **options):
    return frame_levels(DecodeSettings(**options), statistics, 255.0)


def seen(noise, brightness=0.5):
    return FrameStatistics(
        period_px=12.0, noise=(noise, 0.0), brightness=brightness, modulation=brightness / 2, clipped=0.0
    )


def test_a_pixel_counts_by_what_its_phase_is_worth_after_smoothing():
    smoothed, bare = levels(seen(0.02)), levels(seen(0.02), smoothing_px=0)
    # 0.2 rad, of which seven pixels both ways leave a quarter; before smoothing, never more than about 0.75.
    assert smoothed.precision == pytest.approx(left_of_variance(3) / 0.2**2)
    assert smoothed.precision == pytest.approx(1 / 0.75**2, rel=0.03)
    assert bare.precision == pytest.approx(1 / 0.2**2)
    assert levels(seen(0.02), smoothing_px=15).precision == smoothed.precision


def test_whatever_the_noise_ambient_light_decides_below_three_hundredths_of_the_brightness():
    quiet, noisy = levels(seen(0.001)), levels(seen(0.02))
    assert quiet.modulation == noisy.modulation == pytest.approx(0.03 * 0.5 * 255)
    assert noisy.intensity > quiet.intensity


def test_what_is_given_wins():
    given = levels(seen(0.02), noise=(3.0, 0.1), min_intensity=7.0, min_modulation=8.0)
    assert (given.read_noise, given.noise_gain, given.intensity, given.modulation) == (3.0, 0.1, 7.0, 8.0)
    assert given.precision == 0
    # At half of the brightest the variance is the read noise's and the photons'.
    assert given.noise == pytest.approx(np.sqrt(9 + 0.1 * 0.5 * 255 / 2))


def test_no_noise_at_all_is_not_believed():
    assert levels(seen(0.0)).read_noise > 0
