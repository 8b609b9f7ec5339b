"""Develop a frame: from the form in which it was stored to RGB."""

from functools import cache
from typing import Any, cast

from tikernels import checks
from tikernels._taichi import AnyArray2, AnyArray3, f32, ti
from tikernels.arrays import F32, LevelsImage, Plane
from tikernels.errors import ShapeError
from tikernels.launching import kernel
from tikernels.raw.chroma_upsampling import convert_chroma
from tikernels.raw.demosaicing import demosaic
from tikernels.raw.pixel_format import PixelFormat


@cache
def _reorder_channels_kernel(channels: str, scaled: bool) -> Any:
    places = tuple(channels.index(color) for color in "rgb")

    @kernel
    def reorder_channels_kernel(
        image: AnyArray3,  # (H, W, 3 or 4) levels
        scale: f32,  # 1 / white level
        out: AnyArray3,  # (H, W, 3) RGB; where scaled 0..1, else levels
    ):
        for y, x in ti.ndrange(image.shape[0], image.shape[1]):
            for i in ti.static(range(3)):
                value = image[y, x, places[i]]
                out[y, x, i] = scale * ti.cast(value, f32) if ti.static(scaled) else value

    return reorder_channels_kernel


@cache
def _join_planes_kernel(scaled: bool) -> Any:
    @kernel
    def join_planes_kernel(
        red: AnyArray2,  # (H, W) levels
        green: AnyArray2,  # (H, W) levels
        blue: AnyArray2,  # (H, W) levels
        scale: f32,  # 1 / white level
        out: AnyArray3,  # (H, W, 3) RGB; where scaled 0..1, else levels
    ):
        for y, x in ti.ndrange(red.shape[0], red.shape[1]):
            for i, plane in ti.static(enumerate((red, green, blue))):
                out[y, x, i] = scale * ti.cast(plane[y, x], f32) if ti.static(scaled) else plane[y, x]

    return join_planes_kernel


def develop(
    planes: tuple[Plane, ...], format: PixelFormat, *, stripes: str = "horizontal", out: LevelsImage | None = None
) -> LevelsImage:
    """Turn a frame's planes into RGB, still encoded as the camera encoded it.

    Parameters
    ----------
    planes : tuple of arrays
        As stored, see `PixelFormat`; rows may be padded.
    format : PixelFormat
        Storage format.
    stripes : {"horizontal", "vertical"}
        Direction of the fringe; a mosaic's missing colours are taken from along it.
    out : (H, W, 3) of `format.rgb_dtype`, optional
        Output array, unless it needs no computing.

    Returns
    -------
    (H, W, 3) uint8, uint16 or float32
        RGB whose full scale is its type's (255, 65535, 1.0), in `out` or a buffer of the device; the plane itself where
        that is what it holds.

    Raises
    ------
    ShapeError
        A plane has another shape or type than the format specifies, or `out` cannot be written.
    """
    n_planes = {"rgb": (1, 3), "bayer": (1,), "yuv": (3,)}[format.layout]
    if len(planes) not in n_planes:
        raise ShapeError(f"{format.layout} frame has {len(planes)} planes, expected {' or '.join(map(str, n_planes))}")
    if format.layout == "yuv":
        return convert_chroma(planes, format, cast(F32 | None, out))
    if format.layout == "bayer":
        return demosaic(planes[0], format, stripes, cast(F32 | None, out))
    shape = (None, None, len(format.channels)) if len(planes) == 1 else planes[0].shape[:2]
    planes = tuple(checks.read_array("plane", plane, shape, format.dtype) for plane in planes)
    scaled = format.rgb_dtype != format.dtype
    if len(planes) == 1 and format.channels == "rgb" and not scaled:
        return planes[0]
    height, width = planes[0].shape[:2]
    out = checks.out_buffer("out", out, (height, width, 3), format.rgb_dtype)
    scale = 1 / format.white_level
    if len(planes) == 1:
        _reorder_channels_kernel(format.channels, scaled)(planes[0], scale, out)
    else:
        ordered = (planes[format.channels.index(color)] for color in "rgb")
        _join_planes_kernel(scaled)(*ordered, scale, out)
    return out
