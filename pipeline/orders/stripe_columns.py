"""Which column of the projector a camera's pixel sees at every order that it may have.

A pixel's ray crosses the stripes, and its column changes by a few projector px over all depths: a polynomial of the
order, whose coefficients change slowly over the picture.
"""

import warnings

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.calibration import Geometry
from pipeline.models import FloatArray
from tikernels.order_evidence.contrast_reading import BLOCK_WIDTH

# Nodes are about so many px apart; between them coefficients go in straight lines.
_NODE_PX = 16
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
        lines = [np.rint(np.linspace(0, side - 1, side // _NODE_PX + 2)).astype(int) for side in rays.shape[:2]]
        nodes = rays[np.ix_(*lines)].astype(np.float64)
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
        powers = (order / self.cycles)[..., None] ** np.arange(_DEGREE + 1)
        weighted = powers * counts[..., None]
        normal = weighted.swapaxes(-1, -2) @ powers + 1e-9 * np.eye(_DEGREE + 1)
        fitted = np.linalg.solve(normal, weighted.swapaxes(-1, -2) @ column[..., None])[..., 0]
        self._lines = lines
        #: Projector px along the stripe that a block's width sees, about.
        inside = np.where(counts, column, np.nan)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # nodes that see nothing
            middles = np.nanmedian(inside, axis=-1)
            self.block_px = float(np.nanmedian(np.abs(np.diff(middles, axis=1)) / np.diff(lines[1])) * BLOCK_WIDTH)
        self._nodes = np.where(counts.sum(axis=-1)[..., None] > _DEGREE, fitted, np.nan).astype(np.float32)

    def at(self, place: FloatArray, orders: npt.NDArray[np.integer]) -> npt.NDArray[np.float32]:
        """Return the columns, px, at places (N, 2) (row and column, px) and orders (N, n); NaN where there is none."""
        where = np.stack(
            [np.interp(p, line, np.arange(len(line))) for p, line in zip(place.T, self._lines, strict=True)], 1
        )
        where = where.astype(np.float32)
        terms = cv2.remap(
            self._nodes, where[:, None, 1], where[:, None, 0], cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE
        )
        share = (orders / self.cycles).astype(np.float32)
        terms = terms[:, 0, :, None]
        return np.asarray(terms[:, 0] + share * (terms[:, 1] + share * (terms[:, 2] + share * terms[:, 3])))
