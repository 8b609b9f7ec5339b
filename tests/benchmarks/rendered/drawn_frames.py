"""Frames of a drawn rig: its patterns' light, what its camera stores of it, and its calibration by its own ramps."""

import pickle
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from drawn_rigs import DrawnRig, draw_rig
from drawn_scenes import Scene, draw_scene
from ray_caster import (
    F32,
    F64,
    NOTHING,
    RAYS,
    Bodies,
    Truth,
    cosine_directions,
    gather,
    photograph,
    pixel_rays,
    projector_numbers,
    rays_of,
    rows_of_rays,
    true_at_centers,
)

from pipeline.calibration import Calibration
from pipeline.calibration.model import choose_pattern
from pipeline.calibration.radiometry import measure_radiometry, radiometry_codes, radiometry_sequence
from pipeline.models import CodeChoice
from pipeline.pattern import CHANNEL_PHASES, make_pattern

#: The patterns of `Photographer.codes`: their code, and whether the projector's response is undone in them.
PATTERNS: dict[str, tuple[CodeChoice, bool]] = {
    "plain": ("none", False),
    "coded": ("contrast", False),
    "compensated coded": ("contrast", True),
    "coded2": ("contrast2", False),
    "compensated coded2": ("contrast2", True),
}
# Steps a projector pixel in the pictures of light, dark pixels around them, and px of blur from level to level.
_STEPS, _MARGIN, _LEVEL_PX = 2, 12, 0.5
# Nothing that scatters is nearer to the projector than this part of the rig's distance.
_NEAREST = 0.75
# Px from place to place where the light of one bounce more is gathered, and from how many directions.
_SPACING, _DIRECTIONS = 6, 400
# The brightest half per cent under full white reaches this part of full scale, the pedestal apart.
_BRIGHTEST = 0.86
_LIT_LEVELS = 8.0  # of 255, amplitude


