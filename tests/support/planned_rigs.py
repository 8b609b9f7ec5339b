"""Rigs to plan and to simulate, near and far, and frames that they take."""

import warnings
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import reference

from pipeline.acquisition.simulated_studio import LIGHT, ReliefView
from pipeline.calibration import Calibration
from pipeline.decoder import Decoder
from pipeline.diagnosis.artefacts import Relief, Volume
from pipeline.diagnosis.certificate import measure_relief
from pipeline.errors import DecodeWarning
from pipeline.pattern import make_pattern
from pipeline.planning import RigPlan
from pipeline.settings import DecodeSettings
from pipeline.simulation import SKIN, WHITE, SimulatedFrame, SimulationSettings, simulate_frame
from tikernels.raw.demosaicing import demosaic
from tikernels.raw.pixel_format import PixelFormat

_MADE: dict[str, dict[str, Any]] = {
    "usual": {},
    "hand-size, near": {"distance_mm": 400.0, "baseline_mm": 100.0, "surface": "white", "projector_px": (1280, 800)},
    "far, wide": {
        **{"distance_mm": 1500.0, "baseline_mm": 600.0, "camera_px": (1280, 1024), "lens_mm": 12.0},
        **{"projector_px": (1280, 800), "throw_ratio": 1.5, "noise_levels": 2.5},
    },
    "narrow, beside": {
        **{"baseline_mm": 80.0, "camera_px": (1280, 960), "lens_mm": 12.0, "stripes": "vertical"},
        **{"throw_ratio": 1.5, "surface": "white", "noise_levels": 1.0},
    },
    "few cycles, 12 bits": {"distance_mm": 600.0, "baseline_mm": 150.0, "bits": 12, "period_px": 28.0},
}
#: What each is made of, beside the defaults; frames are simulated with all three colours of a pixel.
RIGS = {name: {"sensor": "rgb"} | made for name, made in _MADE.items()}
#: The simulator's scenes stand here.
SCENE_MM = 900.0


def simulated(plan: RigPlan) -> tuple[Calibration, float]:
    """Return the rig as the simulator can take it, and by how much it is larger than planned.

    Scenes stand 900 mm away. A rig for another distance is built larger or smaller, with all its lengths: what the
    camera then sees is the same, and depths are as much larger.
    """
    larger = SCENE_MM / plan.choice.distance_mm
    rig = plan.choice.calibration(plan.period_px)
    return rig.model_copy(update={"translation_mm": larger * rig.translation_mm}), larger


def simulation(plan: RigPlan, **changes: Any) -> SimulationSettings:
    """Return what happens between this rig's pattern and its frame."""
    choice = plan.choice
    color = SKIN if choice.surface == "skin" else WHITE
    values = {"reflectance": color, "noise_levels": choice.noise_levels, "bits": choice.bits, "scene": "plane"}
    return SimulationSettings(**values | changes)


def brightest(plan: RigPlan, rig: Calibration, settings: SimulationSettings) -> npt.NDArray[np.float32]:
    """Return what each pixel's brightest channel reaches where the fringe is brightest, (H, W), 0..1 of full scale."""
    clean = settings.model_copy(update={"noise_levels": 0.0, "bits": 16})
    level = simulate_frame(rig, clean).image.max(axis=-1) / np.float32(65535)
    # A surface that leans has longer cycles.
    cycle = int(1.3 * plan.fringe.period_camera_px) | 1
    return cv2.dilate(level, np.ones((cycle, 1) if plan.choice.phase_axis else (1, cycle), np.uint8))


def exposure(rig: Calibration, settings: SimulationSettings) -> float:
    """Return the exposure at which the brightest half per cent reach 0.9 of full scale, as the simulator chooses it."""
    clean = settings.model_copy(update={"noise_levels": 0.0, "bits": 16, "exposure": 0.1})
    return 0.09 / float(np.quantile(simulate_frame(rig, clean).image / 65535, 0.995))


def phase_error(frame: Any, truth: SimulatedFrame, where: npt.NDArray[np.bool_]) -> npt.NDArray[np.float64]:
    """Return what the wrapped phase is off by there, modulo a cycle, without its median, (N,) rad."""
    error = np.angle(np.exp(1j * (frame.wrapped_phase[where] - truth.phase[where])))
    return np.asarray(error - np.median(error))


