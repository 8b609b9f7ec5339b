"""Simulated frames with one fault each, as `docs/troubleshooting.md` shows them."""

import json
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt
from support.exposures_off_cycle import exposed

from pipeline import Calibration, Decoder, DecodeSettings
from pipeline.decoding.frame import DecodedFrame
from pipeline.models import CodeName
from pipeline.output.range_image import write_png
from pipeline.pattern import make_pattern
from pipeline.simulation import TYPICAL_CROSSTALK, WHITE, SimulatedFrame, SimulationSettings, simulate_frame
from pipeline.simulation import simulated_rig as rig_of

CROSSTALK = np.array(TYPICAL_CROSSTALK)
GAMMA = 2.0
RESPONSE = np.tile(np.linspace(0, 1, 256) ** GAMMA, (3, 1))
_LENS = {"pixel_rays": 3, "projector_blur_px": (0.6, 0.6, 0.6)}  # pixels with an area, and a lens that blurs
_NOISE_LEVELS = 1.5  # the simulator's own
_SEED = 0


@dataclass(frozen=True, eq=False)
class Symptom:
    """A frame with a fault, and how its user decodes it."""

    image: npt.NDArray[np.uint8]  # (H, W, 3) RGB
    truth: SimulatedFrame | None = None
    calibration: Calibration | None = None
    settings: dict[str, Any] = field(default_factory=dict)
    jpeg_quality: int | None = None  # None: a PNG

    def write(self, folder: Path) -> Path:
        """Write the picture, with its calibration and settings, and return its path."""
        path = folder / ("frame.png" if self.jpeg_quality is None else "frame.jpg")
        if self.jpeg_quality is None:
            write_png(path, self.image)
        else:
            cv2.imwrite(str(path), self.image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, self.jpeg_quality])
        if self.calibration is not None:
            self.calibration.write(folder / "calibration.json")
        (folder / "settings.toml").write_text("".join(f"{key} = {json.dumps(v)}\n" for key, v in self.settings.items()))
        return path

    def decode(self, **instead: Any) -> DecodedFrame:
        """Decode it as its user does, or with another calibration or settings."""
        calibration = instead.get("calibration", self.calibration)
        settings = DecodeSettings.model_validate(instead.get("settings", self.settings))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return Decoder(settings, calibration, arch="cpu").decode(self.image)


def rig(code: CodeName | None = "contrast", **options: Any) -> Calibration:
    """Return the geometry of the demo's rig."""
    return rig_of(code=code, **options)


def calibrated(geometry: Calibration, **other: Any) -> Calibration:
    """Return a rig with the light that the simulator's default projector and camera have."""
    pattern = geometry.geometry().pattern.model_copy(update={"compensated": False})
    light = {"crosstalk_matrix": CROSSTALK, "response": RESPONSE, "pattern": pattern}
    return geometry.model_copy(update={**light, **other})


def photographed(geometry: Calibration, codes: npt.NDArray[np.float32] | None = None, **fault: Any) -> SimulatedFrame:
    """Photograph the bust, or another scene, with a fault."""
    return simulate_frame(geometry, SimulationSettings(**{**_LENS, "gamma": GAMMA, **fault}), codes)


def one_fault(
    *, code: Literal["contrast"] | None = "contrast", known: dict[str, Any] | None = None, **fault: Any
) -> Symptom:
    """Return a frame with a fault, and the calibration to decode it with; `known` is what that gets wrong."""
    truth = photographed(rig(code), **fault)
    return Symptom(_levels(truth), truth, calibrated(rig(code), **(known or {})))


def _levels(truth: SimulatedFrame) -> npt.NDArray[np.uint8]:
    return np.asarray(truth.image, np.uint8)


def _with_noise(light: npt.NDArray[np.floating]) -> npt.NDArray[np.uint8]:
    """Expose light, 0..1, as the simulator does."""
    noise = np.random.default_rng(_SEED).standard_normal(light.shape)
    return np.asarray(np.rint(255 * np.clip(light + _NOISE_LEVELS / 255 * noise, 0, 1)), np.uint8)


def _noise_free(geometry: Calibration, **settings: Any) -> tuple[SimulatedFrame, npt.NDArray[np.float64]]:
    truth = photographed(geometry, bits=16, noise_levels=0.0, **settings)
    return truth, truth.image / float(truth.white_level)


def vertical() -> Symptom:
    """Return a frame whose stripes run the other way than the settings say."""
    truth = photographed(rig(stripes="vertical"))
    return Symptom(_levels(truth), truth)


def too_fine() -> Symptom:
    """Return a frame with three px a cycle."""
    geometry = rig(None, period_px=4.5)
    truth = photographed(geometry)
    return Symptom(_levels(truth), truth, calibrated(geometry))


def no_pattern() -> Symptom:
    """Return a frame under a projector that shows grey."""
    grey = np.full((768, 1024, 3), 0.5, np.float32)
    return Symptom(_levels(photographed(rig(), grey)), None, calibrated(rig()))