class Photographer:
    """Photographs scenes before a rig."""

    def __init__(self, rig: DrawnRig, rays: int = RAYS) -> None:
        self.rig = rig
        self.geometry = rig.calibration.geometry()
        self.rays = rays_of(self.geometry)
        self.pairs = rays // 2
        self._offsets = pixel_rays(rig.camera_blur_px, rays)
        self._projector = projector_numbers(self.geometry)
        self.calibration = self._calibrated()

    # --- light -----------------------------------------------------------------------------------------------------

    def codes(self, pattern: str) -> F32:
        """Return a picture of codes, (rows, columns, 3) 0..1 in steps of 1/255: one of PATTERNS, or "shift K"."""
        size = self.geometry.projector.size_px
        if pattern.startswith("shift"):  # the plain pattern, moved by thirds of a cycle
            cycles = np.arange(size[self.geometry.phase_axis]) / self.geometry.pattern.period_px + int(pattern[-1]) / 3
            picture = self.filled(0.5 + 0.5 * np.cos(2 * np.pi * cycles[:, None] + np.array(CHANNEL_PHASES)))
        else:
            code, compensated = PATTERNS[pattern]
            response = self.calibration.response if compensated else None
            picture = make_pattern(size, choose_pattern(self.rig.calibration, None, None, code), response)
        return np.rint(picture * 255) / 255

    def filled(self, line: npt.ArrayLike) -> F32:
        """Return a picture of codes that are a colour, (3,), or a line of them along the phase, (N, 3)."""
        line = np.asarray(line, np.float32)
        rows = line[:, None] if line.ndim == 2 and self.geometry.phase_axis else line
        return np.broadcast_to(rows, (*self.geometry.projector.size_px[::-1], 3))

    def _blurred(self, pictures: list[F32], levels: int) -> F32:
        """Return the light of each primary, (levels of blur, rows, columns, 3 * pictures), in steps: 0.5 GB a level."""
        rig, (width, height) = self.rig, self.geometry.projector.size_px
        shape = (_STEPS * (height + 2 * _MARGIN), _STEPS * (width + 2 * _MARGIN))
        found = np.empty((levels, *shape, 3 * len(pictures)), np.float32)
        for number, codes in enumerate(pictures):
            light = (rig.black + (1 - rig.black) * codes ** np.array(rig.gammas)).astype(np.float32)
            padded = np.pad(light, ((_MARGIN, _MARGIN), (_MARGIN, _MARGIN), (0, 0)))
            fine = padded.repeat(_STEPS, axis=0).repeat(_STEPS, axis=1)
            for level in range(levels):
                # Steps, and straight lines between them, blur by a twelfth of a step's square.
                blur = np.sqrt(_STEPS**2 * (rig.projector_blur_px**2 + (_LEVEL_PX * level) ** 2) - 1 / 12)
                found[level, ..., 3 * number : 3 * number + 3] = cv2.GaussianBlur(fine, (0, 0), blur)
        return found

    def arriving(self, scene: Scene, pictures: list[F32]) -> F32:
        """Return the light that these pictures of codes send, (levels of blur, rows, columns, 3 * K) in steps."""
        most_mm = max((max(mm) for mm in scene.scatter_mm.values()), default=0.0)
        most_px = most_mm * self.geometry.projector.matrix[0, 0] / (_NEAREST * self.rig.distance_mm)
        return self._blurred(pictures, 1 + int(np.ceil(most_px / _LEVEL_PX)))

    def lights(self, scene: Scene, pictures: list[F32]) -> F32:
        """Return the linear light (K, H, W, 3) of frames under these pictures of codes."""
        packed, light = scene.packed(), self.arriving(scene, pictures)
        film = self.seen(scene, packed, light)
        if scene.bounces:
            film += self._bounced(scene, packed, light, len(pictures))
        return film

    def seen(
        self,
        scene: Scene,
        packed: Bodies,
        light: F32,
        rows: slice = slice(None),
        apart: bool = False,
        share: slice = slice(None),
    ) -> F32:
        """Return the linear light (K, H, W, 3) of rows without bounces; apart: (K * 3, H, W, 3), each primary's.

        Of the pixel's pairs of rays a share.
        """
        rig, rays = self.rig, rows_of_rays(self.rays, rows)
        films = light.shape[3] if apart else light.shape[3] // 3
        film = np.zeros((films, rays.shape[0] - 2, rays.shape[1] - 2, 3), np.float32)
        spread = np.zeros((len(scene.paints), 3))
        for paint, mm in scene.scatter_mm.items():
            spread[paint] = mm
        offsets = np.ascontiguousarray(self._offsets.reshape(2, -1, 2)[:, share]).reshape(-1, 2)
        photograph(
            rays, offsets, np.array(rig.camera_magnified), packed.kinds, packed.numbers, packed.reliefs,
            packed.maps, self._projector, np.array(rig.projector_magnified), light,
            np.array([_STEPS, _MARGIN, _LEVEL_PX]),
            np.stack([rig.matrix(paint) for paint in scene.paints]), rig.matrix(1.0),
            np.stack([rig.ambient_on(paint) for paint in scene.paints]), spread, film,
        )  # fmt: skip
        return film

    def _bounced(self, scene: Scene, packed: Bodies, light: F32, patterns: int) -> F32:
        """Return the light (K, H, W, 3) of one bounce more, interpolated on each body by itself."""
        width, height = self.geometry.camera.size_px
        grid = np.zeros((patterns, -(-height // _SPACING) + 1, -(-width // _SPACING) + 1, 3), np.float32)
        pairs = [self.rig.matrix(one * other) for one in scene.paints for other in scene.paints]
        gather(
            self.rays, cosine_directions(_DIRECTIONS), packed.kinds, packed.numbers, packed.reliefs, packed.maps,
            self._projector, light, np.array([_STEPS, _MARGIN], np.float64),
            np.ascontiguousarray(np.stack(pairs)[..., None]), _SPACING, grid,
        )  # fmt: skip
        body = true_at_centers(self.geometry, packed).body
        x, y = np.meshgrid(*(np.arange(n, dtype=np.float32) / _SPACING for n in (width, height)))
        rows, columns = (
            np.minimum(np.arange(n) * _SPACING, most - 1)
            for n, most in zip(grid.shape[1:3], (height, width), strict=True)
        )
        of_grid, result = body[rows[:, None], columns], np.zeros((patterns, height, width, 3), np.float32)
        for number in np.unique(body[body != NOTHING]):
            on = (of_grid == number).astype(np.float32)
            share = np.maximum(cv2.remap(on, x, y, cv2.INTER_LINEAR), 1e-3)[..., None]
            here = body == number
            for p in range(patterns):
                result[p][here] = (cv2.remap(grid[p] * on[..., None], x, y, cv2.INTER_LINEAR) / share)[here]
        return result

    # --- the camera ------------------------------------------------------------------------------------------------

    def exposure(self, white: F32) -> float:
        """Return by what light is multiplied, as one who looks at a white picture would choose it."""
        return _BRIGHTEST / float(np.quantile(white.max(axis=2), 0.995))

    def _calibrated(self) -> Calibration:
        """Show the fields of `colorphase calibrate radiometry` to a white plane, and measure them."""
        plane = draw_scene("plane", self.rig, 0)
        fields = [self.filled(color) for color in ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1))]
        black, *primaries, white = self.lights(plane, fields)
        exposure, captures = self.exposure(white), {}
        gammas = np.array(self.rig.gammas)
        names = radiometry_sequence(self.geometry.projector.size_px).names
        for number, name in enumerate(names):
            light = black.astype(np.float64)
            for part, code in zip(primaries, np.asarray(radiometry_codes(name)) ** gammas, strict=True):
                light = light + (part - black) * code
            captures[name] = self._delivered(sensed(self.rig, light, exposure, 1000 + number))
        found = measure_radiometry(captures, transfer="linear", white_level=2**self.rig.bits - 1)
        return found.add_to(self.rig.calibration)

    def _delivered(self, levels: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return a picture (H, W, 3) of what the sensor says."""
        if levels.ndim == 3:
            return levels
        return cv2.cvtColor(levels, cv2.COLOR_BayerRGGB2RGB)


def mosaicked(signal: F64) -> F64:
    """Return the values of a sensor with red in the corner, (H, W)."""
    picked = np.empty(signal.shape[:2])
    for row, column, channel in ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2)):
        picked[row::2, column::2] = signal[row::2, column::2, channel]
    return picked


def sensed(rig: DrawnRig, light: F32 | F64, exposure: float, seed: int | None) -> npt.NDArray[Any]:
    """Return what the sensor says, (H, W, 3), or (H, W) of a mosaic; without a seed 16 bits and no noise."""
    signal = exposure * light.astype(np.float64)
    bits = 16 if seed is None else rig.bits
    if seed is not None:
        if rig.delivery != "rgb":
            signal = mosaicked(signal)
        rng = np.random.default_rng(seed)
        electrons = rng.poisson(np.clip(rig.full_well * signal, 0, None)) + rng.normal(0, rig.read_noise, signal.shape)
        signal = electrons / rig.full_well
    levels = np.clip(rig.pedestal + (1 - rig.pedestal) * signal, 0, 1)
    return np.rint(levels * (2**bits - 1)).astype(np.uint8 if bits == 8 else np.uint16)


@dataclass
class Taken:
    """All frames of one scene before one rig."""

    rig: DrawnRig
    measured: Calibration  # by the rig's own ramps
    scene: Scene
    seed: int  # of the noise
    light: dict[str, F32]  # (H, W, 3) by pattern
    exposure: float
    amplitude: F32  # (H, W) levels of 255, the mean of the channels
    truth: Truth

    @property
    def lit(self) -> npt.NDArray[np.bool_]:
        """Where the fringe is strong enough to be measured, and nothing is clipped."""
        clipped = self.light["plain"].max(axis=2) * self.exposure >= 1
        return (self.amplitude >= _LIT_LEVELS) & self.truth.lit & ~clipped

    @property
    def phase(self) -> F64:
        """True phase, rad; 0 where there is nothing."""
        return 2 * np.pi / self.measured.pattern.period_px * np.nan_to_num(self.truth.place)


def take(photographer: Photographer, name: str, seed: int) -> Taken:
    """Return a scene before a rig."""
    scene = draw_scene(name, photographer.rig, seed)
    pictures = [photographer.codes(name) for name in ("shift 1", "shift 2", *PATTERNS)]
    first, second, *lights, white = photographer.lights(scene, [*pictures, np.ones_like(pictures[0])])
    exposure = photographer.exposure(white)
    wave = sum(light * np.exp(-2j * np.pi * k / 3) for k, light in enumerate((first, second, lights[0]), 1))
    return Taken(
        photographer.rig,
        photographer.calibration,
        scene,
        seed + 1,
        dict(zip(PATTERNS, lights, strict=True)),
        exposure,
        (np.abs(wave).mean(axis=2) * (2 / 3 * 255 * exposure)).astype(np.float32),
        true_at_centers(photographer.geometry, scene.packed()),
    )


@lru_cache(1)
def photographer_of(seed: int) -> Photographer:
    """Return a rig with its calibration, which takes time: for one scene after the other."""
    return Photographer(draw_rig(seed))


def kept(seed: int, name: str, folder: Path) -> Taken:
    """Return a scene before a rig, as a folder keeps it, or rendered and kept there."""
    path = folder / f"{seed}-{name.replace(' ', '_')}.pickle"
    if not path.exists():
        path.write_bytes(pickle.dumps(take(photographer_of(seed), name, seed)))
    return pickle.loads(path.read_bytes())
