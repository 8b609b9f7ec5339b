"""Take frames: a scene, a pattern and a light become the linear light of a frame, kept on disk; and its calibration."""

import ast
import hashlib
import inspect
import os
import textwrap
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import camera_film
import interreflection
import numpy as np
import numpy.typing as npt
import ray_samples
from camera_film import (
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
from ray_samples import Room, Samples, paints_of, rig
from rendered_scenes import RenderedScene, mesh_of, scenes
from spectra import CAMERAS, INDUSTRIAL, LED, PROJECTORS, effective_matrix, reflectance

from pipeline.calibration import Calibration
from pipeline.calibration.radiometry import measure_radiometry, radiometry_codes, radiometry_sequence
from pipeline.pattern import make_pattern

#: Kinds of pattern: three sinusoids; the same with the contrast code; with the projector's response undone.
PATTERNS = ("plain", "coded", "compensated")
#: Full fields, as the codes of red, green and blue.
FIELDS = {"black": (0, 0, 0), "red": (1, 0, 0), "green": (0, 1, 0), "blue": (0, 0, 1), "white": (1, 1, 1)}
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


def _syntax(*sources: str) -> bytes:
    """Return what code does, for a digest: its syntax, which comments, docstrings and imports are no part of."""
    dumps = []
    for source in sources:
        tree = ast.parse(source)
        tree.body = [node for node in tree.body if not isinstance(node, ast.Import | ast.ImportFrom)]
        for node in ast.walk(tree):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node) is not None:
                node.body = node.body[1:]
        dumps.append(ast.dump(tree))
    return "".join(dumps).encode()


# Part of every kept frame's name, so that none outlives the code that made it.
_SOURCES = _syntax(*(inspect.getsource(module) for module in (ray_samples, camera_film, interreflection)))


def _describe(scene: RenderedScene, taken_with: "Rig | None") -> bytes:
    """Return all that a scene's frames depend on: its bodies, their paints' spectra, and its motion."""
    words: list[object] = [_INSTANTS, _INSTANTS_A_FIELD, scene.bounces, scene.motion_mm, scene.in_turns, scene.start]
    words += [scene.focus_mm, scene.defocus_px, scene.surfaces]
    described = _syntax(*(textwrap.dedent(inspect.getsource(part)) for part in (Studio._render, Studio._instants)))
    for body in scene.bodies:
        words += [{name: np.asarray(value).tolist() for name, value in body.shape.items()}]
        words += [body.moves, body.gloss, body.shininess, len(body.paints)]
        if body.painter is not None:
            described += _syntax(inspect.getsource(body.painter))
        if body.shape["type"] == "mesh":
            described += b"".join(part.tobytes() for part in mesh_of(body))
    if taken_with is not None:
        light = taken_with.light()
        words += [taken_with]
        described += light.matrices(scene).tobytes() + light.ambient_colors(scene).tobytes()
        described += effective_matrix(light.projector, light.camera).tobytes()
        if scene.bounces > 1:
            described += b"".join(reflectance(name).tobytes() for name in paints_of(scene))
    return repr(words).encode() + described


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
        self._calibrations: dict[Rig, Calibration] = {}

    # --- what is shown ---------------------------------------------------------------------------------------------

    def codes(self, taken_with: Rig, pattern: str) -> npt.NDArray[np.float64]:
        """Return the (rows, 3) codes, 0..1 in steps of 1/255, of a pattern."""
        known = self.geometry.pattern
        if pattern == "coded":
            known = known.model_copy(update={"code": "contrast"})
        response = self.calibration(taken_with).response if pattern == "compensated" else None
        picture = make_pattern(self.geometry.projector.size_px, known, response)
        return np.rint(picture[:, 0].astype(np.float64) * 255) / 255

    def _shown(self, taken_with: Rig, pattern: str) -> npt.NDArray[np.float64]:
        """Return the (rows, 3) codes of a pattern, or of a full field."""
        if pattern in FIELDS:
            return np.tile(np.array(FIELDS[pattern], np.float64), (self.geometry.projector.size_px[1], 1))
        return self.codes(taken_with, pattern)

    # --- frames ----------------------------------------------------------------------------------------------------

    def light(self, scene_name: str, pattern: str = "plain", taken_with: Rig = _RIG) -> F32:
        """Return the linear light (H, W, 3) of a frame; the pattern is one of `PATTERNS` or of `FIELDS`."""
        scene, codes = scenes()[scene_name], self._shown(taken_with, pattern)
        kept = self._kept(f"{scene_name}-{pattern}", _describe(scene, taken_with), codes.tobytes())
        if not kept.exists():
            optics = taken_with.optics
            period_px = self.geometry.pattern.period_px
            row_light = IdealLight(period_px) if optics.point else RowLight(codes, optics, scene.defocus_px)
            _write(kept, light=self._render(scene, row_light, taken_with))
        with np.load(kept) as file:
            return file["light"]

    def truth(self, scene_name: str) -> Truth:
        """Return what is true of a scene in the middle of the exposure."""
        scene = scenes()[scene_name]
        kept = self._kept(f"{scene_name}-truth", _describe(scene, None))
        if not kept.exists():
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
        if taken_with not in self._calibrations:
            self._calibrations[taken_with] = self._measured(taken_with)
        return self._calibrations[taken_with]

    def _measured(self, taken_with: Rig) -> Calibration:
        """Show the full fields of `colorphase calibrate radiometry` to the white plane, and measure them."""
        # Light adds up, so that of every full field follows from black and the three primaries.
        black = self.light("plane", "black", taken_with)
        primaries = [self.light("plane", color, taken_with) - black for color in ("red", "green", "blue")]
        exposure, captures = self.exposure("plane", taken_with), {}
        for number, name in enumerate(radiometry_sequence(self.geometry.projector.size_px).names):
            light = sum((part * np.float32(code**taken_with.optics.gamma) for part, code in
                         zip(primaries, radiometry_codes(name), strict=True)), start=black)  # fmt: skip
            captures[name] = Sensor().expose(light, exposure, seed=1000 + number)
        return measure_radiometry(captures, transfer="linear").add_to(rig())

    def _kept(self, name: str, *depends_on: bytes) -> Path:
        return self._folder / f"{name}-{hashlib.sha256(b''.join((_SOURCES, *depends_on))).hexdigest()[:16]}.npz"


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