def upside_down() -> Symptom:
    """Return the frame of a camera that was mounted the other way up than at calibration."""
    seen = one_fault()
    return Symptom(np.ascontiguousarray(seen.image[::-1]), None, seen.calibration)


def turned() -> Symptom:
    """Return a picture on its side, without a calibration."""
    return Symptom(np.ascontiguousarray(np.rot90(one_fault().image)))


def gloss() -> Symptom:
    """Return a frame with two highlights that mirror the projector, on forehead and cheek."""
    truth = photographed(rig())
    y, x = np.mgrid[: truth.image.shape[0], : truth.image.shape[1]]
    light = truth.image / 255
    for column, row, width_px in ((300, 180, 18), (372, 268, 12)):
        light += 2.0 * np.exp(-((x - column) ** 2 + (y - row) ** 2) / (2 * width_px**2))[..., None]
    return Symptom(np.asarray(np.rint(255 * np.clip(light, 0, 1)), np.uint8), truth, calibrated(rig()))


def transfer() -> Symptom:
    """Return an sRGB-coded PNG whose file does not say so, of a linear pattern, nothing equalised."""
    geometry = rig(None)
    truth = photographed(geometry, gamma=1.0, transfer="srgb", scene="waves")
    pattern = geometry.geometry().pattern.model_copy(update={"compensated": True})
    known = geometry.model_copy(update={"crosstalk_matrix": CROSSTALK, "pattern": pattern})
    return Symptom(_levels(truth), truth, known, {"equalize": False})


def unexplained() -> Symptom:
    """Return a frame under a compensated pattern, by a calibration without crosstalk, nothing equalised."""
    pattern = rig().geometry().pattern.model_copy(update={"compensated": True})
    known = {"crosstalk_matrix": np.eye(3), "response": None, "pattern": pattern}
    seen = one_fault(scene="waves", gamma=1.0, known=known)
    return replace(seen, settings={"equalize": False})


def other_pattern() -> Symptom:
    """Return a frame under a plain pattern, where the calibration's has the code."""
    truth = photographed(rig(None))
    return Symptom(_levels(truth), truth, calibrated(rig()))


def depth_range() -> Symptom:
    """Return a frame with a depth range that does not hold what is in view."""
    return one_fault(code=None, known={"depth_range_mm": (300.0, 500.0)})


def inside_out() -> Symptom:
    """Return a frame without a calibration, of a projector that is said to stand on the wrong side."""
    truth = photographed(rig())
    return Symptom(_levels(truth), truth, None, {"projector_side": "below", "code": "contrast"})


def code_not_told() -> Symptom:
    """Return a frame without a calibration, of whose code nobody has told."""
    truth = photographed(rig())
    return Symptom(_levels(truth), truth)


def _turned_projector(degrees: float) -> Calibration:
    angle = np.radians(degrees)
    turn = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    geometry = rig()
    assert geometry.rotation is not None and geometry.translation_mm is not None
    return geometry.model_copy(
        update={"rotation": turn @ geometry.rotation, "translation_mm": turn @ geometry.translation_mm}
    )


def projector_moved() -> Symptom:
    """Return a frame of a plane, after the projector was turned down by half a degree."""
    truth = photographed(_turned_projector(0.5), scene="plane")
    return Symptom(_levels(truth), truth, calibrated(rig()))


def pattern_moved() -> Symptom:
    """Return a frame under the second code, after the projector's picture was shifted by 16 px along the stripe."""
    geometry = rig("contrast2")
    truth, projector = photographed(geometry), geometry.geometry().projector
    matrix = projector.matrix - np.array([[0, 0, 16], [0, 0, 0], [0, 0, 0]])
    return Symptom(
        _levels(truth), truth, calibrated(geometry, projector=projector.model_copy(update={"matrix": matrix}))
    )


def wrong_scale() -> Symptom:
    """Return a ball by a board whose squares were taken for a fifth larger than they are: so is the baseline."""
    geometry = rig()
    assert geometry.translation_mm is not None
    return one_fault(scene="ball", known={"translation_mm": 1.2 * geometry.translation_mm})


def paint() -> Symptom:
    """Return a white plane with a blue disc and an orange square, sharper than the camera's pixels."""
    geometry = rig_of((1280, 960), code="contrast")
    _, fine = _noise_free(geometry, scene="plane", reflectance=WHITE, texture=0.0)
    color = np.ones(fine.shape)
    y, x = np.mgrid[: fine.shape[0], : fine.shape[1]]
    color[np.hypot(x - 460, y - 480) < 150] = (0.12, 0.2, 0.5)
    color[(abs(x - 820) < 130) & (abs(y - 480) < 130)] = (0.9, 0.35, 0.12)
    seen = cv2.resize(fine * color, (640, 480), interpolation=cv2.INTER_AREA)
    truth = photographed(rig(), scene="plane", reflectance=WHITE, texture=0.0)
    return Symptom(_with_noise(seen), truth, calibrated(rig()))


