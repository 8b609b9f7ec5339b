"""Which of what a camera sees is the object: what stands before the wall, and not the wall.

The wall is the largest plane (see `pipeline.output.background`). In a range image it is looked for in 1 / depth, which
a camera without a lens's distortion sees as a linear function of x and y wherever there is a plane.
"""

import numpy as np
import numpy.typing as npt

from pipeline.output.background import on_largest_plane
from pipeline.output.mesh import Mesh

Floats = npt.NDArray[np.float32]
Pixels = npt.NDArray[np.bool_]

# Least part of all that an object before the wall holds; less is noise, or what sticks to the wall.
_LEAST_PART = 0.01
# Standard deviation that is assumed of a depth that tells none, as a part of it.
_ASSUMED = 2e-4
# What 1 / depth is scaled to, so that its slopes are small: as the tolerance there is a part of it, any number will do.
_INVERSE = 1000.0


def object_pixels(depth: Floats, mask: Pixels) -> Pixels:
    """Tell which pixels of a depth image are of the object; all of them where there is no wall, or nothing before it.

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
    """Tell which vertices of a mesh are of the object, (N,) bool; all of them in rad, which has no planes."""
    return _before(wall_vertices(mesh), np.ones(len(mesh.vertices), np.bool_), mesh.vertices[:, 2])


def wall_vertices(mesh: Mesh) -> Pixels:
    """Tell which vertices of a mesh lie on its largest plane, (N,) bool; none where there is none."""
    if mesh.unit == "rad" or not len(mesh.vertices) or (mesh.vertices[:, 2] <= 0).any():
        return np.zeros(len(mesh.vertices), np.bool_)
    assumed = (_ASSUMED * mesh.vertices[:, 2]).astype(np.float32)
    sigma = mesh.properties.get("sigma_mm", assumed)
    sigma = np.where(np.isfinite(sigma) & (sigma > 0), sigma, assumed)
    # One long row: vertices follow each other as pixels do, so that what meets the plane in passing is told here, too.
    return np.asarray(on_largest_plane(mesh.vertices[None], sigma[None], np.ones((1, len(sigma)), np.bool_))[0])


def _before(wall: Pixels, mask: Pixels, depth: Floats) -> Pixels:
    """Return what is not the wall; all where there is none, or what is not of the plane lies behind it."""
    rest = mask & ~wall
    if not wall.any() or rest.sum() < _LEAST_PART * mask.sum():
        return mask
    return rest if np.median(depth[rest]) < np.median(depth[wall]) else mask
