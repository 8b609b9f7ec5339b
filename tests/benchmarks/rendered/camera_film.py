"""From samples to the light on the camera's pixels, and from that to what the sensor says.

Every pixel is the mean of SUBPIXELS x SUBPIXELS samples, taken after the lens has blurred them.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt
from ray_samples import NOTHING, Room, Samples, paints_of
from rendered_scenes import RenderedScene
from spectra import Camera, Projector, ambient_color, effective_matrix, reflectance

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]

#: Samples along each side of a pixel.
SUBPIXELS = 4
# Steps a projector pixel in the tables of light, and the blurs they are for.
_STEPS = 32
_BLURS = 12


@dataclass(frozen=True)
class Optics:
    """What lies between the projector's codes and the camera's pixels."""

    gamma: float = 2.0  # the projector's light is code ** gamma
    projector_blur_px: float = 0.6  # sigma of its lens
    camera_blur_px: float = 0.5  # sigma of the camera's
    ambient: float = 0.03  # of the projector's white, of an equal-energy light
    point: bool = False  # whether a pixel is its centre, and the pattern continuous instead of made of pixels


class RowLight:
    """The projector's light by row and blur, (3,) of the full light of each primary.

    Parameters
    ----------
    codes : (rows, 3) float
        Projector codes, 0..1, of one column.
    optics : Optics
        Response and blur.
    defocus_px : float
        The widest additional blur that is asked for.
    """

    def __init__(self, codes: npt.NDArray[np.floating], optics: Optics, defocus_px: float = 0.0) -> None:
        light = np.asarray(codes, np.float64) ** optics.gamma
        # A row of light is as wide as its pixel; beyond the picture it is dark.
        self._margin = 16
        fine = np.repeat(np.pad(light, ((self._margin, self._margin), (0, 0))), _STEPS, axis=0)
        self._extra = np.linspace(0, defocus_px, _BLURS if defocus_px else 1)
        self._tables = [self._blurred(fine, np.hypot(optics.projector_blur_px, extra)) for extra in self._extra]

    @staticmethod
    def _blurred(fine: F64, sigma_px: float) -> F32:
        if sigma_px > 0:
            fine = cv2.GaussianBlur(
                fine, (1, 0), sigmaX=1e-3, sigmaY=sigma_px * _STEPS, borderType=cv2.BORDER_REPLICATE
            )
        return fine.astype(np.float32)

    def at(self, rows: F32, extra_px: F32 | None = None) -> F32:
        """Return the light, (N, 3), at rows (N,), under an additional blur (N,)."""
        place = (np.clip(rows, -1, 1e4) + 0.5 + self._margin) * _STEPS - 0.5
        place = np.clip(place, 0, len(self._tables[0]) - 2)
        if extra_px is None or len(self._tables) == 1:
            return _interpolated(self._tables[0], place)
        level = np.clip(extra_px / self._extra[1], 0, len(self._tables) - 1.001)
        low = level.astype(np.intp)
        part = (level - low)[:, None].astype(np.float32)
        result = np.zeros((len(rows), 3), np.float32)
        for k in range(len(self._tables) - 1):
            on = low == k
            here, next_one = (_interpolated(self._tables[k + step], place[on]) for step in (0, 1))
            result[on] = here + part[on] * (next_one - here)
        return result


def _interpolated(table: F32, place: F32) -> F32:
    low = place.astype(np.intp)
    part = (place - low)[:, None].astype(np.float32)
    return table[low] * (1 - part) + table[low + 1] * part


class IdealLight:
    """A continuous pattern of full contrast under a linear response; for the check of the truth."""

    def __init__(self, period_px: float) -> None:
        self._period = period_px

    def at(self, rows: F32, extra_px: F32 | None = None) -> F32:
        """Return the light, (N, 3), at rows (N,)."""
        phase = 2 * np.pi / self._period * rows.astype(np.float64)[:, None] + 2 * np.pi / 3 * np.arange(-1, 2)
        return (0.5 + 0.5 * np.cos(phase)).astype(np.float32)


def pixel_grid(size_px: tuple[int, int], subpixels: int) -> F64:
    """Return the (N, 2) places of the film's samples, row by row."""
    across, down = ((np.arange(subpixels * n) + 0.5) / subpixels - 0.5 for n in size_px)
    x, y = np.meshgrid(across, down)
    return np.stack([x.ravel(), y.ravel()], axis=-1)