def lateral_color() -> Symptom:
    """Return a frame by a lens that puts red a pixel to one side of green and blue a pixel to the other."""
    return one_fault(camera_shift_px=np.array([[0, -1.0], [0, 0], [0, 1.0]]))


def subsampled() -> Symptom:
    """Return a JPEG with one colour for four pixels, in sRGB, as cameras write it."""
    truth = photographed(rig(), transfer="srgb")
    return Symptom(_levels(truth), truth, calibrated(rig()), jpeg_quality=85)


def long_period() -> Symptom:
    """Return a frame with 56 px a cycle."""
    geometry = rig(None, period_px=80.0)
    truth = photographed(geometry)
    return Symptom(_levels(truth), truth, calibrated(geometry))


def motion_blur() -> Symptom:
    """Return a frame of a bust that comes nearer by 40 mm during the exposure."""
    truth = photographed(rig(), pixel_rays=1)
    places_mm = np.linspace(-20, 20, 9).tolist()
    light = [_noise_free(rig(), pixel_rays=1, object_motion_mm=(0.0, 0.0, z))[1] for z in places_mm]
    return Symptom(_with_noise(np.mean(light, axis=0)), truth, calibrated(rig()))


def rolling_shutter() -> Symptom:
    """Return what a rolling shutter sees of a colour wheel: one colour too often, another one every few rows."""
    geometry, deviation = rig(), 0.3
    codes = make_pattern((1024, 768), geometry.geometry().pattern)
    frames = [
        photographed(geometry, exposed(codes, deviation, "top bit", c, GAMMA), scene="plane", exposure=0.85)
        for c in range(3)
    ]
    image = _levels(frames[0]).copy()
    bands = np.arange(len(image)) * 12 // len(image) % 3
    for c in (1, 2):
        image[bands == c] = frames[c].image[bands == c]
    return Symptom(image, frames[0], calibrated(geometry))


#: By the names that the page gives them.
SYMPTOMS: dict[str, Callable[[], Symptom]] = {
    "good": one_fault,
    "dark": partial(one_fault, exposure=0.05),
    "no_pattern": no_pattern,
    "vertical": vertical,
    "too_fine": too_fine,
    "upside_down": upside_down,
    "turned": turned,
    "over_exposed": partial(one_fault, exposure=2.2),
    "gloss": gloss,
    "transfer": transfer,
    "crosstalk": partial(one_fault, scene="waves", known={"crosstalk_matrix": np.eye(3)}),
    "crosstalk_plain": partial(one_fault, code=None, known={"crosstalk_matrix": np.eye(3)}),
    "unexplained": unexplained,
    "other_pattern": other_pattern,
    "code_not_told": code_not_told,
    "parts_apart": partial(one_fault, code=None, scene="objects"),
    "depth_range": depth_range,
    "inside_out": inside_out,
    "projector_moved": projector_moved,
    "pattern_moved": pattern_moved,
    "wrong_scale": wrong_scale,
    "paint": paint,
    "lateral_color": lateral_color,
    "subsampled": subsampled,
    "noisy": partial(one_fault, noise_levels=8.0),
    "other_light": partial(one_fault, ambient=4.0),
    "long_period": long_period,
    "motion_blur": motion_blur,
    "color_fields": partial(one_fault, field_motion_mm=(0.0, 0.0, 2.0)),
    "rolling_shutter": rolling_shutter,
}


def approaching(code: Literal["contrast"] | None, n_frames: int = 14) -> list[SimulatedFrame]:
    """Return frames in a row of a bust that comes nearer by 20 mm, 3 rad, a frame."""
    places_mm = [130.0 - 20.0 * number for number in range(n_frames)]
    return [
        photographed(rig(code), pixel_rays=1, object_motion_mm=(0.0, 0.0, z), seed=number)
        for number, z in enumerate(places_mm)
    ]


def beating(n_frames: int = 14) -> list[SimulatedFrame]:
    """Return frames of a plane, exposed for no whole number of the projector's colour cycles."""
    geometry = rig()
    codes = make_pattern((1024, 768), geometry.geometry().pattern)
    deviations = [0.08 * (0.5 + 0.5 * float(np.cos(2 * np.pi * 0.23 * number))) for number in range(n_frames)]
    return [
        photographed(
            geometry, exposed(codes, deviation, "top bit", 0, GAMMA), scene="plane", exposure=0.9, pixel_rays=1, seed=n
        )
        for n, deviation in enumerate(deviations)
    ]


#: Frames in a row by the names that the page gives them, with the calibration to decode them with.
SEQUENCES: dict[str, Callable[[], tuple[list[SimulatedFrame], Calibration]]] = {
    "approaching": lambda: (approaching(None), calibrated(rig(None))),
    "beating": lambda: (beating(), calibrated(rig())),
}
