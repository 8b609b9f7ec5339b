"""Wide Gaussian averages of pictures: as smooth on a coarser grid, at a part of the time."""

import cv2
import numpy as np
import numpy.typing as npt

from tikernels import runtime

# A Gaussian's standard deviation in cells of the coarser grid, at least.
_LEAST_CELLS = 2
# What averaging over a cell (1/12) and interpolating between cells (1/6) add to the Gaussian's variance, in cells^2.
_ADDED = 0.25


def wide_blur(values: npt.NDArray[np.float32], along_px: float, across_px: float) -> npt.NDArray[np.float32]:
    """Return Gaussian averages of every pixel's surroundings; beyond the picture there are zeros.

    Parameters
    ----------
    values : (H, W) or (H, W, 3) float32
        On the host.
    along_px, across_px : float
        Standard deviations along and across the rows, px.

    Returns
    -------
    array like `values`
        From `runtime.empty_on_host`.
    """
    height, width = values.shape[:2]
    size, sigmas = [], []
    for length, sigma_px in ((width, along_px), (height, across_px)):
        size.append(-(-length // max(1, int(sigma_px / _LEAST_CELLS))))
        cell_px = length / size[-1]
        sigmas.append(np.sqrt((sigma_px / cell_px) ** 2 - _ADDED * (cell_px > 1)))
    coarse = cv2.resize(values, size, interpolation=cv2.INTER_AREA)
    along, across = sigmas
    blurred = cv2.GaussianBlur(coarse, (0, 0), along, sigmaY=across, borderType=cv2.BORDER_CONSTANT)
    out = runtime.empty_on_host(values.shape, np.float32)
    cv2.resize(blurred, (width, height), out, interpolation=cv2.INTER_LINEAR)
    return out
