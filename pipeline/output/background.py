"""The wanted part of a range image: a box, or the object, which is in front of the background.

The background is the largest plane: the one that most points lie on, by their standard deviations and one per mille of
their distance, of planes through three points drawn by chance [1]; then a plane fitted to those by least squares, with
their residuals' own scatter as the tolerance. What it meets only in passing, as an object that is on it or reaches
through it, stays: a pixel belongs to the plane where a square of pixels around it does.

In a range image without points the plane is found in 1 / depth, which a camera without a lens's distortion sees as a
linear function of x and y wherever there is a plane.

References
----------
1. M. A. Fischler, R. C. Bolles, Random sample consensus, Communications of the ACM 24, 381 (1981),
   doi:10.1145/358669.358692.
"""

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.errors import SettingsError
from pipeline.output.mesh import Mesh
from pipeline.robust import robust_sigma

Floats = npt.NDArray[np.float32]
Pixels = npt.NDArray[np.bool_]

# Points that decide, and planes that are tried: where the plane holds a third of the points, one of 27 samples lies on
# it, and 300 miss it once in 80,000 times.
_POINTS = 5000
_PLANES = 300
# A wall is flat, and a rig calibrated, to this part of the distance.
_FLAT_PART = 1e-3
# Standard deviations from the plane within which a point belongs to it.
_SURE = 3.0
# The largest plane must hold this share of the points to be a background.
_LEAST_SHARE = 0.1
# Points of a plane lie in the middle of the tolerance, with a third of it as their standard deviation at most; those of
# a surface that bends through it fill it, and seem to have three quarters of it.
_MOST_SCATTER = 0.5
# Side of the square that must lie on the plane, px: more than the band, some px wide, in which an object passes it.
_SQUARE_PX = 9

# Least part of all that an object before the wall holds; less is noise, or what sticks to the wall.
_LEAST_PART = 0.01
# Standard deviation that is assumed of a depth without one, as a part of it.
_ASSUMED = 2e-4
# What 1 / depth is scaled to, so that its slopes are small: as the tolerance there is a part of it, any number will do.
_INVERSE = 1000.0


def inside_box(points: Floats, corners_mm: tuple[float, float, float, float, float, float]) -> Pixels:
    """Mark the points in a box.

    Parameters
    ----------
    points : (H, W, 3) float32
        mm, camera frame; NaN where there is none.
    corners_mm : six floats
        Two opposite corners of the box, x0, y0, z0, x1, y1, z1, mm.

    Returns
    -------
    (H, W) bool

    Raises
    ------
    SettingsError
        The second corner is not beyond the first, along all axes.
    """
    low, high = np.array(corners_mm[:3], np.float32), np.array(corners_mm[3:], np.float32)
    if not (low < high).all():
        raise SettingsError(
            f"crop: got x {low[0]:g} to {high[0]:g}, y {low[1]:g} to {high[1]:g}, z {low[2]:g} to {high[2]:g} mm: "
            "each must grow, as in -100 -120 700 100 120 1000"
        )
    return np.asarray(((points >= low) & (points <= high)).all(axis=-1))


