"""Whether a calibration still holds: a later capture of a plane or ball, against what the calibration predicts."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.calibration.board_free import estimate_light
from pipeline.calibration.captures import Picture
from pipeline.calibration.doctor import Diagnosis
from pipeline.calibration.model import Calibration, Capture, Geometry
from pipeline.calibration.multishot import decode_multishot
from pipeline.errors import CalibrationError
from pipeline.models import FloatArray
from pipeline.results import DecodedFrame
from tikernels.triangulation import triangulate

_Singles = npt.NDArray[np.float32]

Shape = Literal["plane", "ball"]

# A surface this large, px, tells a shape.
_MIN_SURFACE_PX = 2000
# Residuals further out than this many deviations are highlights and rims.
_OUTLIER_SIGMAS = 4.0
# Averages over blocks of this side, px, are free of noise: what is left there is shape.
_BLOCK_PX = 24
# A measured figure may exceed the predicted one by this factor before the calibration is doubted.
_TOLERANCE = 2.0
# Cycles to either side of the expected order in which a ball is looked for.
_ORDERS = 5
# What no calibration promises to be better than: noise-free shape, mm, and a distance to an epipolar line, px.
_SHAPE_FLOOR_MM, _EPIPOLAR_FLOOR_PX = 0.1, 0.1


@dataclass(frozen=True)
class Measure:
    """One figure of a check."""

    name: str
    measured: float
    predicted: float  # what the calibration and the frame's noise lead one to expect
    unit: str

    @property
    def fine(self) -> bool:
        """Whether it is within twice the prediction."""
        return self.measured <= _TOLERANCE * self.predicted


@dataclass(frozen=True)
class CheckResult:
    """What a check found."""

    measures: tuple[Measure, ...]
    position_mm: tuple[float, float, float]  # a ball's centre, or the plane's point on the camera's axis
    radius_mm: float | None  # a ball's

    @property
    def fine(self) -> bool:
        """Whether every figure is within twice its prediction; if not, calibrate again."""
        return all(measure.fine for measure in self.measures)


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
        What was captured; the largest surface that fits is taken.
    radius_mm : float, optional
        The ball's true radius.

    Raises
    ------
    CalibrationError
        No surface is large enough, or the calibration holds no geometry.
    """
    geometry = calibration.geometry()
    if frame.points is None or frame.point_sigma is None:
        raise CalibrationError("the frame was decoded without this calibration: decode it with it")
    surfaces = [n for n, size in enumerate(np.bincount(frame.region.ravel())) if n > 0 and size >= _MIN_SURFACE_PX]
    if not surfaces:
        raise CalibrationError(f"no surface of {_MIN_SURFACE_PX} px is in view: fill the picture with the {shape}")
    placed = {0: frame.points}
    if shape == "ball":
        # The order of a surface that nothing connects to others is a guess; a ball of the right radius, or else the
        # roundest one, tells it.
        rays, projector = geometry.camera.rays(), geometry.for_triangulation()
        for cycles in range(-_ORDERS, _ORDERS + 1):
            placed[cycles] = triangulate(frame.unwrapped_phase + np.float32(2 * np.pi * cycles), rays, projector)
    fits = [_fit(points, frame.point_sigma, frame.region == n, shape) for n in surfaces for points in placed.values()]
    if shape == "ball":
        # A wall behind the ball passes for a huge one.
        known = [fit for fit in fits if fit.radius is not None and 5 < fit.radius < 1000]
        if not known:
            raise CalibrationError("no surface in view is a ball: show it alone, before something far or dark")
        fits = sorted(known, key=lambda fit: fit.spread if radius_mm is None else abs((fit.radius or 0) - radius_mm))
    best = fits[0]
    bias = _predicted_bias(calibration)
    noise = float(np.sqrt(np.mean(best.sigma**2)))
    name = "flatness" if shape == "plane" else "sphericity"
    measures = [
        Measure("point precision", float(np.sqrt(np.mean(best.fine**2))), noise, "mm"),
        Measure(name, float(np.sqrt(np.mean(best.coarse**2))), float(np.hypot(_SHAPE_FLOOR_MM, 0.5 * bias)), "mm"),
    ]
    if best.radius is not None and radius_mm is not None:
        # Depth that is off by a part is so for every length.
        expected = np.hypot(_SHAPE_FLOOR_MM, bias * radius_mm / best.position[2])
        measures.append(Measure("radius", abs(best.radius - radius_mm), float(expected), "mm"))
    x, y, z = (float(value) for value in best.position)
    return CheckResult(tuple(measures), (x, y, z), best.radius)


def check_epipolar(captures: Mapping[str, Picture], calibration: Calibration, where: str = "captures") -> Measure:
    """Measure how far projector pixels lie from the epipolar lines of the camera pixels that see them.

    Parameters
    ----------
    captures : mapping from name to (H, W, 3)
        The captures of `multishot_sequence`, of anything that holds still.
    calibration : Calibration
        The one in doubt.
    where : str
        What errors call these captures.

    Raises
    ------
    CalibrationError
        The captures cannot be decoded, or are of another size.
    """
    geometry = calibration.geometry()
    seen = decode_multishot(captures, geometry.projector.size_px, where)
    height, width = seen.position_px.shape[:2]
    if (width, height) != geometry.camera.size_px:
        raise CalibrationError(f"{where}: the captures are {height}x{width}, the calibration is for another camera")
    known = ~np.isnan(seen.position_px[..., 0])
    error = epipolar_error_px(geometry, np.argwhere(known)[:, ::-1].astype(np.float64), seen.position_px[known])
    uncertainty = calibration.uncertainty
    rms = (0.0, 0.0) if uncertainty is None or uncertainty.reprojection_px is None else uncertainty.reprojection_px
    return Measure(
        "epipolar error", float(np.median(np.abs(error))), float(np.hypot(_EPIPOLAR_FLOOR_PX, max(rms))), "px"
    )


