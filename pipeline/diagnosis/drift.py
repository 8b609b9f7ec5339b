"""Drift of a rig since its calibration, from two pictures of an object that has not moved.

A plane in an unknown place is not enough: under a projector that has turned it looks like a plane elsewhere. So a
picture taken when the calibration was known to be right shows where the still object is, and one taken now at which
phases it is seen. Between them the projector may have turned about the axis along the stripes, which moves the pattern
across them (0.05 degrees are more than a pixel), turned about its own axis, and grown or shrunk as a warm lens does.
A turn about the third axis hardly moves a pattern of stripes.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.calibration.lens import Lens
from pipeline.calibration.model import Calibration, Geometry, Uncertainty
from pipeline.causes import Cause
from pipeline.decoding.frame import DecodedFrame
from pipeline.errors import CalibrationError
from pipeline.models import FloatArray
from pipeline.robust import robust_sigma

# Ripple averages out in tiles of this side, px: two cycles or three. One counts where both pictures show half of it.
_TILE_PX, _FILLED = 32, 0.5
_LEAST_TILES = 12
# What is usual, as standard deviations: any offset, a turn about the projector's axis (rad), a warm lens. They decide
# what a narrow strip leaves open.
_USUAL = np.array([1.0, 2e-3, 3e-4])
# Tiles further off than this many standard deviations do not hold still, and at least this share must.
_SIGMAS, _STILL = 4.0, 0.6
# More than this, in cycles, is no drift; where orders are not absolute it could be a whole cycle less.
_MOST_CYCLES = 0.4
_ROUNDS = 20


@dataclass(frozen=True)
class Drift:
    """Motion of the projector's picture since the calibration: values, and their standard deviations."""

    offset_px: tuple[float, float]
    """Across the stripes, projector px: where it shows things has moved down in its picture, or to the right."""
    roll_deg: tuple[float, float]
    """About the projector's axis."""
    scale: tuple[float, float]
    """By what factor it has grown."""
    depth_mm: float
    """Median error of depth that this has made on the still object, mm."""
    left_mm: float
    """Standard deviation of the depth's error that is left, mm, where in the picture it is largest."""
    calibration: Calibration
    """With the drift taken out; what is left is added to `uncertainty.depth_bias_mm`."""


def measure_drift(before: DecodedFrame, now: DecodedFrame, calibration: Calibration) -> Drift:
    """Measure how far the projector's picture has moved by what two frames show in the same place.

    Parameters
    ----------
    before, now : DecodedFrame
        Of one camera that has not moved against the still object, taken when the calibration was right and now, both
        decoded with it. What is elsewhere in the second one does not count, if it is less than two fifths.
    calibration : Calibration
        The rig's, with a geometry.

    Raises
    ------
    CalibrationError
        The frames have too little in common, the pattern has moved by more than 0.4 cycles, or the calibration holds
        no geometry.
    """
    geometry = calibration.geometry()
    if before.points is None or before.mask.shape != now.mask.shape:
        raise CalibrationError("both pictures must be decoded with the calibration, and of one size")
    points, cycles = _tiles(before.points, before, now)
    middle = float(np.median(cycles))
    if abs(middle) > _MOST_CYCLES:
        words = f"the pattern has moved by {middle * geometry.pattern.period_px:+.1f} px: calibrate geometry again"
        raise CalibrationError(Cause("rig moved", words))
    shapes = _shapes(calibration, points)
    found, covariance, still = _fit(shapes, cycles)
    if still.mean() < _STILL:
        words = f"only {still.mean():.0%} of what both pictures show is still in its place: show more that holds still"
        raise CalibrationError(Cause("other scene", words))
    depth_mm = float(np.median(points[:, 2]))
    mm = _mm_per_cycle(geometry, depth_mm)
    everywhere = _shapes(calibration, _picture_at(geometry.camera, depth_mm))
    unsure = np.sqrt(((everywhere @ covariance) * everywhere).sum(axis=1).max())
    left_mm = float(np.hypot(unsure, robust_sigma((cycles - shapes @ found)[still]))) * mm
    known = calibration.uncertainty or Uncertainty()
    bias_mm = float(np.hypot(known.depth_bias_mm or 0.0, left_mm))
    corrected = _moved(calibration, found).replace(uncertainty=known.replace(depth_bias_mm=bias_mm))
    units = np.array([_focal_px(geometry), np.degrees(1), 1])
    values, sigmas = found * units, np.sqrt(np.diag(covariance)) * units
    return Drift(
        offset_px=(float(values[0]), float(sigmas[0])),
        roll_deg=(float(values[1]), float(sigmas[1])),
        scale=(1 + float(values[2]), float(sigmas[2])),
        depth_mm=float(np.median(np.abs(shapes @ found)[still])) * mm,
        left_mm=left_mm,
        calibration=corrected,
    )


