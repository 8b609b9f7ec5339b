"""Columns of the projector that a camera's pixel sees at every order that it may have.

A pixel's ray crosses the stripes, and its column changes by a few projector px over all depths: a polynomial of the
order, whose coefficients change slowly over the picture.
"""

import warnings
from copy import copy

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.calibration import Geometry
from pipeline.models import FloatArray
from tikernels.order_evidence.contrast_reading import BLOCK_WIDTH
from tikernels.order_evidence.modulation_correction import NODE_PX

# The polynomial's degree, and depths along a node's ray, evenly in one over the distance, as multiples of the first.
_DEGREE, _DEPTHS, _FARTHEST = 3, 64, 50.0
# The pattern seen from outside by this many cycles still counts for the fit.
_MARGIN = 1.0


class StripeColumns:
    """Columns of the projector along the stripe, by place in the image and order.

    Parameters
    ----------
    geometry : Geometry
        Of the rig.
    rays : (H, W, 2) float32
        x and y at unit depth, stripes along the rows.
    """

    def __init__(self, geometry: Geometry, rays: npt.NDArray[np.float32]) -> None:
        axis, pattern = geometry.phase_axis, geometry.pattern
        self.cycles = geometry.projector.size_px[axis] / pattern.period_px
        nodes = _extended(_extended(rays.astype(np.float64)).swapaxes(0, 1)).swapaxes(0, 1)
        directions = np.concatenate([nodes, np.ones((*nodes.shape[:2], 1))], axis=-1)
        baseline = float(np.linalg.norm(geometry.translation_mm))
        depths = baseline / np.linspace(1, 1 / _FARTHEST, _DEPTHS)
        points = directions[:, :, None] * depths[:, None]
        turn, lens = cv2.Rodrigues(geometry.rotation)[0], geometry.projector
        seen = cv2.projectPoints(points.reshape(-1, 3), turn, geometry.translation_mm, lens.matrix, lens.distortion)
        pixels = seen[0].reshape(*points.shape[:3], 2)
        order, column = pixels[..., axis] / pattern.period_px, pixels[..., 1 - axis]
        counts = (order > -_MARGIN) & (order < self.cycles + _MARGIN)
        counts &= points @ geometry.rotation[2] + geometry.translation_mm[2] > 0
        scale = self.cycles ** -np.arange(_DEGREE + 1.0)
        powers = order[..., None] ** np.arange(_DEGREE + 1) * scale
        weighted = powers * counts[..., None]
        normal = weighted.swapaxes(-1, -2) @ powers + 1e-9 * np.eye(_DEGREE + 1)
        fitted = np.linalg.solve(normal, weighted.swapaxes(-1, -2) @ column[..., None])[..., 0]
        #: Projector px along the stripe that a block's width sees, about.
        inside = np.where(counts, column, np.nan)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # nodes that see nothing
            middles = np.nanmedian(inside, axis=-1)
            self.block_px = float(np.nanmedian(np.abs(np.diff(middles, axis=1))) * BLOCK_WIDTH / NODE_PX)
        #: (rows, columns, 4) float32: terms of a polynomial of the order, at nodes.
        self.nodes = np.where(counts.sum(axis=-1)[..., None] > _DEGREE, fitted * scale, np.nan).astype(np.float32)

    def shifted(self, shift_px: float) -> "StripeColumns":
        """Return the columns if the picture lies so many px further along the stripe."""
        moved = copy(self)
        moved.nodes = self.nodes + np.array([shift_px, 0, 0, 0], np.float32)
        return moved

    def terms(self, place: FloatArray) -> npt.NDArray[np.float32]:
        """Return the polynomials' terms (N, 4) at places (N, 2) (row, column; px); NaN where no order has a column."""
        last = np.array(self.nodes.shape[:2]) - 2
        node = np.clip((place / NODE_PX).astype(int), 0, last)
        down, right = (place / NODE_PX - node).astype(np.float32).T[..., None]
        upper, lower = (
            self.nodes[row, node[:, 1]] * (1 - right) + self.nodes[row, node[:, 1] + 1] * right
            for row in (node[:, 0], node[:, 0] + 1)
        )
        return np.asarray(upper + down * (lower - upper))


def column_at(terms: npt.NDArray[np.float32], orders: npt.NDArray[np.number]) -> npt.NDArray[np.float32]:
    """Return the columns, px, that (N, 4) terms give at orders (N, ...)."""
    order = np.asarray(orders, np.float32)
    first, *others = (terms[:, k].reshape(-1, *(1,) * (order.ndim - 1)) for k in (3, 2, 1, 0))
    columns = first
    for term in others:
        columns = columns * order + term
    return columns


def _extended(rays: FloatArray) -> FloatArray:
    """Return every NODE_PX-th of the rows, and one beyond the last."""
    count = (len(rays) - 1) // NODE_PX + 2
    beyond = (count - 1) * NODE_PX - (len(rays) - 1)
    last = rays[-1] + beyond * (rays[-1] - rays[-2])
    return np.concatenate([rays[: (count - 1) * NODE_PX : NODE_PX], last[None]])
