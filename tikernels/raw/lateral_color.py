"""Bring the colours of a frame onto each other: undo the lateral colour of the camera's lens.

A lens that refracts red and blue differently shifts them from their places; at 12 px per cycle half a pixel of it is
0.14 rad of ripple. Each channel is read at its place by cubic Lagrange interpolation, right to 0.2 % on such a fringe.
"""

import numpy as np
import numpy.typing as npt

from tikernels import checks
from tikernels._taichi import AnyArray3, F32Array2, F32Array3, f32, ti, vec4
from tikernels.arrays import F32, LevelsImage
from tikernels.errors import ShapeError
from tikernels.launching import kernel
from tikernels.raw.linearization import LEVEL_TYPES


@ti.func
def cubic_weights(fraction: f32) -> vec4:
    """Lagrange weights of the samples at -1, 0, 1, 2."""
    before, after, last = fraction + 1.0, fraction - 1.0, fraction - 2.0
    return vec4(
        -fraction * after * last / 6.0,
        before * after * last / 2.0,
        -before * fraction * last / 2.0,
        before * fraction * after / 6.0,
    )


@kernel
def align_channels_kernel(
    image: AnyArray3,  # (H, W, 3) levels
    shift_px: F32Array2,  # (3, 2) x, y by which each channel is shifted from its place
    out: F32Array3,  # (H, W, 3) levels
):
    height, width = image.shape[0], image.shape[1]
    for pixel in range(height * width):
        y, x = pixel // width, pixel % width
        for channel in ti.static(range(3)):
            right, down = ti.floor(shift_px[channel, 0]), ti.floor(shift_px[channel, 1])
            across = cubic_weights(shift_px[channel, 0] - right)
            along = cubic_weights(shift_px[channel, 1] - down)
            left, top = x + ti.cast(right, ti.i32) - 1, y + ti.cast(down, ti.i32) - 1
            value = 0.0
            for i in ti.static(range(4)):
                row = ti.min(ti.max(top + i, 0), height - 1)
                line = 0.0
                for j in ti.static(range(4)):
                    column = ti.min(ti.max(left + j, 0), width - 1)
                    line += across[j] * ti.cast(image[row, column, channel], ti.f32)
                value += along[i] * line
            out[y, x, channel] = value


def align_channels(image: LevelsImage, shift_px: npt.ArrayLike, out: F32 | None = None) -> F32:
    """Undo lateral colour.

    Parameters
    ----------
    image : (H, W, 3) uint8, uint16 or float32
        Levels.
    shift_px : (3, 2)
        Shift of R, G and B from their places, (x, y) in px.
    out : (H, W, 3) float32, optional
        Output array.

    Returns
    -------
    (H, W, 3) float32
        Levels; the border repeats.

    Raises
    ------
    ShapeError
        Shape or dtype is another one, or `out` cannot be written.
    """
    image = checks.read_array("image", image, (None, None, 3), *LEVEL_TYPES)
    shift = np.ascontiguousarray(shift_px, np.float32)
    if shift.shape != (3, 2) or not np.isfinite(shift).all():
        raise ShapeError(f"shift_px must be 3x2 finite numbers, got shape {shift.shape}")
    out = checks.out_array("out", out, tuple(image.shape), np.float32)
    align_channels_kernel(image, shift, out)
    return out
