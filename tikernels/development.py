"""Develop a frame: from the form in which it was stored to RGB."""

from typing import Any

import numpy.typing as npt

from tikernels.pixel_format import PixelFormat


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
        Which way the fringe runs: missing colours are taken from along it.
    out : (H, W, 3) float32, optional
        Where the result goes, unless it needs no computing.

    Returns
    -------
    (H, W, 3) uint8, uint16 or float32
        RGB whose full scale is its type's (255, 65535, 1.0): the plane itself where that is what it holds, else
        float32 in a buffer of the device.

    Raises
    ------
    ShapeError
        A plane has another shape or type than the format says, or `out` cannot be written.
    """
    raise NotImplementedError
