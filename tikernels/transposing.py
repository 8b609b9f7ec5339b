"""Turn rows into columns: every stage works on stripes along the rows, and vertical stripes are turned to it once."""

import numpy as np

from tikernels import checks
from tikernels._taichi import AnyArray2, AnyArray3, ti
from tikernels.arrays import Array, E
from tikernels.launching import kernel

_TYPES = (np.uint8, np.uint16, np.int32, np.float32)


@kernel
def transpose_kernel(
    image: AnyArray2,  # (H, W)
    out: AnyArray2,  # (W, H)
):
    for pixel in range(out.shape[0] * out.shape[1]):
        y, x = pixel // out.shape[1], pixel % out.shape[1]
        out[y, x] = image[x, y]


@kernel
def transpose_color_kernel(
    image: AnyArray3,  # (H, W, 3)
    out: AnyArray3,  # (W, H, 3)
):
    for pixel in range(out.shape[0] * out.shape[1]):
        y, x = pixel // out.shape[1], pixel % out.shape[1]
        for k in ti.static(range(3)):
            out[y, x, k] = image[x, y, k]


def transpose(image: Array[E], out: Array[E] | None = None) -> Array[E]:
    """Return the image with rows and columns exchanged.

    Parameters
    ----------
    image : (H, W) or (H, W, 3) uint8, uint16, int32 or float32
        Anything.
    out : (W, H) or (W, H, 3), optional
        The same element type.

    Returns
    -------
    (W, H) or (W, H, 3)
        The same element type, in a buffer of the device if none is given.

    Raises
    ------
    ShapeError
        The image has another shape or dtype, or `out` cannot be written.

    Examples
    --------
    >>> import numpy as np, tikernels
    >>> _ = tikernels.init("cpu")
    >>> transpose(np.array([[1, 2, 3]], np.uint8)).tolist()
    [[1], [2], [3]]
    """
    colored = len(getattr(image, "shape", ())) == 3
    image = checks.read_array("image", image, (None, None, 3) if colored else (None, None), *_TYPES)
    shape = (image.shape[1], image.shape[0], *image.shape[2:])
    out = checks.out_buffer("out", out, shape, checks.element_type(image))
    kernel = transpose_color_kernel if colored else transpose_kernel
    kernel(image, out)
    return out