def _tiles(places: npt.NDArray[np.float32], before: DecodedFrame, now: DecodedFrame) -> tuple[FloatArray, FloatArray]:
    """Return places (T, 3) mm of what both frames show, and by how many cycles their phases have changed, (T,)."""
    both = before.mask & now.mask & np.isfinite(places).all(axis=2)
    change = (now.unwrapped_phase - before.unwrapped_phase) / (2 * np.pi)
    known = both & before.absolute & now.absolute
    if known.any():
        both = known
    else:  # orders are guesses
        change = change - np.rint(change)
    rows, columns = np.nonzero(both)
    across = -(-both.shape[1] // _TILE_PX)
    tile = rows // _TILE_PX * across + columns // _TILE_PX
    seen = np.column_stack([places[both], change[both]]).astype(np.float64)
    count = np.bincount(tile)
    full = count >= _FILLED * _TILE_PX**2
    if np.count_nonzero(full) < _LEAST_TILES:
        words = "both pictures show too little in common: show a sheet or a strip that stays in view"
        raise CalibrationError(Cause("other scene", words))
    means = np.stack([np.bincount(tile, column) for column in seen.T], axis=1)[full] / count[full, None]
    return means[:, :3], means[:, 3]


def _moved(calibration: Calibration, drift: FloatArray) -> Calibration:
    """Return the calibration of a rig whose projector has turned and grown by this, (3,); see `_USUAL`."""
    geometry = calibration.geometry()
    axis, turn = geometry.phase_axis, np.zeros(3)
    turn[1 - axis], turn[2] = (-drift[0] if axis else drift[0]), drift[1]
    rotation = cv2.Rodrigues(turn)[0]
    lens = geometry.projector
    matrix = lens.matrix * [[1 + drift[2], 1, 1], [1, 1 + drift[2], 1], [1, 1, 1]]
    return calibration.replace(
        rotation=rotation @ geometry.rotation,
        translation_mm=rotation @ geometry.translation_mm,
        projector=lens.replace(matrix=matrix),
    )


def _shapes(calibration: Calibration, points: FloatArray) -> FloatArray:
    """Return how the phase at points (N, 3), in cycles, changes with each number of a drift, (N, 3)."""
    now, steps = calibration.geometry().pattern_cycles(points), 1e-2 * _USUAL
    changed = [_moved(calibration, step).geometry().pattern_cycles(points) - now for step in np.diag(steps)]
    return np.stack(changed, axis=1) / steps


def _fit(shapes: FloatArray, cycles: FloatArray) -> tuple[FloatArray, FloatArray, npt.NDArray[np.bool_]]:
    """Return the drift (3,), its covariance, and which tiles (T,) hold still; others count little."""
    found, prior = np.array([np.median(cycles / shapes[:, 0]), 0.0, 0.0]), np.diag(1 / _USUAL**2)
    for _ in range(_ROUNDS):
        rest = np.abs(cycles - shapes @ found)
        sigma = max(robust_sigma(rest), 1e-6)
        trust = 1 / np.maximum(sigma, rest * rest / (4 * sigma)) ** 2  # beyond two deviations next to nothing
        weighted = shapes * trust[:, None]
        covariance = np.linalg.inv(shapes.T @ weighted + prior)
        found = covariance @ (cycles @ weighted)
    return found, covariance, np.abs(cycles - shapes @ found) < _SIGMAS * sigma


def _focal_px(geometry: Geometry) -> float:
    return float(geometry.projector.matrix[geometry.phase_axis, geometry.phase_axis])


def _mm_per_cycle(geometry: Geometry, depth_mm: float) -> float:
    """Return by how many mm the depth on the camera's axis changes with a cycle."""
    near, far = geometry.pattern_cycles(np.array([[0, 0, depth_mm - 0.5], [0, 0, depth_mm + 0.5]]))
    return 1 / abs(float(far - near))


def _picture_at(camera: Lens, depth_mm: float) -> FloatArray:
    """Return the places, (N, 3) mm, of the picture's corners and the middles of its sides, at a depth."""
    width, height = camera.size_px
    x, y = np.meshgrid([0.0, (width - 1) / 2, width - 1.0], [0.0, (height - 1) / 2, height - 1.0])
    rays = camera.rays_through(np.stack([x.ravel(), y.ravel()], axis=1))
    places = depth_mm * np.column_stack([rays, np.ones(len(rays))])
    return np.asarray(places[np.isfinite(places).all(axis=1)])
