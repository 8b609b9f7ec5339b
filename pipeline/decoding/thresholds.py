"""Noise and thresholds of a frame: the settings', and what they leave open from the frame itself."""

import numpy as np

from pipeline.settings import DecodeSettings
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.frame_statistics import FrameLevels, FrameStatistics

# The fringe must stand out of the noise by five standard deviations, where chance makes one pixel in 300,000 valid, and
# reach this fraction of the frame's brightness, below which ambient light and stray light decide.
_MODULATION_SIGMAS = 5.0
_MODULATION_FRACTION = 0.03
# What all pixels have in common those tell that have this share of the fringe of the brightest.
_TELLING = 0.15
_INTENSITY_SIGMAS = 3.0
_INTENSITY_FRACTION = 0.02
# Noise below this share of full scale is not to be relied on.
_LEAST_NOISE = 1e-5


def frame_levels(
    settings: DecodeSettings, statistics: FrameStatistics, white: float, crosstalk: Crosstalk
) -> FrameLevels:
    """Return noise and thresholds of a frame.

    Parameters
    ----------
    settings : DecodeSettings
        What is given wins.
    statistics : FrameStatistics
        The frame's, as fractions of full scale.
    white : float
        Full scale, levels.
    crosstalk : Crosstalk
        Undoing it makes noise larger.
    """
    brightness = statistics.brightness * white
    read, gain = settings.noise or (statistics.noise[0] * white, statistics.noise[1] * white)
    read = max(read, _LEAST_NOISE * white)
    noise = float(np.sqrt(read**2 + gain * brightness / 2))
    intensity, modulation = settings.min_intensity, settings.min_modulation
    if intensity is None:
        intensity = max(_INTENSITY_SIGMAS * noise, _INTENSITY_FRACTION * brightness)
    if modulation is None:
        modulation = max(_MODULATION_SIGMAS * crosstalk.noise_amplification * noise, _MODULATION_FRACTION * brightness)
    return FrameLevels(white, read, gain, noise, intensity, modulation, _TELLING * statistics.modulation * white)
