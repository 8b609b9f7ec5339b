"""Normals of a surface that is seen along pixels' rays, by the slopes of its depth.

A point is z r(x, y), with r = (r_x, r_y, 1) its pixel's ray. From column to column and from row to row it moves by

    t_x = z_x r + z r_x,    t_y = z_y r + z r_y,

and t_y x t_x points back at the camera. The rays are read off the points themselves: a cubic of the pixel's place, as
OpenCV's first radial coefficient and its tangential ones make them.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float32]
Pixels = npt.NDArray[np.bool_]

# Rays that a cubic is fitted to: its twenty coefficients are then known better than float32 keeps them.
_SAMPLES = 4000
_DEGREE = 3


@dataclass(frozen=True, eq=False)
class PixelRays:
    """The rays of an image's pixels: x and y at unit depth, as a cubic of the pixel's place."""

    coefficients: npt.NDArray[np.float64]  # (4, 4, 2) of powers of the row and the column; 0 beyond the third together
    shape: tuple[int, int]

    @classmethod
    def of(cls, points: Floats, mask: Pixels) -> "PixelRays":
        """Read them off points.

        Parameters
        ----------
        points : (H, W, 3) float32
            mm, camera frame.
        mask : (H, W) bool
            Where they are; in one pixel at least.
        """
        places = np.flatnonzero(mask)
        y, x = np.divmod(places[:: max(1, len(places) // _SAMPLES)], mask.shape[1])
        sampled = points[y, x].astype(np.float64)
        down, right = np.nonzero(np.add.outer(range(_DEGREE + 1), range(_DEGREE + 1)) <= _DEGREE)
        size = max(mask.shape)
        terms = (y[:, None] / size) ** down * (x[:, None] / size) ** right
        coefficients = np.zeros((_DEGREE + 1, _DEGREE + 1, 2))
        coefficients[down, right] = np.linalg.lstsq(terms, sampled[:, :2] / sampled[:, 2:])[0]
        return cls(coefficients, mask.shape)

    def at(self, places: npt.NDArray[np.intp]) -> Floats:
        """Return the rays of some pixels of the flat image, (N, 3), one mm deep."""
        return np.column_stack([self._values(places, 0, 0), np.ones(len(places), np.float32)])

    def changes(self, places: npt.NDArray[np.intp]) -> tuple[Floats, Floats]:
        """Return how rays change from column to column and from row to row, (N, 3) each."""
        level = np.zeros(len(places), np.float32)
        right, down = (self._values(places, *orders) for orders in ((0, 1), (1, 0)))
        return np.column_stack([right, level]), np.column_stack([down, level])

    def _values(self, places: npt.NDArray[np.intp], down: int, right: int) -> Floats:
        """Return the cubic, or its derivative down or to the right, (N, 2)."""
        size, powers = max(self.shape), np.arange(_DEGREE + 1)

        def terms(length: int, order: int) -> npt.NDArray[np.float64]:
            at = np.arange(length)[:, None] / size
            return at**powers if order == 0 else powers * at ** np.maximum(powers - 1, 0) / size

        width = self.shape[1]
        first = int(places.min(initial=self.shape[0] * width)) // width  # the rows before are not asked for
        last = int(places.max(initial=0)) // width + 1
        rows, columns = terms(self.shape[0], down)[first:last], terms(width, right)
        grids = ((rows @ self.coefficients[..., k]).astype(np.float32) @ columns.T.astype(np.float32) for k in range(2))
        return np.column_stack([grid.ravel()[places - first * width] for grid in grids])


def surface_normals(depth: Floats, slope: Floats, rays: Floats, changes: tuple[Floats, Floats]) -> Floats:
    """Return unit vectors across a surface, towards the camera.

    Parameters
    ----------
    depth : (N,) float32
        mm.
    slope : (N, 2) float32
        Its change from row to row and from column to column.
    rays : (N, 3) float32
        One mm deep.
    changes : two of (N, 3) float32
        Their changes from column to column and from row to row.
    """
    along, down = changes
    across = np.cross(
        slope[:, :1] * rays + depth[:, None] * down,
        slope[:, 1:] * rays + depth[:, None] * along,
    )
    return _unit(across)


def relief_normals(slope: Floats) -> Floats:
    """Return unit vectors across a relief over an image, in px and rad, towards the camera: see `surface_normals`."""
    return _unit(np.column_stack([slope[:, 1], slope[:, 0], np.full(len(slope), -1, np.float32)]))


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True), np.float32)
