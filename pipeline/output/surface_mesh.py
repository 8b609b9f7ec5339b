"""A decoded frame as a triangle mesh."""

import numpy as np
import numpy.typing as npt

from pipeline.decoding.frame import FIELDS, DecodedFrame
from pipeline.output.mesh import Mesh, Unit
from tikernels import runtime
from tikernels.depth.meshing import triangulate_mesh

# An edge of the mesh may rise by this many times what neighbouring pixels are apart: steeper surfaces are steps.
_MAX_SLOPE = 10.0
# Without a calibration: a neighbour that differs by this much lies on another surface.
_MAX_STEP_RAD = 1.0


def frame_mesh(frame: DecodedFrame) -> Mesh:
    """Join a frame's pixels into a mesh, cut at depth steps.

    Parameters
    ----------
    frame : DecodedFrame
        Any decoded frame.

    Returns
    -------
    Mesh
        With a calibration in mm; without one x and y in px and z the relative phase in rad. Modulation, standard
        deviations and the probability of a wrong order go along as vertex properties. Pixels without a range are left
        out, so the mesh of an empty frame has no vertices.
    """
    mask = frame.mask & np.isfinite(frame.range_image)
    properties = {
        field.vertex: getattr(frame, name)[mask]
        for name, field in FIELDS.items()
        if field.vertex is not None and (frame.calibrated or not field.in_mm)
    }
    return surface_mesh(frame.range_image, mask, frame.points, properties)


def surface_mesh(
    values: npt.NDArray[np.float32],
    mask: npt.NDArray[np.bool_],
    points: npt.NDArray[np.float32] | None,
    properties: dict[str, npt.NDArray[np.float32]],
) -> Mesh:
    """Join the pixels of a range image into a mesh, cut at depth steps.

    Parameters
    ----------
    values : (H, W) float32
        Relative phase, rad; of no account where there are points.
    mask : (H, W) bool
        Pixels that have a range.
    points : (H, W, 3) float32 or None
        mm, camera frame.
    properties : dict of (N,) float32
        More about each masked pixel, row by row.
    """
    if points is not None:
        # Pixels are apart by their distance times the ray's change from one to the next.
        gaps = np.linalg.norm(np.diff(points, axis=1)[..., :2], axis=-1)
        known = np.isfinite(gaps)
        max_step = _MAX_SLOPE * float(np.median(gaps[known])) if known.any() else 1.0
        unit: Unit = "mm"
    else:
        height, width = values.shape
        x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        points = np.stack([x, y, values], axis=-1)
        max_step, unit = _MAX_STEP_RAD, "rad"
    with runtime.lock:
        faces = triangulate_mesh(np.where(mask[..., None], points, np.float32(0)), mask, max_step)
    return Mesh(np.ascontiguousarray(points[mask]), faces, properties=properties, unit=unit)
