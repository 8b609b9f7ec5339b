"""Take frames: a scene, a pattern and a light become the linear light of a frame, kept on disk; and its calibration."""

import ast
import hashlib
import os
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
from film import (
    F32,
    SUBPIXELS,
    IdealLight,
    Light,
    Optics,
    RowLight,
    Sensor,
    Truth,
    pixel_grid,
    to_pixels,
    true_at_centers,
)
from interreflection import indirect_light
from ray_samples import Room, Samples, rig
from rendered_scenes import RenderedScene, scenes
from spectra import CAMERAS, INDUSTRIAL, LED, PROJECTORS

from pipeline.calibration import Calibration
from pipeline.calibration.radiometry import measure_radiometry, radiometry_codes, radiometry_sequence
from pipeline.pattern import make_pattern

#: Kinds of pattern: three sinusoids; the same with the contrast code; with the projector's response undone.
PATTERNS = ("plain", "coded", "compensated")
# Instants of an exposure during which something moves, and of one colour's part of it.
_INSTANTS = 9
_INSTANTS_A_FIELD = 3
# The brightest half per cent under full white reaches this part of full scale, the pedestal apart.
_BRIGHTEST = 0.86


_OPTICS = Optics()


@dataclass(frozen=True)
class Rig:
    """Projector, camera and their optics, by name, so that frames can be kept under what they were taken with."""

    projector: str = LED.name
    camera: str = INDUSTRIAL.name
    optics: Optics = _OPTICS

    def light(self) -> Light:
        """Return what shades samples."""
        return Light(PROJECTORS[self.projector], CAMERAS[self.camera], self.optics)


_RIG = Rig()


def default_folder() -> Path:
    """Return where frames are kept: a folder of the user's cache."""
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "colorphase-rendered"


def _digest_of_sources() -> bytes:
    """Return a digest of what the renderer does: of its syntax, which comments and line breaks are no part of."""
    digest = hashlib.sha256()
    for name in ("spectra", "rendered_scenes", "ray_samples", "film", "interreflection", "studio"):
        tree = ast.parse(Path(__file__).with_name(f"{name}.py").read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node) is not None:
                node.body = node.body[1:]
        digest.update(ast.dump(tree).encode())
    return digest.digest()


# Part of every kept frame's name, so that none outlives the code that made it.
_SOURCES = _digest_of_sources()


