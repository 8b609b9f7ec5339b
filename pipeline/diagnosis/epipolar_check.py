"""Whether a calibration still holds: captures of anything that holds still, against the rig's epipolar lines."""

from collections.abc import Mapping

import numpy as np

from pipeline.calibration.captures import SWAPPED, refuse_other_camera
from pipeline.calibration.model import Calibration, Geometry
from pipeline.calibration.multishot import decode_multishot
from pipeline.diagnosis.check_result import BLIND_SPOTS, CheckResult, Measure
from pipeline.errors import CalibrationError
from pipeline.models import FloatArray, ImageArray

# A distance to an epipolar line, px, that no calibration promises to be better than.
_FLOOR_PX = 0.1


def check_epipolar(
    captures: Mapping[str, ImageArray],
    calibration: Calibration,
    where: str = "captures",
    white_level: float | None = None,
) -> CheckResult:
    """Measure how far projector pixels lie from the epipolar lines of the camera pixels that see them.

    Parameters
    ----------
    captures : mapping from name to (H, W, 3)
        The captures of `multishot_sequence`, of anything that holds still.
    calibration : Calibration
        The one in doubt.
    where : str
        What errors call these captures.
    white_level : float, optional
        Full scale; None: the type's.

    Raises
    ------
    CalibrationError
        The captures cannot be decoded, are of another size, or camera and projector are swapped.
    """
    geometry = calibration.geometry()
    height, width = next(iter(captures.values())).shape[:2]
    refuse_other_camera(calibration, (width, height), where)
    seen = decode_multishot(captures, geometry.projector.size_px, where, white_level)
    known = ~np.isnan(seen.position_px[..., 0])
    uncertainty = calibration.uncertainty
    rms = (0.0, 0.0) if uncertainty is None or uncertainty.reprojection_px is None else uncertainty.reprojection_px
    predicted = float(np.hypot(_FLOOR_PX, max(rms)))

    def measure(as_if: Geometry) -> Measure:
        error = epipolar_error_px(as_if, np.argwhere(known)[:, ::-1].astype(np.float64), seen.position_px[known])
        return Measure("epipolar error", float(np.median(np.abs(error))), predicted, "px")

    found = measure(geometry)
    if not found.fine and measure(_swapped(geometry)).fine:
        raise CalibrationError(f"{where}: {SWAPPED}")
    return CheckResult((found,), None, None, BLIND_SPOTS["epipolar"])


def _swapped(geometry: Geometry) -> Geometry:
    back = geometry.rotation.T
    return Geometry(geometry.projector, geometry.camera, back, -back @ geometry.translation_mm, geometry.pattern)


def epipolar_error_px(geometry: Geometry, camera_px: FloatArray, projector_px: FloatArray) -> FloatArray:
    """Return how far projector pixels lie beside the epipolar lines of camera pixels, (N,) projector px.

    Parameters
    ----------
    geometry : Geometry
        Where camera and projector stand.
    camera_px, projector_px : (N, 2)
        x, y of pixels that see each other.
    """
    rays, light = geometry.camera.rays_through(camera_px), geometry.projector.rays_through(projector_px)
    t = geometry.translation_mm / np.linalg.norm(geometry.translation_mm)
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    lines = np.insert(rays, 2, 1.0, axis=1) @ (cross @ geometry.rotation).T
    distance = (np.insert(light, 2, 1.0, axis=1) * lines).sum(axis=1) / np.hypot(lines[:, 0], lines[:, 1])
    return np.asarray(distance * np.sqrt(geometry.projector.matrix[0, 0] * geometry.projector.matrix[1, 1]))
