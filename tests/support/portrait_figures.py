"""How far a decoded frame of the simulated portrait is off the true head."""

from typing import NamedTuple

import cv2
import numpy as np

from pipeline.decoding.frame import DecodedFrame
from pipeline.simulation import SimulatedFrame

# Nearer than this is the head with its shoulders, not the wall.
WALL_FROM_MM = 940.0
# Depth that changes by more than this among neighbours (a slope of more than 75 deg) is a silhouette; pixels within
# this many px of one, or of a shadow, see two surfaces through a lens that blurs.
STEP_MM, RIM_PX = 5.0, 3
# Reflectance that changes by more than this within 9 px is an edge of paint: of lips, brows, eyes, hair or shirt.
PAINT_STEP, PAINT_PX = 0.08, 9


class PortraitFigures(NamedTuple):
    """Depth errors are measured minus true depth along the camera's axis, of pixels whose fringe order is right."""

    coverage: float  # share of the lit head that has a depth
    coverage_inside: float  # the same, silhouettes left out
    right_orders: float  # share of those with a depth whose fringe order is right
    wrong_and_sure: float  # share of those with a depth whose order is wrong but said to be absolute
    rms_mm: float
    rms_inside_mm: float  # silhouettes left out
    bias_inside_mm: float
    rms_even_mm: float  # silhouettes and edges of paint left out
    sigma_inside_mm: float  # RMS of the predicted standard deviation there


def portrait_figures(frame: DecodedFrame, truth: SimulatedFrame) -> PortraitFigures:
    """Compare a frame with the truth of the place that it shows."""
    depth = truth.points[..., 2]
    head = truth.mask & (depth < WALL_FROM_MM)
    steep = _range(np.nan_to_num(depth, nan=1e4), 3) > STEP_MM
    edges = np.max([_range(truth.reflectance[..., k], PAINT_PX) for k in range(3)], axis=0) > PAINT_STEP
    rims = cv2.dilate((steep | ~truth.mask).astype(np.uint8), np.ones((2 * RIM_PX + 1,) * 2, np.uint8)) != 0
    assert frame.points is not None
    measured = head & frame.mask & np.isfinite(frame.points[..., 2])
    inside = measured & ~rims
    error = np.where(measured, frame.points[..., 2].astype(np.float64) - depth, 0.0)
    right = measured & (np.abs(np.nan_to_num(frame.unwrapped_phase) - truth.phase) < np.pi)
    compared = inside & right
    return PortraitFigures(
        coverage=float(measured.sum() / head.sum()),
        coverage_inside=float(inside.sum() / (head & ~rims).sum()),
        right_orders=float(right.sum() / measured.sum()),
        wrong_and_sure=float((~right & frame.absolute & measured).sum() / measured.sum()),
        rms_mm=_rms(error[right]),
        rms_inside_mm=_rms(error[compared]),
        bias_inside_mm=float(error[compared].mean()),
        rms_even_mm=_rms(error[compared & ~edges]),
        sigma_inside_mm=_rms(frame.point_sigma[compared]),
    )


def _range(values: np.ndarray, size_px: int) -> np.ndarray:
    """Return how far a pixel's neighbours differ."""
    square = np.ones((size_px, size_px), np.uint8)
    return cv2.dilate(values, square) - cv2.erode(values, square)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values, dtype=np.float64))))
