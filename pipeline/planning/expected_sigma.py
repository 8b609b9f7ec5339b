"""How sure the phase of a pixel will be, before there is a frame.

A channel's light under the pattern is C_i = r_i sum_j M_ij code_j^gamma. Where its noise is sigma levels and neither
the phase phi nor the pixel's brightness is known, the bound of Cramer and Rao on the phase is

    var = sigma^2 / sum_i (dC_i / dphi)_across^2,

the derivative across the light C itself (`docs/accuracy.md`; S. M. Kay, Fundamentals of Statistical Signal Processing,
volume 1, 1993, section 3.7). The decoder's own noise model then says what smoothing leaves of it
(`tikernels/phase/smoothing.py`) and that its model of the light, fitted to samples, adds a share of its own
(`tikernels/phase/uncertainty.py`).

Smoothing weighs rows by how sure they are, but not without bounds, so that it leaves more than the harmonic mean of a
cycle's variances and less than their mean: the geometric mean stands between the two.
"""

from typing import Literal

import numpy as np

from pipeline.models import FloatArray
from pipeline.pattern.contrast_code import CYCLES, modulation_at
from pipeline.pattern.fringes import CHANNEL_PHASES
from pipeline.settings import DecodeSettings
from pipeline.simulation import SKIN, TYPICAL_CROSSTALK, WHITE
from tikernels.phase.smoothing import left_of_variance
from tikernels.phase.uncertainty import OWN_ERROR

REFLECTANCES = {"skin": SKIN, "white": WHITE}
# A mosaic has a third of the samples, from which all three colours of a pixel are interpolated.
_VARIANCE = {"bayer": 3.0, "rgb": 1.0}
# An ordinary projector's response, which codes are raised to.
_GAMMA = 2.0
# What decoding leaves of a smooth surface under the coded pattern without noise, rad, by the cycles in view: planes,
# skin and white, 640x480 and 1280x960, gamma 2, 12 bits, noise of 0.3 levels. It is the third harmonic: a frame of few
# cycles does not tell the projector's response well. With a response that is known and undone in the pattern 0.003 to
# 0.005 rad are left.
_NOISELESS_CYCLES = (19.0, 23.5, 27.4, 33.0, 40.0)
_NOISELESS_RAD = (0.0115, 0.0066, 0.0048, 0.003, 0.0025)
# Of a cycle: four times as many change the result by less than 0.1 %.
_SAMPLES = 64
# Light of a phase this much before and after tells the slope, rad, to one part in a thousand.
_SHIFT = 0.02


def expected_phase_sigma(
    surface: Literal["skin", "white"],
    *,
    brightness: float,
    contrast: float,
    noise_levels: float,
    bits: int,
    sensor: Literal["bayer", "rgb"],
    cycles_in_view: float,
) -> float:
    """Return the standard deviation of a pixel's decoded phase on a smooth surface.

    Parameters
    ----------
    surface : {"skin", "white"}
        Its colour.
    brightness : float
        What the brightest channel reaches where the fringe is brightest, 0..1 of full scale.
    contrast : float
        What ambient light and blur leave of the fringe's contrast, 0..1.
    noise_levels : float
        Standard deviation of the camera's noise, in 1/255 of full scale.
    bits : int
        The camera's; rounding to whole levels has the variance of an even distribution over one.
    sensor : {"bayer", "rgb"}
        Whether a pixel has one colour or all three.
    cycles_in_view : float
        How many cycles of the fringe the camera sees.

    Returns
    -------
    float
        rad, RMS over the cycles of the coded pattern.

    Examples
    --------
    >>> camera = {"brightness": 0.7, "contrast": 0.9, "noise_levels": 1.5, "bits": 8, "sensor": "rgb"}
    >>> round(expected_phase_sigma("white", **camera, cycles_in_view=40), 4)
    0.0064
    """
    cycles = np.arange(CYCLES * _SAMPLES) / _SAMPLES
    light = _light(cycles, 0.0, surface)
    background = light.reshape(CYCLES, _SAMPLES, 3).mean(axis=(0, 1))
    scale = 255 * brightness / (background + contrast * (light - background)).max()
    slope = scale * contrast * (_light(cycles, _SHIFT, surface) - _light(cycles, -_SHIFT, surface)) / (2 * _SHIFT)
    direction = light / np.linalg.norm(light, axis=1, keepdims=True)
    across = slope - np.sum(slope * direction, axis=1, keepdims=True) * direction
    noise = (noise_levels**2 + (255 / (2**bits - 1)) ** 2 / 12) * _VARIANCE[sensor]
    variance = np.exp(np.mean(np.log(noise / np.sum(across**2, axis=1))))
    left = left_of_variance(DecodeSettings().smoothing_px // 2) + OWN_ERROR
    noiseless_rad = np.interp(cycles_in_view, _NOISELESS_CYCLES, _NOISELESS_RAD)
    return float(np.sqrt(left * variance + noiseless_rad**2))


def _light(cycles: FloatArray, shift: float, surface: str) -> FloatArray:
    """Return what the camera's channels see of the pattern, its phase shifted by this (rad), (N, 3)."""
    modulation = modulation_at(cycles)[:, None]
    wave = np.cos(2 * np.pi * cycles[:, None] + shift + np.array(CHANNEL_PHASES))
    primaries = (1 - modulation + modulation * wave) ** _GAMMA
    return np.asarray(primaries @ np.array(TYPICAL_CROSSTALK).T * np.array(REFLECTANCES[surface]))
