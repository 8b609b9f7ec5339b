"""How far depth is off by what a calibration itself is uncertain of."""

import cv2
import numpy as np

from pipeline.calibration.bundle_adjustment import project_points
from pipeline.models import FloatArray


def depth_bias_mm(
    parameters: FloatArray, covariance: FloatArray, camera_size_px: tuple[int, int], axis: int, depth_mm: float
) -> float:
    """Return the standard deviation of depth that the calibration's own uncertainty leaves, RMS over the image.

    Parameters
    ----------
    parameters : (24,)
        Camera, projector (fx, fy, cx, cy, k1, k2, p1, p2, k3 each), rotation vector, translation.
    covariance : (24, 24)
        Their covariance.
    camera_size_px : (width, height)
        The camera's.
    axis : int
        Projector axis along which the phase changes.
    depth_mm : float
        Where the object is.
    """
    width, height = camera_size_px
    grid = np.stack(np.meshgrid(np.linspace(0.2, 0.8, 3) * width, np.linspace(0.2, 0.8, 3) * height), -1).reshape(
        -1, 1, 2
    )

    def coordinate(p: FloatArray, depth: FloatArray) -> FloatArray:
        matrix = np.array([[p[0], 0, p[2]], [0, p[1], p[3]], [0, 0, 1]])
        rays = cv2.undistortPoints(grid, matrix, p[4:9]).reshape(-1, 2)
        points = np.concatenate([rays, np.ones((len(rays), 1))], axis=1) * depth[:, None]
        return project_points(points, p[18:21], p[21:24], p[9:18])[0][:, axis]

    depth = np.full(len(grid), depth_mm)
    # A pixel's projector coordinate is measured, so an error of the parameters that changes it shows as depth.
    by_depth = coordinate(parameters, depth + 0.5) - coordinate(parameters, depth - 0.5)
    steps = 1e-3 * np.sqrt(np.diag(covariance))
    by_parameter = np.stack(
        [
            (coordinate(parameters + step, depth) - coordinate(parameters - step, depth)) / (2 * size)
            for size, step in zip(steps, np.diag(steps), strict=True)
        ]
    )
    slopes = by_parameter / by_depth
    return float(np.sqrt(np.einsum("ik,ij,jk->k", slopes, covariance, slopes).mean()))
