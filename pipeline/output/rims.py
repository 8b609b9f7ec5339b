"""The line in which a surface ends, between pixels.

Where a surface turns away, the next pixel is millimetres deeper, and a rim that goes from pixel to pixel is jagged when
it is seen from the side. So the last vertices move along their surface, by less than half a pixel, to where a blurred
image of its pixels has the value of a straight rim.
"""

from math import erf, exp, pi, sqrt

import cv2
import numpy as np
import numpy.typing as npt

# Standard deviation of the blur: over some five pixels the stairs of a slanting rim are even, px.
_BLUR_PX = 1.5
# What the blurred image is in the last pixels before a straight rim, half a pixel from it, and by how much it changes
# there from one to the next.
_STRAIGHT = 0.5 * (1 + erf(0.5 / (_BLUR_PX * sqrt(2))))
_STEEPNESS = exp(-0.5 * (0.5 / _BLUR_PX) ** 2) / (_BLUR_PX * sqrt(2 * pi))
# Where it changes by less than a fourth as much there is no line, as at the end of something thin.
_LEAST_STEEPNESS = 0.25 * _STEEPNESS
# A vertex stays nearest to its own pixel.
_MOST_PX = 0.49


def rim_shifts(kept: npt.NDArray[np.bool_]) -> npt.NDArray[np.float32]:
    """Return by how much the vertices of rims move to be in line.

    Parameters
    ----------
    kept : (H, W) bool
        Pixels that are vertices.

    Returns
    -------
    (H, W, 2) float32
        Down and to the right, px; 0 inside surfaces. The image's own border is no rim.
    """
    pixels = kept.view(np.uint8)
    # Beyond the image surfaces go on as at its border.
    border = cv2.copyMakeBorder(pixels, 1, 1, 1, 1, cv2.BORDER_REPLICATE)
    rim = kept & (cv2.erode(border, np.ones((3, 3), np.uint8))[1:-1, 1:-1] == 0)
    blurred = cv2.GaussianBlur(pixels.astype(np.float32), (0, 0), _BLUR_PX, borderType=cv2.BORDER_REPLICATE)
    down, right = (
        cv2.Sobel(blurred, -1, *axes, scale=1 / 8, borderType=cv2.BORDER_REPLICATE)[rim] for axes in ((0, 1), (1, 0))
    )
    square = down**2 + right**2
    clear = square > _LEAST_STEEPNESS**2
    step = np.where(clear, (_STRAIGHT - blurred[rim]) / np.where(clear, square, 1), 0)
    moved = np.stack([step * down, step * right], axis=-1)
    moved *= np.minimum(1, _MOST_PX / np.maximum(np.abs(moved).max(axis=-1, keepdims=True), 1e-6))
    shifts = np.zeros((*kept.shape, 2), np.float32)
    shifts[rim] = moved
    return shifts