def inside(frame: Any, truth: SimulatedFrame, rim_px: int) -> npt.NDArray[np.bool_]:
    """Return the decoded pixels that are this far from any rim, (H, W)."""
    mask = (frame.mask & truth.mask).astype(np.uint8)
    return cv2.erode(mask, np.ones((2 * rim_px + 1, 2 * rim_px + 1), np.uint8), borderValue=0) != 0


def through_sensor(plan: RigPlan, image: Any, white_level: float) -> tuple[Any, float]:
    """Return a frame as decoded from the rig's sensor, and its full scale."""
    if plan.choice.sensor == "rgb":
        return image, white_level
    stored = PixelFormat("bayer", bits=8 if image.dtype == np.uint8 else plan.choice.bits, bayer="rggb")
    return demosaic(np.ascontiguousarray(reference.mosaic(image, "rggb")), stored, plan.choice.stripes), 1.0


def limits_over_planned(plan: RigPlan) -> Iterator[float]:
    """Yield the lateral period limit across and along the stripes, on a corrugated plate, over the planned one.

    The plate stands where the rig is turned to, before a lens with a blur of half a pixel; captures have 8 bits.
    """
    choice = plan.choice
    rig = choice.calibration(plan.period_px, "contrast2")
    volume = Volume.before(rig.geometry(), choice.distance_mm)
    plate, codes = Relief.within(volume), make_pattern(choice.projector_px, rig.pattern)
    for at in plate.positions(volume):
        view = ReliefView(rig, plate, at.turn, at.place_mm, replace(LIGHT, noise=choice.noise_levels), 3)
        image, white_level = through_sensor(plan, view.photograph(codes, np.random.default_rng(0)), 255)
        settings = DecodeSettings(stripes=choice.stripes, white_level=white_level)
        with warnings.catch_warnings():  # the plate fills little of the picture
            warnings.simplefilter("ignore", DecodeWarning)
            frame = Decoder(settings, rig).decode(image)
        found = measure_relief(frame, at, volume.geometry, settings.smoothing_px)
        assert found.limit_mm is not None
        yield found.limit_mm / plan.lateral_limit_mm


class Measured(NamedTuple):
    """Errors where it is as bright as planned, one constant removed: their RMS, and that of most of them."""

    phase_rad: float
    depth_mm: float
    most_phase_rad: float
    most_depth_mm: float


def measured(plan: RigPlan, scene: str, share: float = 1.0) -> Measured:
    """Simulate a frame of this rig, its light times a share, decode it, and compare it with the truth."""
    rig, larger = simulated(plan)
    settings = simulation(plan, scene=scene)
    settings = settings.model_copy(update={"exposure": share * exposure(rig, settings)})
    truth = simulate_frame(rig, settings)
    image, white_level = through_sensor(plan, truth.image, truth.white_level)
    decoder = Decoder(DecodeSettings(stripes=plan.choice.stripes, white_level=white_level), rig)
    with warnings.catch_warnings():  # parts of the bust are narrower than the cycles that the code needs
        warnings.simplefilter("ignore", DecodeWarning)
        frame = decoder.decode(image)
    level = brightest(plan, rig, settings) / (share * plan.choice.brightness)
    where = inside(frame, truth, 12) & (np.abs(level - 1) < 0.07)
    assert np.count_nonzero(where) > 10_000
    error = phase_error(frame, truth, where)
    # A radian is as much depth as the squares of baseline and depth are; the plan is for the object's distance.
    depth, baseline = truth.points[..., 2][where] / larger, plan.choice.baseline_mm
    off = frame.points[..., 2][where] / larger - depth
    off *= (plan.choice.distance_mm**2 + baseline**2) / (depth**2 + baseline**2)
    off = off[np.abs(off) < 0.3 * plan.fringe.depth_per_cycle_mm]  # a wrong order is no noise
    assert len(off) > 0.98 * len(error)
    return Measured(float(np.sqrt(np.mean(error**2))), float(np.std(off)), middle(error), middle(off))


def middle(errors: npt.NDArray[np.floating]) -> float:
    """Return the standard deviation of a normal distribution with this median of absolute values."""
    return float(np.median(np.abs(errors - np.median(errors))) / 0.6745)