def on_largest_plane(points: Floats, sigma: Floats, mask: Pixels, seed: int = 0) -> Pixels:
    """Mark the points on the largest plane; none where no plane holds a tenth of them.

    Parameters
    ----------
    points : (H, W, 3) float32
        mm, camera frame.
    sigma : (H, W) float32
        Their standard deviations, mm.
    mask : (H, W) bool
        True where they are measured.
    seed : int
        Of the planes that are tried; the same one gives the same result.

    Returns
    -------
    (H, W) bool
    """
    places = np.flatnonzero(mask)
    if len(places) < 3:
        return np.zeros(mask.shape, np.bool_)
    rng = np.random.default_rng(seed)
    drawn = rng.choice(places, min(_POINTS, len(places)), replace=False)
    few, doubt = points.reshape(-1, 3)[drawn].astype(np.float64), sigma.ravel()[drawn].astype(np.float64)
    tolerance = _SURE * np.hypot(doubt, _FLAT_PART * few[:, 2])
    normal, offset = _most_popular(few, tolerance, rng)
    for _ in range(3):  # each fit takes in what the one before lets it
        near = np.abs(few @ normal - offset) <= tolerance
        if near.sum() < max(3, _LEAST_SHARE * len(few)):
            return np.zeros(mask.shape, np.bool_)
        normal, offset = _fitted(few[near], doubt[near])
        scatter = robust_sigma(few[near] @ normal - offset)
        if scatter > _MOST_SCATTER * np.median(tolerance):
            return np.zeros(mask.shape, np.bool_)
        tolerance = _SURE * np.hypot(doubt, max(scatter, 1e-6 * few[:, 2].mean()))
    across = np.abs(points @ normal.astype(np.float32) - np.float32(offset))
    near = mask & (across <= _SURE * np.hypot(sigma, np.float32(max(scatter, 1e-6))))
    # A hole of a pixel in the plane is noise; what is narrower than the square is an object that passes the plane.
    square = np.ones((_SQUARE_PX, _SQUARE_PX), np.uint8)
    closed = cv2.morphologyEx(near.view(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    whole = cv2.dilate(cv2.erode(closed, square, borderValue=1), square, borderValue=0)
    return np.asarray(mask & (whole != 0))


def _most_popular(
    points: npt.NDArray[np.float64], tolerance: npt.NDArray[np.float64], rng: np.random.Generator
) -> tuple[npt.NDArray[np.float64], float]:
    """Return normal and offset of the plane through three points that most of all lie near."""
    best, normal, offset = -1, np.array([0.0, 0.0, 1.0]), 0.0
    for _ in range(_PLANES):
        first, second, third = points[rng.choice(len(points), 3, replace=False)]
        across = np.cross(second - first, third - first)
        length = np.linalg.norm(across)
        if length > 0:
            across /= length
            count = int((np.abs(points @ across - across @ first) <= tolerance).sum())
            if count > best:
                best, normal, offset = count, across, float(across @ first)
    return normal, offset


def _fitted(points: npt.NDArray[np.float64], doubt: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.float64], float]:
    """Return normal and offset of the plane that weighted least squares fit."""
    weight = 1 / np.square(np.maximum(doubt, np.median(doubt)))
    middle = np.average(points, axis=0, weights=weight)
    centred = points - middle
    _, axes = np.linalg.eigh((centred * weight[:, None]).T @ centred)
    return axes[:, 0], float(axes[:, 0] @ middle)


def object_pixels(depth: Floats, mask: Pixels) -> Pixels:
    """Mark the object's pixels of a depth image; all of them where there is no wall, or nothing before it.

    Parameters
    ----------
    depth : (H, W) float32
        mm.
    mask : (H, W) bool
        Pixels that hold a depth above 0.

    Returns
    -------
    (H, W) bool
    """
    if not mask.any() or (depth[mask] <= 0).any():
        return mask
    y, x = np.indices(depth.shape, np.float32)
    middle = np.float32(np.median(depth[mask]))
    inverse = np.where(mask, _INVERSE * middle / np.where(mask, depth, 1), np.nan).astype(np.float32)
    sigma = np.where(mask, _ASSUMED * inverse, np.nan).astype(np.float32)
    wall = on_largest_plane(np.stack([x, y, inverse], axis=-1), sigma, mask)
    return _before(wall, mask, depth)


def object_vertices(mesh: Mesh) -> Pixels:
    """Mark the object's vertices of a mesh, (N,) bool; all of them in rad, which has no planes."""
    return _before(wall_vertices(mesh), np.ones(len(mesh.vertices), np.bool_), mesh.vertices[:, 2])


def wall_vertices(mesh: Mesh) -> Pixels:
    """Mark the vertices on the largest plane of a mesh, (N,) bool; none where there is none."""
    if mesh.unit == "rad" or not len(mesh.vertices) or (mesh.vertices[:, 2] <= 0).any():
        return np.zeros(len(mesh.vertices), np.bool_)
    assumed = (_ASSUMED * mesh.vertices[:, 2]).astype(np.float32)
    sigma = mesh.properties.get("sigma_mm", assumed)
    sigma = np.where(np.isfinite(sigma) & (sigma > 0), sigma, assumed)
    # One long row: vertices follow each other as pixels do, so that what meets the plane in passing is recognised, too.
    return np.asarray(on_largest_plane(mesh.vertices[None], sigma[None], np.ones((1, len(sigma)), np.bool_))[0])


def _before(wall: Pixels, mask: Pixels, depth: Floats) -> Pixels:
    """Return what is not the wall; all where there is none, or what is not of the plane lies behind it."""
    rest = mask & ~wall
    if not wall.any() or rest.sum() < _LEAST_PART * mask.sum():
        return mask
    return rest if np.median(depth[rest]) < np.median(depth[wall]) else mask
