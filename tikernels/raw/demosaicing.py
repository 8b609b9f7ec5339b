"""Turn a Bayer mosaic into RGB by what is known of the image: it changes across the stripes, hardly along them.

Every row of a mosaic holds green and one of red and blue, a pixel each in turn. Along the stripes the two are
interpolated on a straight line. The third colour is only in the rows above and below: there Lagrange's polynomial goes
through eight of them, because the mean of two takes 13 % of the modulation at 12 px per cycle from every second row.
Methods for photographs assume that colours change together (Malvar, He and Cutler, 2004); here they are 120 degrees
apart. `docs/footage.md` compares.
"""

from functools import cache
from typing import Any

import numpy as np

from tikernels import checks
from tikernels._taichi import AnyArray2, F32Array3, Static, f32, i32, ti
from tikernels.arrays import F32, Plane
from tikernels.errors import ShapeError
from tikernels.launching import kernel
from tikernels.raw.pixel_format import PixelFormat

# Lagrange's weights of the rows at distances 1, 3, 5 and 7, on either side.
_ACROSS = (1225 / 2048, -245 / 2048, 49 / 2048, -5 / 2048)
# So that what lies beyond an edge is reflected once.
_MIN_SIZE_PX = 8


@ti.func
def mirrored(place: i32, length: i32) -> i32:
    """Reflect at the first and last pixel, which keeps a mosaic's colours in step."""
    folded = ti.abs(place)
    return ti.min(folded, 2 * (length - 1) - folded)


@cache
def _demosaic_kernel(stripes: str, red_row: int, red_column: int) -> Any:
    vertical = stripes == "vertical"
    red_across, red_along = (red_column, red_row) if vertical else (red_row, red_column)

    @ti.func
    def level(mosaic: Static, across: i32, along: i32) -> f32:
        if ti.static(vertical):
            return ti.cast(mosaic[along, across], ti.f32)
        else:
            return ti.cast(mosaic[across, along], ti.f32)

    @ti.func
    def beside(mosaic: Static, across: i32, along: i32, n_along: i32) -> f32:
        """Return the mean of both neighbours along the stripes."""
        before, after = mirrored(along - 1, n_along), mirrored(along + 1, n_along)
        return 0.5 * (level(mosaic, across, before) + level(mosaic, across, after))

    @ti.func
    def other_color(mosaic: Static, across: i32, along: i32, is_green: Static) -> f32:
        """Return the colour that only the rows above and below have: they are at odd distances."""
        n_across, n_along = mosaic.shape[1 if vertical else 0], mosaic.shape[0 if vertical else 1]
        far = 0.0
        for k in ti.static(range(len(_ACROSS))):
            for side in ti.static((-1, 1)):
                other = mirrored(across + side * (2 * k + 1), n_across)
                if ti.static(is_green):
                    far += _ACROSS[k] * level(mosaic, other, along)
                else:
                    far += _ACROSS[k] * beside(mosaic, other, along, n_along)
        return far

    @kernel
    def demosaic_kernel(
        mosaic: AnyArray2,  # (H, W) levels
        scale: f32,  # 1 / white level
        out: F32Array3,  # (H, W, 3) encoded RGB, 0..1
    ):
        n_across = ti.static(1 if vertical else 0)
        n_along = mosaic.shape[1 - n_across]
        quads = (n_along + 1) // 2
        for quad in range(((mosaic.shape[n_across] + 1) // 2) * quads):
            for i, j in ti.static(ti.ndrange(2, 2)):
                across, along = quad // quads * 2 + i, quad % quads * 2 + j
                if across < mosaic.shape[n_across] and along < n_along:
                    own, near = level(mosaic, across, along), beside(mosaic, across, along, n_along)
                    # Where this row has red or blue, the others have green, and the reverse.
                    is_green = ti.static((i + j) % 2 != (red_across + red_along) % 2)
                    far = other_color(mosaic, across, along, is_green)
                    y, x = across, along
                    if ti.static(vertical):
                        y, x = along, across
                    here, there = ti.static((0, 2) if i == red_across else (2, 0))
                    out[y, x, here] = scale * (near if ti.static(is_green) else own)
                    out[y, x, 1] = scale * (own if ti.static(is_green) else near)
                    out[y, x, there] = ti.min(ti.max(scale * far, 0.0), 1.0)

    return demosaic_kernel


def demosaic(mosaic: Plane, format: PixelFormat, stripes: str = "horizontal", out: F32 | None = None) -> F32:
    """Turn a Bayer mosaic into RGB.

    Parameters
    ----------
    mosaic : (H, W) uint8 or uint16
        Levels, as stored.
    format : PixelFormat
        Storage format; its layout is "bayer".
    stripes : {"horizontal", "vertical"}
        Direction of the fringe.
    out : (H, W, 3) float32, optional
        Output array.

    Returns
    -------
    (H, W, 3) float32
        Encoded RGB in 0..1, in a buffer of the device if none is given.

    Raises
    ------
    ShapeError
        The mosaic has another shape or type than the format specifies or fewer than 8x8 pixels, the stripes run
        otherwise, or `out` cannot be written.

    References
    ----------
    Malvar, He and Cutler, High-quality linear interpolation for demosaicing of Bayer-patterned color images, 2004,
    https://doi.org/10.1109/ICASSP.2004.1326587

    Examples
    --------
    >>> import numpy as np, tikernels
    >>> from tikernels.raw.pixel_format import PixelFormat
    >>> _ = tikernels.init("cpu")
    >>> mosaic = np.tile(np.array([[204, 102], [102, 51]], np.uint8), (4, 4))  # orange, as a RGGB camera sees it
    >>> [round(float(value), 3) for value in demosaic(mosaic, PixelFormat("bayer"))[3, 3]]
    [0.8, 0.4, 0.2]
    """
    if stripes not in ("horizontal", "vertical"):
        raise ShapeError(f"stripes is {stripes!r}: choose horizontal or vertical")
    mosaic = checks.read_array("mosaic", mosaic, (None, None), format.dtype)
    height, width = mosaic.shape
    if min(height, width) < _MIN_SIZE_PX:
        raise ShapeError(f"mosaic is {width}x{height}: at least {_MIN_SIZE_PX}x{_MIN_SIZE_PX} px are needed")
    out = checks.out_buffer("out", out, (height, width, 3), np.float32)
    red = format.bayer.index("r")
    _demosaic_kernel(stripes, red // 2, red % 2)(mosaic, 1 / format.white_level, out)
    return out