def epipolar_error_px(geometry: Geometry, camera_px: FloatArray, projector_px: FloatArray) -> FloatArray:
    """Return how far projector pixels lie beside the epipolar lines of camera pixels, (N,) projector px.

    Parameters
    ----------
    geometry : Geometry
        Where camera and projector stand.
    camera_px, projector_px : (N, 2)
        x, y of pixels that see each other.
    """
    rays = cv2.undistortPoints(camera_px.reshape(-1, 1, 2), geometry.camera.matrix, geometry.camera.distortion)
    light = cv2.undistortPoints(
        projector_px.reshape(-1, 1, 2), geometry.projector.matrix, geometry.projector.distortion
    )
    t = geometry.translation_mm / np.linalg.norm(geometry.translation_mm)
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    lines = np.insert(rays.reshape(-1, 2), 2, 1.0, axis=1) @ (cross @ geometry.rotation).T
    distance = (np.insert(light.reshape(-1, 2), 2, 1.0, axis=1) * lines).sum(axis=1) / np.hypot(
        lines[:, 0], lines[:, 1]
    )
    return np.asarray(distance * np.sqrt(geometry.projector.matrix[0, 0] * geometry.projector.matrix[1, 1]))


@dataclass(frozen=True)
class _Fit:
    """A shape laid through a surface."""

    position: FloatArray  # (3,) mm
    radius: float | None
    sigma: FloatArray  # (N,) mm, predicted, across the surface
    fine: FloatArray  # (N,) mm, residuals without what is smooth
    coarse: FloatArray  # (B,) mm, their averages over blocks
    spread: float  # mm, RMS of all


def _fit(all_points: _Singles, point_sigma: _Singles, surface: npt.NDArray[np.bool_], shape: Shape) -> _Fit:
    points, sigma = all_points[surface].astype(np.float64), point_sigma[surface].astype(np.float64)
    keep = np.isfinite(points[:, 2])
    radius = None
    for _ in range(4):
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
        limit = _OUTLIER_SIGMAS * 1.4826 * np.median(np.abs(residual[keep]))
        keep = np.isfinite(residual) & (np.abs(residual) <= max(limit, 1e-6))
    # A point moves along its ray; across the surface it moves by the cosine.
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    across = sigma * np.abs((rays * towards).sum(axis=1))
    y, x = (place[keep] for place in np.nonzero(surface))
    block = (y // _BLOCK_PX) * (1 + x.max() // _BLOCK_PX) + x // _BLOCK_PX
    counts = np.bincount(block)
    means = np.bincount(block, residual[keep]) / np.maximum(counts, 1)
    whole = counts > 0.5 * _BLOCK_PX**2
    inside = whole[block]
    return _Fit(
        position=position,
        radius=radius,
        sigma=across[keep][inside],
        fine=(residual[keep] - means[block])[inside],
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


def corrected_light(
    calibration: Calibration, diagnosis: Diagnosis, image: Picture, white_level: float, frame: DecodedFrame
) -> Calibration:
    """Return the calibration with what a frame tells of the light in place of what it held.

    Crosstalk and response are estimated anew from the frame, where they or what passes for them were found at fault. A
    transfer is set. What needs more than a frame (lateral colour, motion, a black level) stays, as the advice says.

    Parameters
    ----------
    calibration : Calibration
        The one at fault.
    diagnosis : Diagnosis
        What was found.
    image : (H, W, 3)
        The frame's picture, levels.
    white_level : float
        Full scale.
    frame : DecodedFrame
        The frame, decoded.

    Raises
    ------
    CalibrationError
        Nothing is at fault that a frame could correct, or the frame tells too little.
    """
    causes = {cause for finding in diagnosis.findings for cause in finding.causes}
    if "transfer" in causes:
        stood = calibration.capture or Capture()
        was_srgb = isinstance(stood.transfer, str) and stood.transfer == "srgb"
        changed = stood.model_copy(update={"transfer": "linear" if was_srgb else "srgb"})
        return calibration.model_copy(update={"capture": changed})
    if not causes & {"response", "crosstalk", "even crosstalk"}:
        raise CalibrationError("no fault was found that one frame can correct: do what the check advises")
    light = estimate_light([image], white_level, [frame.unwrapped_phase], [frame.mask], frame.period_px or 0.0)
    if not light.reliable:
        raise CalibrationError("the frame tells too little of the light to correct it: capture a larger smooth surface")
    update: dict[str, Any] = {
        "crosstalk_matrix": light.crosstalk_matrix,
        "response": np.tile(light.response, (3, 1)),
    }
    if calibration.pattern is not None:
        # The response that a frame shows is what the pattern has not undone.
        update["pattern"] = calibration.pattern.model_copy(update={"compensated": False})
    return calibration.model_copy(update=update)
