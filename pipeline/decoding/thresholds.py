"""Noise and thresholds of a frame: the settings', and what they leave open from the frame itself."""

import numpy as np

from pipeline.settings import DecodeSettings
from tikernels.phase.frame_statistics import FrameLevels, FrameStatistics
from tikernels.phase.phase_vector import SIGMAS
from tikernels.phase.smoothing import left_of_variance

# The largest standard deviation, rad, that is expected of a valid pixel's smoothed phase.
_MOST_SIGMA = 0.2
# Frame-wide quantities are estimated from pixels with at least this share of the fringe of the brightest.
_LEAST_SHARE = 0.15
# Light and fringe must reach this fraction of the frame's brightness, below which ambient and stray light decide.
_LEAST_FRACTION = 0.03
# Noise below this share of full scale is not to be relied on.
_LEAST_NOISE = 1e-5


def frame_levels(settings: DecodeSettings, statistics: FrameStatistics, white: float) -> FrameLevels:
    """Return noise and thresholds of a frame.

    Parameters
    ----------
    settings : DecodeSettings
        Values that they state take precedence.
    statistics : FrameStatistics
        The frame's, as fractions of full scale.
    white : float
        Full scale, levels.
    """
    brightness = statistics.brightness * white
    read, gain = settings.noise or (statistics.noise[0] * white, statistics.noise[1] * white)
    read = max(read, _LEAST_NOISE * white)
    noise = float(np.sqrt(read**2 + gain * brightness / 2))
    intensity, modulation, precision = settings.min_intensity, settings.min_modulation, 0.0
    if intensity is None:
        intensity = max(SIGMAS * noise, _LEAST_FRACTION * brightness)
    if modulation is None:
        modulation = _LEAST_FRACTION * brightness
        # Larger windows than usual make up for no more noise: neighbours would differ by half a cycle.
        window_px = min(settings.smoothing_px, DecodeSettings().smoothing_px)
        precision = left_of_variance(window_px // 2) / _MOST_SIGMA**2
    return FrameLevels(
        white=white,
        read_noise=read,
        noise_gain=gain,
        noise=noise,
        intensity=intensity,
        modulation=modulation,
        precision=precision,
        least_reliable=_LEAST_SHARE * statistics.modulation * white,
    )
