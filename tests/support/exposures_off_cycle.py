"""Frames whose exposure is not a whole number of the projector's colour cycles, and what that does to their phase.

The exposure is off by a fraction of itself, its `deviation`. In that time one colour is on, and of it either every
mirror for the share of its level ("even"), or those of the levels above half only ("top bit"); with a rolling shutter
another colour from row to row ("rolling", four cycles from the first row to the last). Frames have 16 bits, so that
rounding moves nothing.
"""

import numpy as np
import numpy.typing as npt

from pipeline import Decoder
from pipeline.pattern import make_pattern
from pipeline.simulation import SimulatedFrame, SimulationSettings, simulate_frame, simulated_rig

#: Settings for colours that take a third of the time from frame to frame each, as `field_motion_mm` simulates them.
FIELDS = {
    "frame_s": 1.0,
    "fields": {"cycle_s": 1.0, "shown_s": ((0, 1 / 3), (1 / 3, 2 / 3), (2 / 3, 1)), "locked": True},
}
KINDS = ("even", "top bit", "rolling")
SHARE = 1 / 3


def exposed(
    codes: npt.NDArray[np.float32], deviation: float, kind: str, channel: int, gamma: float
) -> npt.NDArray[np.float32]:
    """Return the codes that make the light of an exposure that is longer by `deviation`, all of it in one channel."""
    light = np.rint(255 * codes.astype(np.float64) ** gamma) / 255
    on = light > 0.5 if kind == "top bit" else light
    light[..., channel] += (deviation / SHARE * on)[..., channel]
    return (light ** (1 / gamma)).astype(np.float32)


def simulate_exposure(
    deviation: float, kind: str, scene: str = "plane", size_px: tuple[int, int] = (640, 480), channel: int = 0
) -> SimulatedFrame:
    """Photograph a scene with such an exposure."""
    rig = simulated_rig(size_px, period_px=768 / 44 * 640 / size_px[0])
    settings = SimulationSettings(scene=scene, bits=16, noise_levels=0.5, exposure=0.8)
    codes = make_pattern((1024, 768), rig.geometry().pattern)
    channels = range(3) if kind == "rolling" else (channel,)
    how = "top bit" if kind == "rolling" else kind
    frames = [simulate_frame(rig, settings, exposed(codes, deviation, how, c, settings.gamma)) for c in channels]
    if kind == "rolling":
        bands = np.arange(size_px[1]) * 12 // size_px[1] % 3
        for c in (1, 2):
            frames[0].image[bands == c] = frames[c].image[bands == c]
    return frames[0]


def moved(decoder: Decoder, straight: SimulatedFrame, other: SimulatedFrame) -> npt.NDArray[np.float64]:
    """Return by how much the phase differs where both are measured, rad."""
    first = decoder.decode(straight.image).wrapped_phase.copy()
    second = decoder.decode(other.image).wrapped_phase
    difference = (second - first)[np.isfinite(first) & np.isfinite(second)]
    return np.asarray(np.angle(np.exp(1j * difference.astype(np.float64))))
