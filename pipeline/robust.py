"""Statistics, and shapes through points, that a few outliers do not move."""

import numpy as np

from pipeline.models import FloatArray


def robust_sigma(residuals: FloatArray) -> float:
    """Return the standard deviation that normal residuals about zero have, from the median of their sizes."""
    return 1.4826 * float(np.median(np.abs(residuals)))


# Fits of a shape, each to what lies within four standard deviations of the one before.
_FITS, _WITHIN = 4, 4.0


def _near(points: FloatArray, residuals: FloatArray) -> FloatArray:
    return np.asarray(points[np.abs(residuals) <= max(_WITHIN * robust_sigma(residuals), 1e-9)])


def fit_plane(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a point (3,) of the plane that is nearest to most of some points (N, 3), and its normal (3,)."""
    near = points
    for _ in range(_FITS):
        middle = near.mean(axis=0)
        normal = np.linalg.eigh(np.cov((near - middle).T))[1][:, 0]
        near = _near(points, (points - middle) @ normal)
    return middle, normal


def fit_sphere(points: FloatArray, known_radius: float | None = None) -> tuple[FloatArray, float] | None:
    """Return centre (3,) and radius of the sphere that is nearest to most of points (N, 3); None: they are flat.

    Where the radius is known, the centre is that of a sphere of this radius.
    """
    near = points
    for _ in range(_FITS):
        start = near.mean(axis=0)
        around = near - start
        # |p|^2 = 2 p c + (r^2 - |c|^2) is linear in the centre c.
        rows = np.column_stack([2 * around, np.ones(len(around))])
        solution, _, rank, _ = np.linalg.lstsq(rows, (around**2).sum(axis=1), rcond=1e-9)
        if rank < 4:
            return None
        centre = start + solution[:3]
        radius = float(np.sqrt(solution[3] + solution[:3] @ solution[:3]))
        near = _near(points, np.linalg.norm(points - centre, axis=1) - radius)
    free = 4 if known_radius is None else 3
    radius = known_radius or radius
    for _ in range(_FITS):  # Gauss-Newton steps take out what squares of distances weigh wrong
        distance = np.linalg.norm(near - centre, axis=1)
        rows = np.column_stack([(near - centre) / distance[:, None], np.ones(len(near))])[:, :free]
        step = np.zeros(4)
        step[:free] = np.linalg.lstsq(rows, distance - radius, rcond=None)[0]
        centre, radius = centre + step[:3], radius + float(step[3])
        near = _near(points, np.linalg.norm(points - centre, axis=1) - radius)
    return centre, radius
