"""Planes and spheres through points, some of which lie elsewhere."""

import numpy as np
import numpy.typing as npt

from pipeline.errors import RenderError
from pipeline.robust import robust_sigma

Points = npt.NDArray[np.floating]

# Fits, each of what lies within three standard deviations of the one before.
_FITS, _WITHIN = 8, 3.0


def plane_deviation(points: Points, shown: Points) -> npt.NDArray[np.float32]:
    """Return how far points lie from a plane fitted to others, mm; more than 0 before it, towards the camera.

    Parameters
    ----------
    points : (M, 3) float
        What the plane is fitted to by least squares, without those far from it.
    shown : (N, 3) float
        The points.

    Raises
    ------
    RenderError
        Fewer than 3 points.
    """
    near = _enough(points, 3, "a plane")
    for _ in range(_FITS):
        middle = near.mean(axis=0)
        normal = np.linalg.eigh(np.cov((near - middle).T))[1][:, 0]
        normal *= -1 if normal[2] > 0 else 1
        near = _within(points, (points - middle) @ normal)
    return np.asarray((shown - middle) @ normal, np.float32)


def sphere_deviation(points: Points, shown: Points) -> npt.NDArray[np.float32]:
    """Return how far points lie from a sphere fitted to others, mm; more than 0 outside it.

    Parameters
    ----------
    points : (M, 3) float
        What the sphere is fitted to by least squares, without those far from it.
    shown : (N, 3) float
        The points.

    Raises
    ------
    RenderError
        Fewer than 4 points, or they are flat.
    """
    near = _enough(points, 4, "a sphere")
    for _ in range(_FITS):
        start = near.mean(axis=0)
        around = near - start
        # |p|^2 = 2 p c + (r^2 - |c|^2) is linear in the centre c.
        rows = np.column_stack([2 * around, np.ones(len(around))])
        solution, _, rank, _ = np.linalg.lstsq(rows, (around**2).sum(axis=1), rcond=1e-9)
        if rank < 4:
            raise RenderError("a sphere cannot be fitted: the surface is flat, use the colours of a plane")
        middle = start + solution[:3]
        radius = np.sqrt(solution[3] + solution[:3] @ solution[:3])
        near = _within(points, np.linalg.norm(points - middle, axis=1) - radius)
    return np.asarray(np.linalg.norm(shown - middle, axis=1) - radius, np.float32)


def _enough(points: Points, least: int, what: str) -> Points:
    if len(points) < least:
        raise RenderError(f"{what} cannot be fitted to {len(points)} points: use other colours")
    return points.astype(np.float64)


def _within(points: Points, residuals: Points) -> Points:
    near = np.abs(residuals) <= max(_WITHIN * robust_sigma(residuals.astype(np.float64)), 1e-9)
    return np.asarray(points[near], np.float64)
