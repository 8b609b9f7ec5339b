"""A flat board of painted patches, whose colours act between broad and narrow bands, under the fringe."""

import numpy as np

from pipeline import Decoder, DecodeSettings
from pipeline.calibration import Calibration
from pipeline.simulation import TYPICAL_CROSSTALK
from tikernels.phase.surface_matrix import BROAD, NARROW, band_weights

PERIOD_PX = 12.3
MATRIX = np.array(TYPICAL_CROSSTALK)
WHITE = MATRIX.sum(axis=1)
#: Reflectances at the three primaries.
PAINTS = {"white": (0.8, 0.8, 0.8), "orange": (0.8, 0.35, 0.08), "blue": (0.1, 0.25, 0.6), "skin": (0.6, 0.4, 0.32)}
_DELAYS = np.array([-1, 0, 1]) * 2 * np.pi / 3


def surface_matrix(reflectance: tuple[float, float, float], broad: float = 0.25) -> np.ndarray:
    """Return the matrix of a paint; its colour acts this far after the crosstalk, the rest before."""
    weights = broad * BROAD + (1 - broad) * NARROW
    return np.asarray(MATRIX * np.exp(weights @ np.log(reflectance)))


def band_matrix(reflectance: tuple[float, float, float], wavelengths_nm: np.ndarray) -> np.ndarray:
    """Return the matrix of a paint where filters and primaries meet at these wavelengths."""
    return np.asarray(MATRIX * np.exp(band_weights(wavelengths_nm) @ np.log(reflectance)))


def light(phase: np.ndarray, gamma: float = 2.0) -> np.ndarray:
    """Return what the projector sends at a phase, (..., 3) in 0..1."""
    return np.asarray((0.5 + 0.5 * np.cos(phase[..., None] + _DELAYS)) ** gamma)


def board(
    paints: list[str],
    shape: tuple[int, int] = (180, 240),
    *,
    noise: float = 1.0,
    broad: float = 0.25,
    gamma: float = 2.0,
    matrices: list[np.ndarray] | None = None,
    square_px: float | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Photograph columns of paints, or squares of a width.

    Returns levels (H, W, 3) float32 of 255, the true phase, rad, and the paints' numbers.
    """
    height, width = shape
    y, x = np.mgrid[:height, :width]
    phase = 2 * np.pi * y / PERIOD_PX + 0.02 * x
    numbers = np.minimum(x * len(paints) // width, len(paints) - 1)
    if square_px is not None:
        numbers = ((x // square_px + y // square_px) % len(paints)).astype(int)
    sent, image = light(phase, gamma), np.empty((*shape, 3))
    for number, paint in enumerate(paints):
        matrix = surface_matrix(PAINTS[paint], broad) if matrices is None else matrices[number]
        own = numbers == number
        image[own] = 240 * sent[own] @ matrix.T + 6 * matrix.sum(axis=1) + 4  # ambient light, and a pedestal
    image += noise * np.random.default_rng(4).standard_normal(image.shape)
    return np.clip(image, 0, 255).astype(np.float32), phase, numbers


#: Of the projector, by channel.
RESPONSE = np.tile(np.linspace(0, 1, 256) ** 2, (3, 1))


def board_decoder(*, response: bool = True, arch: str = "cpu", **settings) -> Decoder:
    calibration = Calibration(crosstalk_matrix=MATRIX, response=RESPONSE if response else None)
    return Decoder(DecodeSettings(white_level=255, **settings), calibration, arch=arch)


def paint_errors(frame, phase: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the constant and the RMS of the error of every paint, 5 px inside, rad."""
    error = np.angle(np.exp(1j * (frame.unwrapped_phase - phase)))
    inside = np.ones(numbers.shape, bool)
    for shift in (-5, 5):
        for axis in (0, 1):
            inside &= np.roll(numbers, shift, axis=axis) == numbers
    inside[:6] = inside[-6:] = False
    constants = np.array([np.nanmean(error[inside & (numbers == n)]) for n in np.unique(numbers)])
    rms = np.array([np.nanstd(error[inside & (numbers == n)]) for n in np.unique(numbers)])
    return constants, rms
