"""Turn rows into columns: every stage works on stripes along the rows, and vertical stripes are turned to it once."""

from typing import Any

from tikernels import runtime
from tikernels._checks import dtype_name
from tikernels._taichi import AnyArray2, AnyArray3, ti


@ti.kernel
def transpose_kernel(
    image: AnyArray2,  # (H, W)
    out: AnyArray2,  # (W, H)
):
    for pixel in range(out.shape[0] * out.shape[1]):
        y, x = pixel // out.shape[1], pixel % out.shape[1]
        out[y, x] = image[x, y]


@ti.kernel
def transpose_color_kernel(
    image: AnyArray3,  # (H, W, 3)
    out: AnyArray3,  # (W, H, 3)
):
    for pixel in range(out.shape[0] * out.shape[1]):
        y, x = pixel // out.shape[1], pixel % out.shape[1]
        for k in ti.static(range(3)):
            out[y, x, k] = image[x, y, k]


def transpose(image: Any, out: Any | None = None) -> Any:
    """Return the image with rows and columns exchanged, in a buffer of the device if none is given.

    Parameters
    ----------
    image : (H, W) or (H, W, 3)
        Any element type.
    out : (W, H) or (W, H, 3), optional
        The same element type.
    """
    if out is None:
        out = runtime.empty((image.shape[1], image.shape[0], *image.shape[2:]), dtype_name(image))
    kernel = transpose_kernel if len(image.shape) == 2 else transpose_color_kernel
    kernel(image, out)
    return out
