"""A decoded frame as a triangle mesh."""

import numpy as np

from pipeline.export import Mesh
from pipeline.results import DecodedFrame
from tikernels.meshing import triangulate_mesh

# An edge of the mesh may rise by this many times what neighbouring pixels are apart: steeper surfaces are steps.
_MAX_SLOPE = 10.0
# Without a calibration: a neighbour that departs by this much lies on another surface.
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
    values = frame.range_image
    mask = frame.mask & np.isfinite(values)
    if frame.points is not None:
        points = frame.points
        # Pixels are apart by their distance times the ray's change from one to the next.
        gaps = np.linalg.norm(np.diff(points, axis=1)[..., :2], axis=-1)
        known = np.isfinite(gaps)
        max_step = _MAX_SLOPE * float(np.median(gaps[known])) if known.any() else 1.0
    else:
        height, width = values.shape
        x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        points = np.stack([x, y, values], axis=-1)
        max_step = _MAX_STEP_RAD
    faces = triangulate_mesh(np.where(mask[..., None], points, np.float32(0)), mask, max_step)
    properties = {
        "modulation": frame.modulation,
        "sigma_rad": frame.phase_sigma,
        "order_error_probability": frame.order_error_probability,
    }
    if frame.point_sigma is not None:
        properties["sigma_mm"] = frame.point_sigma
    return Mesh(
        vertices=np.ascontiguousarray(points[mask]),
        faces=faces,
        properties={name: values[mask] for name, values in properties.items()},
        unit="mm" if frame.points is not None else "rad",
    )
