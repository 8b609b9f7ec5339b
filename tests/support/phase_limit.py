"""What a simulated frame's noise leaves of the phase: the information limit of every pixel."""

import numpy as np
import numpy.typing as npt

from pipeline.pattern import CHANNEL_PHASES
from pipeline.simulation import SimulatedFrame, SimulationSettings, simulate_frame

# By this much the pattern is shifted either way to see how the light changes with the phase, rad: the light's third
# derivative, at gamma 2 up to four times the first, then spoils the slope by less than one part in a thousand.
_SHIFT = 0.02
# Rounding to whole levels has the variance of an even distribution over one level.
_ROUNDING = 1 / 12


def phase_limit(
    truth: SimulatedFrame, settings: SimulationSettings, *, brightness_known: bool = True
) -> npt.NDArray[np.float64]:
    """Return the bound of Cramer and Rao on the phase's standard deviation, (H, W) float64, rad.

    With a channel's light I_i in levels and its noise sigma, var(phase) >= sigma^2 / sum_i (dI_i / dphase)^2, where
    everything but the phase is known, and no pixel knows its neighbours. Where a pixel's brightness is not known
    either, only what stands across the projector's light counts of the derivative.
    """
    geometry = truth.rig.geometry()
    exposure = settings.exposure or _exposure(truth, settings)
    clean = settings.model_copy(update={"noise_levels": 0.0, "bits": 16, "exposure": exposure})
    width, height = geometry.projector.size_px
    rows = 2 * np.pi / geometry.pattern.period_px * np.arange(height if geometry.phase_axis == 1 else width)
    light = []
    for shift in (-_SHIFT, _SHIFT):
        codes = 0.5 + 0.5 * np.cos(rows[:, None] + shift + np.array(CHANNEL_PHASES))
        line = codes[:, None] if geometry.phase_axis == 1 else codes[None]
        shown = np.ascontiguousarray(np.broadcast_to(line, (height, width, 3)), np.float32)
        light.append(simulate_frame(truth.rig, clean, shown).image / 65535)
    slope = (light[1] - light[0]) / (2 * _SHIFT) * 255
    if not brightness_known:
        lit = simulate_frame(truth.rig, clean.model_copy(update={"ambient": 0.0})).image.astype(np.float64)
        with np.errstate(invalid="ignore"):
            lit /= np.linalg.norm(lit, axis=-1, keepdims=True)
        slope -= (slope * lit).sum(axis=-1, keepdims=True) * lit
    variance = settings.noise_levels**2 + _ROUNDING * (255 / truth.white_level) ** 2
    with np.errstate(divide="ignore"):
        return np.asarray(np.sqrt(variance / (slope**2).sum(axis=-1)))


def _exposure(truth: SimulatedFrame, settings: SimulationSettings) -> float:
    """Return the exposure that was chosen for the frame: the same scene at exposure 1 is darker by that factor."""
    dark = settings.model_copy(update={"noise_levels": 0.0, "bits": 16, "exposure": 1e-1})
    light = simulate_frame(truth.rig, dark).image.astype(np.float64)
    return float(1e-1 * truth.image.sum() / truth.white_level / (light.sum() / 65535))