@dataclass(frozen=True)
class Light:
    """Projector and camera, as one matrix and one ambient colour a paint."""

    projector: Projector
    camera: Camera
    optics: Optics

    def matrices(self, scene: RenderedScene) -> F64:
        """Return the matrix of every paint of a scene, (paints, 3, 3)."""
        return np.stack([effective_matrix(self.projector, self.camera, reflectance(name)) for name in paints_of(scene)])

    def ambient_colors(self, scene: RenderedScene) -> F64:
        """Return what the channels see of the ambient light on every paint of a scene, (paints, 3)."""
        colors = [ambient_color(self.projector, self.camera, reflectance(name)) for name in paints_of(scene)]
        return self.optics.ambient * np.stack(colors)

    def shade(self, scene: RenderedScene, samples: Samples, row_light: RowLight | IdealLight) -> F32:
        """Return the camera's linear light of every sample, (N, 3), of light that has bounced once."""
        extra = None
        if scene.focus_mm is not None:
            extra = scene.defocus_px * np.abs(1 - scene.focus_mm / samples.distance)
        projected = row_light.at(samples.row, extra)
        result = np.zeros_like(projected)
        clear = effective_matrix(self.projector, self.camera)
        for number, (matrix, around) in enumerate(zip(self.matrices(scene), self.ambient_colors(scene), strict=True)):
            on = samples.paint == number
            light = (projected[on] @ matrix.T.astype(np.float32)) * samples.diffuse[on, None]
            if samples.glossy[on].any():
                light += (projected[on] @ clear.T.astype(np.float32)) * samples.glossy[on, None]
            result[on] = light + around.astype(np.float32)
        return result


def to_pixels(light: F32, size_px: tuple[int, int], subpixels: int, blur_px: float) -> F32:
    """Return (H, W, 3) light of the pixels: the samples, blurred by the lens, and their mean over each pixel."""
    width, height = size_px
    film = light.reshape(height * subpixels, width * subpixels, 3)
    if blur_px > 0:
        film = cv2.GaussianBlur(film, (0, 0), blur_px * subpixels, borderType=cv2.BORDER_REPLICATE)
    return film.reshape(height, subpixels, width, subpixels, 3).mean(axis=(1, 3), dtype=np.float64).astype(np.float32)


@dataclass(frozen=True)
class Truth:
    """What is true at the pixels' centres, (H, W)."""

    projector_row: F64  # px; NaN where there is nothing
    depth_mm: F32
    lit: npt.NDArray[np.bool_]
    surface: npt.NDArray[np.uint8]  # number in the scene's `surfaces`; NOTHING
    mm_per_rad: F32  # by how much the depth along the ray changes with the phase


def true_at_centers(room: Room, period_px: float) -> Truth:
    """Return the truth of a scene."""
    geometry = room.geometry
    width, height = geometry.camera.size_px
    samples = room.look(pixel_grid((width, height), 1))
    there = samples.body != NOTHING
    rays = geometry.camera.rays().reshape(-1, 2).astype(np.float64)
    rays = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
    depth = samples.depth.astype(np.float64)

    def row_at(distance: F64) -> F64:
        at = (rays * distance[:, None]) @ geometry.rotation.T + geometry.translation_mm
        return at[:, 1] / at[:, 2] * geometry.projector.matrix[1, 1] + geometry.projector.matrix[1, 2]

    slope = (row_at(depth + 0.5) - row_at(depth - 0.5)) * 2 * np.pi / period_px
    shape = (height, width)
    return Truth(
        projector_row=np.where(there, row_at(depth), np.nan).reshape(shape),
        depth_mm=samples.depth.reshape(shape),
        lit=(samples.diffuse > 0).reshape(shape),
        surface=samples.surface.reshape(shape),
        mm_per_rad=(1 / slope).astype(np.float32).reshape(shape),
    )


@dataclass(frozen=True)
class Sensor:
    """How light becomes levels."""

    bits: int = 8
    noise: bool = True
    mosaic: bool = False
    full_well: float = 10_000.0  # electrons
    read_noise: float = 5.0  # electrons
    pedestal: float = 0.02  # of full scale

    def expose(self, light: F32, exposure: float, seed: int = 0) -> npt.NDArray[np.uint8] | npt.NDArray[np.uint16]:
        """Return levels (H, W, 3), or of a mosaic (H, W), red in the corner, from linear light."""
        signal = exposure * light.astype(np.float64)
        if self.mosaic:
            picked = np.zeros(signal.shape[:2])
            for row, column, channel in ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2)):
                picked[row::2, column::2] = signal[row::2, column::2, channel]
            signal = picked
        if self.noise:
            rng = np.random.default_rng(seed)
            electrons = self.full_well * signal
            electrons = rng.poisson(electrons) + rng.normal(0, self.read_noise, signal.shape)
            signal = electrons / self.full_well
        white = 2**self.bits - 1
        levels = np.rint(np.clip(self.pedestal + (1 - self.pedestal) * signal, 0, 1) * white)
        return levels.astype(np.uint8 if self.bits == 8 else np.uint16)


def noise_free(sensor: Sensor) -> Sensor:
    """Return the sensor that shows only what decoding itself does wrong: 16 bits and no noise."""
    return replace(sensor, bits=16, noise=False)
