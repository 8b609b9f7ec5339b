"""Develop a frame: from the form in which it was stored to RGB."""

from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from tikernels import _checks, runtime
from tikernels._taichi import AnyArray2, AnyArray3, F32Array3, f32, ti
from tikernels.chroma import convert_chroma
from tikernels.demosaicing import demosaic
from tikernels.errors import ShapeError
from tikernels.pixel_format import PixelFormat


@cache
def _reorder_packed_kernel(channels: str) -> Any:
    places = tuple(channels.index(color) for color in "rgb")

    @ti.kernel
    def reorder_packed_kernel(
        image: AnyArray3,  # (H, W, 3 or 4) levels
        scale: f32,  # 1 / white level
        out: F32Array3,  # (H, W, 3) encoded RGB, 0..1
    ):
        for y, x in ti.ndrange(image.shape[0], image.shape[1]):
            for i in ti.static(range(3)):
                out[y, x, i] = scale * ti.cast(image[y, x, places[i]], ti.f32)

    return reorder_packed_kernel


@ti.kernel
def _join_planes_kernel(
    red: AnyArray2,  # (H, W) levels
    green: AnyArray2,  # (H, W) levels
    blue: AnyArray2,  # (H, W) levels
    scale: f32,  # 1 / white level
    out: F32Array3,  # (H, W, 3) encoded RGB, 0..1
):
    for y, x in ti.ndrange(red.shape[0], red.shape[1]):
        out[y, x, 0] = scale * ti.cast(red[y, x], ti.f32)
        out[y, x, 1] = scale * ti.cast(green[y, x], ti.f32)
        out[y, x, 2] = scale * ti.cast(blue[y, x], ti.f32)


def develop(
    planes: tuple[npt.NDArray[Any], ...], format: PixelFormat, *, stripes: str = "horizontal", out: Any | None = None
) -> Any:
    """Turn a frame's planes into RGB, still encoded as the camera encoded it.

    Parameters
    ----------
    planes : tuple of arrays
        As stored, see `PixelFormat`; rows may be padded.
    format : PixelFormat
        How.
    stripes : {"horizontal", "vertical"}
        Which way the fringe runs; a mosaic's missing colours are taken from along it.
    out : (H, W, 3) float32, optional
        Where the result goes, unless it needs no computing.

    Returns
    -------
    (H, W, 3) uint8, uint16 or float32
        RGB whose full scale is its type's (255, 65535, 1.0): the plane itself where that is what it holds, else
        float32 in `out` or a buffer of the device.

    Raises
    ------
    ShapeError
        A plane has another shape or type than the format says, or `out` cannot be written.
    """
    n_planes = {"rgb": (1, 3), "bayer": (1,), "yuv": (2,) if format.interleaved else (3,)}[format.layout]
    if len(planes) not in n_planes:
        raise ShapeError(f"{format.layout} frame has {len(planes)} planes, expected {' or '.join(map(str, n_planes))}")
    if format.layout == "yuv":
        return convert_chroma(planes, format, out)
    if format.layout == "bayer":
        return demosaic(planes[0], format, stripes, out)
    shape = (None, None, len(format.channels)) if len(planes) == 1 else planes[0].shape[:2]
    planes = tuple(_checks.read_array("plane", plane, shape, format.dtype) for plane in planes)
    if len(planes) == 1 and format.channels == "rgb" and format.white_level in (255, 65535, 1):
        return planes[0]
    height, width = planes[0].shape[:2]
    if out is None:
        out = runtime.empty((height, width, 3), np.float32)
    out = _checks.out_array("out", out, (height, width, 3), np.float32)
    if len(planes) == 1:
        _reorder_packed_kernel(format.channels)(planes[0], 1 / format.white_level, out)
    else:
        _join_planes_kernel(*(planes[format.channels.index(color)] for color in "rgb"), 1 / format.white_level, out)
    return out
