"""A lens, of the camera or of the projector: OpenCV's model, and the rays of its pixels."""

from functools import lru_cache
from typing import Annotated, Any

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from pipeline.errors import CalibrationError, FootageError
from pipeline.limits import check_size
from pipeline.models import LARGEST, ArrayOf, FloatArray, Matrix3, Model

# Lengths of OpenCV's lists: radial and tangential, k3, the rational model, thin prisms, a tilted sensor.
_COEFFICIENTS = (4, 5, 8, 12, 14)


def _padded(value: Any) -> Any:
    if isinstance(value, list | tuple) or (isinstance(value, np.ndarray) and value.ndim == 1):
        if len(value) not in _COEFFICIENTS:
            raise ValueError(f"must have 4, 5, 8, 12 or 14 numbers, in OpenCV's order, got {len(value)}")
        return [*value, *[0.0] * (14 - len(value))]
    return value


def _shortest(coefficients: FloatArray) -> FloatArray:
    return coefficients if coefficients[5:].any() else coefficients[:5]


#: 5 or 14 numbers, whatever the file's list is. Long lenses see a tenth of their distance to either side, the sixth
# power of which k3 counts with.
Distortion = Annotated[FloatArray, ArrayOf((14,), 1e4), BeforeValidator(_padded), AfterValidator(_shortest)]

# No picture format that is read has longer sides.
_Side = Annotated[int, Field(gt=0, lt=2**20)]
# Where a lens is searched for a fold: directions, and distances from the axis at unit depth, up to 87 degrees. Near its
# fold a picture hardly grows: a hundredth of the way to it is 1e-4 of the picture.
_ANGLES, _RADII = 72, np.geomspace(1e-3, 20, 1000)
# OpenCV's iteration ends after a few steps, but near a fold.
_MOST_STEPS = 200
# A ray is the right one if it reaches its place to this.
_CLOSE_PX = 1e-3


class Lens(Model):
    """A pinhole with distortion, for the camera as for the projector (OpenCV's model)."""

    error_type = CalibrationError

    size_px: tuple[_Side, _Side]  # width, height
    matrix: Matrix3  # px
    distortion: Distortion = Field(default_factory=lambda: np.zeros(5))  # OpenCV's order: k1 k2 p1 p2 k3 [...]

    @model_validator(mode="after")
    def _check(self) -> "Lens":
        try:
            check_size("the lens", *self.size_px)
        except FootageError as error:
            raise ValueError(str(error)) from None
        m = self.matrix
        if m[0, 0] <= 0 or m[1, 1] <= 0 or np.any(m[[0, 1, 2, 2], [1, 0, 0, 1]] != 0) or m[2, 2] != 1:
            raise ValueError("matrix must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with positive focal lengths")
        return self

    def rays(self, shift_px: npt.NDArray[np.float64] | None = None) -> npt.NDArray[np.float32]:
        """Return where every pixel looks, lens distortion taken out.

        Parameters
        ----------
        shift_px : (2,), optional
            Lateral colour: x, y by which a channel lands off its place.

        Returns
        -------
        (H, W, 2) float32
            x and y of each ray at unit depth; NaN where the lens, which folds, has none.

        Raises
        ------
        CalibrationError
            A ray has no direction, so the lens is none.
        """
        width, height = self.size_px
        rays = np.empty((height, width, 2), np.float32)
        row = np.column_stack([np.arange(width, dtype=np.float64), np.zeros(width)])
        for y in range(height):  # so that nothing but the rays is as large as the picture
            row[:, 1] = y
            rays[y] = self.rays_through(row if shift_px is None else row - shift_px)
        if np.isnan(rays).all():
            raise CalibrationError("no lens bends light like this one: its distortion is wrong, recalibrate")
        return rays

    def rays_through(self, places_px: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Return where places in the picture look, lens distortion taken out.

        Parameters
        ----------
        places_px : (N, 2)
            x, y, px.

        Returns
        -------
        (N, 2) float64
            x and y of each ray at unit depth; NaN where the lens, which folds, has none.

        Raises
        ------
        CalibrationError
            A ray has no direction, so the lens is none.
        """
        rays = np.asarray((places_px - self.matrix[:2, 2]) * (1 / self.matrix[[0, 1], [0, 1]]))
        if not np.abs(rays).max() < LARGEST:
            raise CalibrationError("no lens bends light like this one: its matrix is wrong, recalibrate")
        return self._straightened(rays, places_px) if self.distortion.any() else rays

    def _straightened(self, bent: FloatArray, places_px: FloatArray) -> FloatArray:
        """Return the rays, (N, 2), that the lens bends to these, which reach these places; NaN where there is none.

        Where a model folds, several rays reach a place, and that before the fold is the true one. OpenCV's iteration
        may end at any of them, or at none.
        """
        # OpenCV 4 and 5 take the end of this function's iteration alike, and that of undistortPoints differently.
        end = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, _MOST_STEPS, 1e-10)
        straight_px = cv2.undistortImagePoints(places_px[:, None], self.matrix, self.distortion, None, end)[:, 0]
        rays = np.asarray((straight_px - self.matrix[:2, 2]) * (1 / self.matrix[[0, 1], [0, 1]]), np.float64)
        turn = np.rint(np.arctan2(rays[:, 1], rays[:, 0]) * (_ANGLES / (2 * np.pi)))
        before = np.hypot(*rays.T) < _folds(tuple(self.distortion))[np.nan_to_num(turn).astype(int) % _ANGLES]
        missed_px = (_bend(rays, self.distortion)[0] - bent) * self.matrix[[0, 1], [0, 1]]
        rays[~(before & (np.hypot(*missed_px.T) < _CLOSE_PX))] = np.nan
        return rays


def _bend(rays: FloatArray, distortion: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return where a lens bends rays (N, 2) at unit depth, and the derivative of that by them, (N, 2, 2)."""
    points, nothing = np.insert(rays, 2, 1.0, axis=1), np.zeros(3)
    bent, derivative = cv2.projectPoints(points, nothing, nothing, np.eye(3), distortion)
    return np.asarray(bent[:, 0]), np.asarray(derivative[:, 3:5].reshape(-1, 2, 2))  # by the camera's place


@lru_cache(maxsize=8)
def _folds(distortion: tuple[float, ...]) -> FloatArray:
    """Return how far from the axis, at unit depth, a lens folds in each of several directions; inf where it does not.

    There the picture turns over: the determinant of the derivative is no longer positive.
    """
    angles = 2 * np.pi / _ANGLES * np.arange(_ANGLES)
    rays = np.multiply.outer(np.column_stack([np.cos(angles), np.sin(angles)]), _RADII).swapaxes(1, 2)
    turned = ~(np.linalg.det(_bend(rays.reshape(-1, 2), np.array(distortion))[1]) > 0).reshape(_ANGLES, -1)
    first = np.where(turned.any(axis=1), _RADII[turned.argmax(axis=1)], np.inf)
    return np.asarray(np.minimum.reduce([np.roll(first, turn) for turn in (-1, 0, 1)]))
