"""Decoded frames of small pieces under bad light, whose orders are uncertain, and which of them are wrong."""

import warnings
from collections.abc import Iterator

import cv2
import numpy as np
import numpy.typing as npt

from pipeline import Calibration, DecodedFrame, Decoder, DecodeSettings
from pipeline.errors import DecodeWarning
from pipeline.simulation import SKIN, TYPICAL_CROSSTALK, WHITE, SimulationSettings, simulate_frame, simulated_rig
from tikernels import runtime
from tikernels.scene.scene_shapes import SHAPES


def uncertain_frame(
    seed: int, code: str | None = "contrast", depth_range: bool = False
) -> tuple[DecodedFrame, npt.NDArray[np.float64]]:
    """Return a decoded frame of small pieces under bad light, and its true phase (rad; NaN where nothing is lit)."""
    rng = np.random.default_rng(seed)
    rig = simulated_rig(period_px=float(rng.uniform(12, 24)), code=code)
    blur, camera_blur = rng.choice([0.0, 0.0, 1.0, 2.0]), rng.choice([0.0, 0.0, 0.7, 1.0])
    settings = SimulationSettings(
        scene=SHAPES[rng.integers(len(SHAPES))],
        gamma=float(rng.choice([1.0, 1.6, 2.0, 2.4])),
        reflectance=SKIN if rng.random() < 0.5 else WHITE,
        projector_blur_px=(blur,) * 3,
        camera_blur_px=(camera_blur,) * 3,
        ambient=float(rng.choice([0.0, 0.05, 0.2, 0.5])),
        noise_levels=0.0,
        bits=16,
        seed=seed,
    )
    truth = simulate_frame(rig, settings)
    light = truth.image / np.float32(truth.white_level)
    shape = light.shape[:2]
    if rng.random() < 0.3:
        light *= _printed(rng, shape)[..., None]
    if rng.random() < 0.3:  # a window to one side
        light = (light + np.float32(rng.uniform(0.05, 0.3)) * _slope(rng, shape)[..., None]) / np.float32(1.3)
    visible = _pieces(rng, shape)
    if rng.random() < 0.3:  # something stands in the light
        light = np.where(_slope(rng, shape)[..., None] > 0.5, np.float32(rng.uniform(0.1, 0.5)) * light, light)
    levels = 255 * float(rng.choice([1.0, 0.6, 0.3])) * light * visible[..., None]
    levels += float(rng.choice([1.0, 1.5, 3.0, 6.0])) * rng.standard_normal(levels.shape, dtype=np.float32)
    image = np.clip(np.rint(levels), 0, 255).astype(np.uint8)
    matrix = np.array(TYPICAL_CROSSTALK)
    if rng.random() < 0.2:  # told wrongly
        matrix = matrix + rng.normal(0, 0.03, (3, 3))
    update: dict[str, object] = {"crosstalk_matrix": matrix}
    if depth_range:
        update["depth_range_mm"] = depth_range_of(rng, truth.points)
    calibration: Calibration = rig.model_copy(update=update)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DecodeWarning)
        frame = Decoder(DecodeSettings(), calibration, arch=runtime.started()).decode(image)
    return frame, np.where(truth.mask & visible, truth.phase, np.nan)


def depth_range_of(rng: np.random.Generator, points: npt.NDArray[np.float32]) -> tuple[float, float]:
    """Return a range that holds all the points, by up to 60 mm wider on either side."""
    nearest, farthest = np.nanmin(points[..., 2]), np.nanmax(points[..., 2])
    return float(nearest - rng.uniform(0, 60)), float(farthest + rng.uniform(0, 60))


def judged_regions(frame: DecodedFrame, phase: npt.NDArray[np.float64]) -> Iterator[tuple[float, float]]:
    """Yield of every region how probably its order is wrong, and whether it is."""
    for region in range(1, int(frame.region.max()) + 1):
        inside = (frame.region == region) & np.isfinite(phase)
        if inside.any():
            cycles = np.rint((frame.unwrapped_phase[inside] - phase[inside]) / (2 * np.pi)).astype(int)
            values, counts = np.unique(cycles, return_counts=True)
            yield float(frame.order_error_probability[inside][0]), float(values[counts.argmax()] != 0)


def _pieces(rng: np.random.Generator, shape: tuple[int, ...]) -> npt.NDArray[np.bool_]:
    """Return where something is seen: some ellipses and upright rectangles, of a few cycles each."""
    canvas = np.zeros(shape, np.uint8)
    for _ in range(rng.integers(4, 12)):
        x, y = int(rng.integers(shape[1])), int(rng.integers(shape[0]))
        half_width, half_height = int(rng.integers(6, 60)), int(rng.integers(15, 90))
        cv2.ellipse(canvas, (x, y), (half_width + 3, half_height + 3), 0, 0, 360, 0, -1)  # kept apart from the others
        if rng.random() < 0.5:
            cv2.ellipse(canvas, (x, y), (half_width, half_height), 0, 0, 360, 1, -1)
        else:
            cv2.rectangle(canvas, (x - half_width, y - half_height), (x + half_width, y + half_height), 1, -1)
    return canvas != 0


def _slope(rng: np.random.Generator, shape: tuple[int, ...]) -> npt.NDArray[np.float32]:
    """Return what rises from 0 to 1 across the image, in some direction."""
    y, x = np.indices(shape)
    angle = rng.uniform(0, 2 * np.pi)
    across = (x / shape[1] - 0.5) * np.cos(angle) + (y / shape[0] - 0.5) * np.sin(angle)
    return np.asarray(np.clip(0.5 + 0.7 * across, 0, 1), np.float32)


def _printed(rng: np.random.Generator, shape: tuple[int, ...]) -> npt.NDArray[np.float32]:
    """Return a print on the surface: stripes of some period, or patches of some size."""
    y, x = np.indices(shape)
    depth = rng.uniform(0.1, 0.5)
    if rng.random() < 0.5:
        angle, period = rng.uniform(0, np.pi), rng.uniform(6, 60)
        wave = np.cos(2 * np.pi * (x * np.cos(angle) + y * np.sin(angle)) / period)
    else:
        wave = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), float(rng.uniform(1, 8)))
        wave = np.clip(wave / (2 * wave.std()), -1, 1)
    return np.asarray(1 - depth / 2 * (1 + wave), np.float32)
