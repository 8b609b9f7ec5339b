"""Whether a calibration still holds: a later capture of a plane or ball, against what the calibration predicts."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from pipeline.calibration.model import Calibration
from pipeline.decoding.frame import DecodedFrame
from pipeline.diagnosis.check_result import BLIND_SPOTS, CheckResult, Measure
from pipeline.errors import CalibrationError
from pipeline.models import FloatArray
from pipeline.robust import robust_sigma
from tikernels import runtime
from tikernels.depth.triangulation import triangulate

Shape = Literal["plane", "ball"]

# A surface this large, px, tells a shape.
_MIN_SURFACE_PX = 2000
# Residuals further out than this many deviations are highlights and rims.
_OUTLIER_SIGMAS = 4.0
# Averages over tiles of this side, px, are free of noise: what is left there is shape.
_TILE_PX = 24
# A surface whose averages deviate from the shape by more than this fraction of its distance is another shape: no rig
# gets that far out of adjustment by itself.
_OTHER_SHAPE = 0.01
# Cycles to either side of the expected order in which a ball is looked for.
_ORDERS = 5
# A deviation from the shape, mm, free of noise, that no calibration promises to be better than.
_SHAPE_FLOOR_MM = 0.1


def check_surface(
    frame: DecodedFrame, calibration: Calibration, shape: Shape, radius_mm: float | None = None
) -> CheckResult:
    """Compare a decoded plane or ball with a perfect one.

    Parameters
    ----------
    frame : DecodedFrame
        Decoded with the calibration.
    calibration : Calibration
        The one in doubt.
    shape : {"plane", "ball"}
        What was captured: the largest surface in view for a plane, the one nearest to a ball for a ball.
    radius_mm : float, optional
        The ball's true radius.

    Raises
    ------
    CalibrationError
        No surface is large enough or of that shape, or the calibration holds no geometry.
    """
    if radius_mm is not None and not radius_mm > 0:
        raise CalibrationError(f"the ball's radius is given as {radius_mm:g} mm: measure it")
    geometry = calibration.geometry()
    if frame.points is None or frame.point_sigma is None:
        raise CalibrationError("the frame was decoded without this calibration: decode it with it")
    surfaces = [n for n, size in enumerate(np.bincount(frame.region.ravel())) if n > 0 and size >= _MIN_SURFACE_PX]
    if not surfaces:
        raise CalibrationError(f"no surface of {_MIN_SURFACE_PX} px is in view: fill the picture with the {shape}")
    placed = {0: frame.points}
    if shape == "ball":
        # Where orders are not absolute, a surface's is a guess; a ball of the right radius, or else the roundest one,
        # tells it.
        rays, projector = geometry.camera.rays(), geometry.for_triangulation()
        for cycles in range(-_ORDERS, _ORDERS + 1):
            phase = frame.unwrapped_phase + np.float32(2 * np.pi * cycles)
            placed[cycles] = runtime.to_host(triangulate(phase, rays, projector))
    fits = [
        fit
        for n in (surfaces if shape == "ball" else surfaces[:1])
        for cycles, points in placed.items()
        if cycles == 0 or not frame.absolute[frame.region == n].any()
        if (fit := _fit_shape(points, frame.point_sigma, frame.region == n, shape)) is not None
    ]
    if not fits:
        raise CalibrationError(f"no surface is large enough to tell a {shape}: fill the picture with it")
    if shape == "ball":
        # A wall behind the ball fits a huge one.
        known = [fit for fit in fits if fit.radius is not None and 5 < fit.radius < 1000]
        if not known:
            raise CalibrationError("no surface in view is a ball: show it alone, before something far or dark")
        fits = sorted(known, key=lambda fit: fit.spread if radius_mm is None else abs((fit.radius or 0) - radius_mm))
    best = fits[0]
    coarse, distance = float(np.sqrt(np.mean(best.coarse**2))), float(np.linalg.norm(best.position))
    if coarse > _OTHER_SHAPE * distance:
        raise CalibrationError(
            f"the surface is {coarse:.1f} mm from the nearest {shape}: show one alone; if it is one, calibrate again"
        )
    bias = _predicted_bias(calibration)
    noise = float(np.sqrt(np.mean(best.sigma**2)))
    name = "flatness" if shape == "plane" else "sphericity"
    measures = [
        Measure("point precision", float(np.sqrt(np.mean(best.fine**2))), noise, "mm"),
        Measure(name, coarse, float(np.hypot(_SHAPE_FLOOR_MM, 0.5 * bias)), "mm"),
    ]
    if best.radius is not None and radius_mm is not None:
        # Depth that is off by a part is so for every length.
        expected = np.hypot(_SHAPE_FLOOR_MM, bias * radius_mm / best.position[2])
        measures.append(Measure("radius", abs(best.radius - radius_mm), float(expected), "mm"))
    x, y, z = (float(value) for value in best.position)
    blind_spot = BLIND_SPOTS[shape] if radius_mm is None or shape == "plane" else ""
    return CheckResult(tuple(measures), (x, y, z), best.radius, blind_spot)


@dataclass(frozen=True)
class _ShapeFit:
    """A shape laid through a surface."""

    position: FloatArray  # (3,) mm
    radius: float | None
    sigma: FloatArray  # (N,) mm, predicted, across the surface
    fine: FloatArray  # (N,) mm, residuals without what is smooth
    coarse: FloatArray  # (B,) mm, their averages over tiles
    spread: float  # mm, RMS of all


def _fit_shape(
    all_points: npt.NDArray[np.float32],
    point_sigma: npt.NDArray[np.float32],
    surface: npt.NDArray[np.bool_],
    shape: Shape,
) -> _ShapeFit | None:
    """Lay a shape through a surface; None where too little of it is in front of the camera, or in one piece."""
    points, sigma = all_points[surface].astype(np.float64), point_sigma[surface].astype(np.float64)
    keep = np.isfinite(points[:, 2])
    radius = None
    for _ in range(4):
        if np.count_nonzero(keep) < _MIN_SURFACE_PX // 2:
            return None
        if shape == "plane":
            middle = points[keep].mean(axis=0)
            normal = np.linalg.svd(points[keep] - middle, full_matrices=False)[2][2]
            residual = (points - middle) @ normal
            towards = np.broadcast_to(normal, points.shape)
            position = np.array([0.0, 0.0, middle @ normal / normal[2]])
        else:
            position, radius = _sphere(points[keep])
            away = points - position
            distance = np.linalg.norm(away, axis=1)
            residual, towards = distance - radius, away / distance[:, None]
        limit = _OUTLIER_SIGMAS * robust_sigma(residual[keep])
        keep = np.isfinite(residual) & (np.abs(residual) <= max(limit, 1e-6))
    # A point moves along its ray; across the surface it moves by the cosine.
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    across = sigma * np.abs((rays * towards).sum(axis=1))
    y, x = (place[keep] for place in np.nonzero(surface))
    tile = (y // _TILE_PX) * (1 + x.max() // _TILE_PX) + x // _TILE_PX
    counts = np.bincount(tile)
    means = np.bincount(tile, residual[keep]) / np.maximum(counts, 1)
    whole = counts > 0.5 * _TILE_PX**2
    if not whole.any():
        return None
    inside = whole[tile]
    return _ShapeFit(
        position=position,
        radius=radius,
        sigma=across[keep][inside],
        fine=(residual[keep] - means[tile])[inside],
        coarse=means[whole],
        spread=float(np.sqrt(np.mean(residual[keep] ** 2))),
    )


def _sphere(points: FloatArray) -> tuple[FloatArray, float]:
    """Return centre and radius of the sphere nearest to points: algebraic first, then by distance."""
    origin = points.mean(axis=0)
    moved = points - origin
    system = np.concatenate([2 * moved, np.ones((len(points), 1))], axis=1)
    solution = np.linalg.lstsq(system, (moved**2).sum(axis=1), rcond=None)[0]
    centre = solution[:3]
    radius = float(np.sqrt(max(solution[3] + centre @ centre, 1e-9)))
    for _ in range(10):
        away = moved - centre
        distance = np.linalg.norm(away, axis=1)
        jacobian = np.concatenate([-away / distance[:, None], -np.ones((len(points), 1))], axis=1)
        step = np.linalg.lstsq(jacobian, -(distance - radius), rcond=None)[0]
        centre, radius = centre + step[:3], radius + float(step[3])
    return origin + centre, radius


def _predicted_bias(calibration: Calibration) -> float:
    if calibration.uncertainty is None or calibration.uncertainty.depth_bias_mm is None:
        return 0.0
    return calibration.uncertainty.depth_bias_mm