class Studio:
    """Takes frames and keeps them.

    Parameters
    ----------
    folder : Path, optional
        Where; None: the user's cache.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = folder or default_folder()
        self._folder.mkdir(parents=True, exist_ok=True)
        self.geometry = rig().geometry()

    # --- what is shown ---------------------------------------------------------------------------------------------

    def codes(self, taken_with: Rig, pattern: str) -> npt.NDArray[np.float64]:
        """Return the (rows, 3) codes, 0..1 in steps of 1/255, of a pattern."""
        known = self.geometry.pattern
        if pattern == "coded":
            known = known.model_copy(update={"code": "contrast"})
        response = self.calibration(taken_with).response if pattern == "compensated" else None
        picture = make_pattern(self.geometry.projector.size_px, known, response)
        return np.rint(picture[:, 0].astype(np.float64) * 255) / 255

    def _row_light(self, taken_with: Rig, pattern: str, scene: RenderedScene) -> RowLight | IdealLight:
        if taken_with.optics.point:
            return IdealLight(self.geometry.pattern.period_px)
        return RowLight(self._shown(taken_with, pattern), taken_with.optics, scene.defocus_px)

    def _shown(self, taken_with: Rig, pattern: str) -> npt.NDArray[np.float64]:
        if pattern == "white":
            return np.ones((self.geometry.projector.size_px[1], 3))
        return self.codes(taken_with, pattern)

    # --- frames ----------------------------------------------------------------------------------------------------

    def light(self, scene_name: str, pattern: str = "plain", taken_with: Rig = _RIG) -> F32:
        """Return the linear light (H, W, 3) of a frame, of one that the camera's full scale is the same for."""
        kept = self._kept("light", scene_name, pattern, repr(taken_with))
        if not kept.exists():
            scene = scenes()[scene_name]
            _write(kept, light=self._render(scene, self._row_light(taken_with, pattern, scene), taken_with))
        with np.load(kept) as file:
            return file["light"]

    def truth(self, scene_name: str) -> Truth:
        """Return what is true of a scene in the middle of the exposure."""
        kept = self._kept("truth", scene_name)
        if not kept.exists():
            scene = scenes()[scene_name]
            middle = Room(scene, self.geometry, np.array(scene.motion_mm) * scene.start)
            _write(kept, **vars(true_at_centers(middle, self.geometry.pattern.period_px)))
        with np.load(kept) as file:
            return Truth(**file)

    def exposure(self, scene_name: str, taken_with: Rig = _RIG) -> float:
        """Return by what light is multiplied, as one who looks at a white picture would choose it."""
        light = self.light(scene_name, "white", replace(taken_with, optics=replace(taken_with.optics, point=False)))
        return _BRIGHTEST / float(np.quantile(light.max(axis=2), 0.995))

    def frame(
        self, scene_name: str, pattern: str, sensor: Sensor, taken_with: Rig = _RIG, seed: int = 1
    ) -> npt.NDArray[np.uint8] | npt.NDArray[np.uint16]:
        """Return the levels of a frame."""
        return sensor.expose(self.light(scene_name, pattern, taken_with), self.exposure(scene_name, taken_with), seed)

    def _render(self, scene: RenderedScene, row_light: RowLight | IdealLight, taken_with: Rig) -> F32:
        light, optics = taken_with.light(), taken_with.optics
        subpixels = 1 if optics.point else SUBPIXELS
        size = self.geometry.camera.size_px
        total: F32 | float = 0.0
        instants = self._instants(scene)
        for offset_mm, channels in instants:
            samples = _samples(scene.name, offset_mm, subpixels)
            part = light.shade(scene, samples, _Only(row_light, channels))
            total = total + part / len(instants)
        film = to_pixels(np.asarray(total), size, subpixels, 0.0 if optics.point else optics.camera_blur_px)
        if scene.bounces > 1:
            film += indirect_light(scene, light, row_light)
        return film

    @staticmethod
    def _instants(scene: RenderedScene) -> list[tuple[tuple[float, ...], npt.NDArray[np.float32]]]:
        """Return where the bodies that move are at each instant, mm, and how bright the primaries are then."""
        motion = np.array(scene.motion_mm)
        if scene.in_turns:
            times = [(field, (field + (k + 0.5) / _INSTANTS_A_FIELD) / 3 - 0.5) for field in range(3)
                     for k in range(_INSTANTS_A_FIELD)]  # fmt: skip
            # Each colour is on for a third of the time, and the exposure is chosen for all of it.
            return [
                (tuple(motion * (scene.start + time)), 3 * np.eye(3, dtype=np.float32)[field]) for field, time in times
            ]
        times = (np.arange(_INSTANTS) + 0.5) / _INSTANTS - 0.5 if motion.any() else np.zeros(1)
        return [(tuple(motion * (scene.start + time)), np.ones(3, np.float32)) for time in times]

    # --- calibration -----------------------------------------------------------------------------------------------

    def calibration(self, taken_with: Rig = _RIG) -> Calibration:
        """Return the rig's true geometry, with matrix and response as ramps on a white plane tell them."""
        kept = self._kept("calibration", repr(taken_with)).with_suffix(".json")
        if not kept.exists():
            self._measured(taken_with).write(kept)
        return Calibration.read(kept)

    def _measured(self, taken_with: Rig) -> Calibration:
        """Show the full fields of `colorphase calibrate radiometry` to the white plane, and measure them."""
        rows = self.geometry.projector.size_px[1]
        scene, optics = scenes()["plane"], taken_with.optics

        def field(codes: npt.NDArray[np.float64]) -> F32:
            return self._render(scene, RowLight(np.broadcast_to(codes, (rows, 3)), optics), taken_with)

        # Light adds up, so that of every full field follows from black and the three primaries.
        black = field(np.zeros(3))
        primaries = [field(np.eye(3)[k]) - black for k in range(3)]
        exposure, captures = self.exposure("plane", taken_with), {}
        for number, name in enumerate(radiometry_sequence(self.geometry.projector.size_px).names):
            light = sum((part * np.float32(code**optics.gamma) for part, code in
                         zip(primaries, radiometry_codes(name), strict=True)), start=black)  # fmt: skip
            captures[name] = Sensor().expose(light, exposure, seed=1000 + number)
        return measure_radiometry(captures, transfer="linear").add_to(rig())

    def _kept(self, kind: str, *description: str) -> Path:
        digest = hashlib.sha256(_SOURCES + "\n".join((kind, *description)).encode()).hexdigest()[:16]
        named = description[:2] if kind == "light" else ()
        return self._folder / f"{'-'.join((kind, *named, digest))}.npz"


class _Only:
    """Light of some of the primaries."""

    def __init__(self, row_light: RowLight | IdealLight, channels: npt.NDArray[np.float32]) -> None:
        self._row_light, self._channels = row_light, channels

    def at(self, rows: F32, extra_px: F32 | None = None) -> F32:
        return self._row_light.at(rows, extra_px) * self._channels


@lru_cache(maxsize=9)
def _samples(scene_name: str, offset_mm: tuple[float, ...], subpixels: int) -> Samples:
    geometry = rig().geometry()
    return Room(scenes()[scene_name], geometry, offset_mm).look(pixel_grid(geometry.camera.size_px, subpixels))


def _write(path: Path, **arrays: npt.NDArray[np.generic]) -> None:
    """Write arrays whole or not at all."""
    part = path.with_suffix(".part.npz")
    np.savez(part, **arrays)
    part.replace(path)
