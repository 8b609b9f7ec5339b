"""What a frame's texture is compared with, and how much of the fringe is left in it."""

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.calibration import Calibration
from pipeline.simulation import SimulatedFrame, SimulationSettings, simulate_frame
from tikernels.phase.texture import BRIGHTEST

Array = npt.NDArray[np.floating]

#: By how much less than the frame's the fringe of a texture must be, dB of energy.
DECIBELS = 34.5


def white_frame(rig: Calibration, settings: SimulationSettings) -> Array:
    """Return (H, W, 3) linear light of the same scene under the projector's white, without noise, 0..1."""
    width, height = rig.geometry().projector.size_px
    quiet = settings.model_copy(update={"noise_levels": 0.0, "bits": 16, "exposure": None, "transfer": "linear"})
    seen = simulate_frame(rig, quiet, np.ones((height, width, 3), np.float32))
    return seen.image / seen.white_level


def linear_light(texture: npt.NDArray[np.uint8]) -> Array:
    """Return a texture's linear light, in units of full scale."""
    encoded = texture / 255
    light = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    return np.asarray(BRIGHTEST * light)


def fringe_energy(image: Array, phase: Array, mask: npt.NDArray[np.bool_], period_px: float) -> float:
    """Return the mean square of what follows the phase, and two and three times it: channels' sums, any unit.

    Within Gaussian windows of a cycle, those that are less than 95 % inside the mask left out.
    """

    def smooth(values: Array) -> Array:
        return np.asarray(cv2.GaussianBlur(values, (0, 0), period_px))

    inside = smooth(mask.astype(np.float64))
    whole = mask & (inside > 0.95)
    angle, energy = np.where(mask, phase, 0.0), 0.0
    for channel in np.moveaxis(image, -1, 0):
        rest = np.where(mask, channel - smooth(np.where(mask, channel, 0.0)) / np.maximum(inside, 1e-9), 0.0)
        for n in (1, 2, 3):
            parts = [smooth(rest * wave(n * angle))[whole] / inside[whole] for wave in (np.cos, np.sin)]
            energy += float((parts[0] ** 2 + parts[1] ** 2).mean())
    return energy


def ripple_below_frame_db(
    texture: Array, under_white: Array, frame: SimulatedFrame, lit: npt.NDArray[np.bool_], period_px: float
) -> float:
    """Return the fringe's energy in a texture over that in the frame, dB, both measured the same way.

    Of the texture counts what it differs by from the light under white: shading and paint have energy of their own at
    the fringe's frequency, 25 dB below the frame's on a bust.
    """
    scale = (texture * under_white)[lit].sum(axis=0) / (under_white**2)[lit].sum(axis=0)
    left = fringe_energy(np.where(lit[..., None], texture - scale * under_white, 0.0), frame.phase, lit, period_px)
    return 10 * float(np.log10(left / fringe_energy(frame.image / frame.white_level, frame.phase, lit, period_px)))
