"""Undo the camera's transfer: crosstalk and the arctangent hold in linear light only.

sRGB footage left as it is puts 0.15 rad into the third harmonic of the phase. Inverses of IEC 61966-2-1 (sRGB) and of
Rec. ITU-R BT.709-6.
"""

from functools import cache
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from tikernels import checks, runtime
from tikernels._taichi import AnyArray3, F32Array1, F32Array3, f32, ti
from tikernels.arrays import F32, LevelsImage
from tikernels.errors import ShapeError
from tikernels.launching import kernel

Float = TypeVar("Float", np.float32, np.float64)

TRANSFERS = ("linear", "srgb", "bt709")

#: A name, or the linear light of evenly spaced levels from 0 to full scale.
Transfer = str | npt.NDArray[np.floating]

#: Element types in which frames come, and the full scale of each.
LEVEL_TYPES = (np.uint8, np.uint16, np.float32)
WHITE_LEVELS = {"uint8": 255.0, "uint16": 65535.0, "float32": 1.0}


@cache
def linear_light(transfer: str) -> Any:
    """Return the `ti.func` from an encoded value in 0..1 to linear light in 0..1."""
    if transfer == "srgb":

        @ti.func
        def to_linear(value: f32) -> f32:
            return ti.select(value <= 0.04045, value / 12.92, ti.pow((value + 0.055) / 1.055, 2.4))

    elif transfer == "bt709":

        @ti.func
        def to_linear(value: f32) -> f32:
            return ti.select(value < 0.081, value / 4.5, ti.pow((value + 0.099) / 1.099, 1 / 0.45))

    else:

        @ti.func
        def to_linear(value: f32) -> f32:
            return value

    return to_linear


@cache
def _linearize_kernel(transfer: str) -> Any:
    to_linear = linear_light(transfer)

    @kernel
    def linearize_kernel(
        image: AnyArray3,  # (H, W, 3) encoded, 0..white_level
        scale: f32,  # 1 / white_level
        full_scale: f32,  # light of the white level
        out: F32Array3,  # (H, W, 3) linear light
    ):
        for y, x in ti.ndrange(image.shape[0], image.shape[1]):
            for i in ti.static(range(3)):
                value = ti.cast(image[y, x, i], ti.f32) * scale
                # A GPU's pow turns NaN into a number.
                out[y, x, i] = ti.select(ti.math.isnan(value), ti.math.nan, full_scale * to_linear(value))

    return linearize_kernel


@kernel
def _linearize_by_table_kernel(
    image: AnyArray3,  # (H, W, 3) encoded, 0..white_level
    scale: f32,  # 1 / white_level
    full_scale: f32,  # light of the white level
    table: F32Array1,  # linear light of evenly spaced levels, 0..1
    out: F32Array3,  # (H, W, 3) linear light
):
    steps = ti.cast(table.shape[0] - 1, ti.f32)
    for y, x in ti.ndrange(image.shape[0], image.shape[1]):
        for i in ti.static(range(3)):
            place = ti.cast(image[y, x, i], ti.f32) * scale * steps
            low = ti.min(ti.max(ti.cast(place, ti.i32), 0), table.shape[0] - 2)
            value = table[low] + (place - low) * (table[low + 1] - table[low])
            out[y, x, i] = ti.select(ti.math.isnan(place), ti.math.nan, full_scale * value)


def linear_values(encoded: npt.ArrayLike, transfer: Transfer) -> npt.NDArray[np.float64]:
    """Turn encoded values in 0..1 into linear light in 0..1; few of them, in NumPy.

    Raises
    ------
    ShapeError
        The transfer is unknown.
    """
    values: npt.NDArray[np.float64] = np.array(encoded, np.float64)
    if not isinstance(transfer, str):
        return np.asarray(np.interp(values, np.linspace(0, 1, len(transfer)), transfer))
    if transfer == "srgb":
        return np.where(values <= 0.04045, values / 12.92, ((np.maximum(values, 0) + 0.055) / 1.055) ** 2.4)
    if transfer == "bt709":
        return np.where(values < 0.081, values / 4.5, ((np.maximum(values, 0) + 0.099) / 1.099) ** (1 / 0.45))
    if transfer != "linear":
        raise ShapeError(f"transfer is {transfer!r}: choose {', '.join(TRANSFERS)}")
    return values


def srgb_values(light: npt.NDArray[Float]) -> npt.NDArray[Float]:
    """Return the encoded values of linear light, both in 0..1, in its type; the inverse of `linear_values`."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def linearize(
    image: LevelsImage,
    transfer: Transfer = "linear",
    white_level: float | None = None,
    full_scale: float = 1.0,
    out: F32 | None = None,
) -> F32:
    """Turn grey levels into linear light.

    Parameters
    ----------
    image : (H, W, 3) uint8, uint16 or float32
        Encoded levels from 0 to the white level.
    transfer : {"linear", "srgb", "bt709"} or (N,) floats
        Encoding of the camera's light; or the linear light of N evenly spaced levels.
    white_level : float, optional
        Full scale; None: the type's (255, 65535, 1.0).
    full_scale : float
        The light that the white level becomes.
    out : (H, W, 3) float32, optional
        Output array.

    Returns
    -------
    (H, W, 3) float32
        Linear light, 0..full scale.

    Raises
    ------
    ShapeError
        Shape, dtype or transfer is another one, or `out` cannot be written.

    Examples
    --------
    >>> import numpy as np, tikernels
    >>> _ = tikernels.init("cpu")
    >>> grey = np.full((1, 1, 3), 188, np.uint8)
    >>> round(float(linearize(grey, "srgb")[0, 0, 0]), 3)
    0.503
    """
    if isinstance(transfer, str) and transfer not in TRANSFERS:
        raise ShapeError(f"transfer is {transfer!r}: choose {', '.join(TRANSFERS)}")
    image = checks.read_array("image", image, (None, None, 3), *LEVEL_TYPES)
    out = checks.out_array("out", out, tuple(image.shape), np.float32)
    scale = 1.0 / (white_level or WHITE_LEVELS[runtime.dtype_name(image)])
    if isinstance(transfer, str):
        _linearize_kernel(transfer)(image, scale, full_scale, out)
    else:
        _linearize_by_table_kernel(image, scale, full_scale, np.ascontiguousarray(transfer, np.float32), out)
    return out
