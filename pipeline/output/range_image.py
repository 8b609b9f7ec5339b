"""A range image for people: in colours with a scale, and shaded as the camera sees it."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.files import write_atomically
from pipeline.output.background import object_pixels
from pipeline.output.mesh import Unit
from pipeline.output.pictures.picture_overlay import ColorScale, color_bar_width, draw_color_bar
from pipeline.output.pictures.viewpoint import CLAY

# Grey level of pixels that hold no value.
_HIDDEN = 48
# Rows that are shaded at a time: of a large picture each temporary would be fresh memory.
_ROWS = 64
# From the surface to the lamp.
_TO_LAMP = (np.array([-1, -1, -2]) / np.sqrt(6)).astype(np.float32)
# Lines of pixels that distinguish steps from slopes, and pixels per side that distinguish the object from a wall.
_ASKED_LINES = 500


def depth_colors(
    values: npt.NDArray[np.float32], mask: npt.NDArray[np.bool_], scale: ColorScale
) -> npt.NDArray[np.uint8]:
    """Return a range image in the colours of a scale, (H, W, 3) RGB; dark grey where there is no value."""
    mask = mask & np.isfinite(values)
    return np.where(mask[..., None], scale.colors(np.where(mask, values, scale.low)), np.uint8(_HIDDEN))


def write_range_image(
    path: str | Path, values: npt.NDArray[np.float32], mask: npt.NDArray[np.bool_], unit: Unit
) -> None:
    """Write a range image as a coloured PNG with a scale next to it; its limits are those of the object, not of a wall.

    Parameters
    ----------
    path : str or Path
        The PNG file.
    values : (H, W) float32
        Range in ``unit``.
    mask : (H, W) bool
        Pixels that hold a value; NaN pixels are left out too.
    unit : {"mm", "rad"}
        Printed over the scale; of rad, that they are no mm.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    mask = mask & np.isfinite(values)
    every = max(1, min(mask.shape) // _ASKED_LINES)
    some, seen = values[::every, ::every], mask[::every, ::every]
    chosen = object_pixels(some, seen) if unit == "mm" else seen
    name, told = ("depth", "mm") if unit == "mm" else ("", "rad, not mm")
    scale = ColorScale.over(some[chosen], name, told, grey_beyond=not np.array_equal(chosen, seen))
    image = depth_colors(values, mask, scale)
    height = max(len(image), 160)  # room for the scale's numbers next to a small image
    gap = round(height / 40)
    width = gap * 3 + color_bar_width(scale, height - 2 * gap)
    canvas = np.full((height, image.shape[1] + width, 3), _HIDDEN, np.uint8)
    canvas[: len(image), : image.shape[1]] = image
    if mask.any():  # else there is nothing to show
        draw_color_bar(canvas, scale, (image.shape[1] + gap, gap), height - 2 * gap)
    write_png(path, canvas)


def shade_range(
    values: npt.NDArray[np.float32], mask: npt.NDArray[np.bool_], points: npt.NDArray[np.float32] | None = None
) -> npt.NDArray[np.uint8]:
    """Shade a range image as seen by the camera, lit from the upper left.

    Parameters
    ----------
    values : (H, W) float32
        Range in mm or rad, larger is farther. Its slopes are scaled until the relief shows.
    mask : (H, W) bool
        Pixels that hold a value; NaN pixels are left out too.
    points : (H, W, 3) float32, optional
        The surface in mm, camera frame: its true normals are used instead.

    Returns
    -------
    (H, W, 3) uint8
        RGB; dark grey where there is no value.

    Notes
    -----
    Slopes come from the neighbours on both sides; one that is masked or beyond a depth step does not count.
    """
    surface = values[..., None] if points is None else points
    most = [_largest_slope(surface, mask, axis) for axis in range(2)]
    steep = _steep_slope(values, mask, most) if points is None else 1.0
    shaded = np.empty((*mask.shape, 3), np.uint8)
    for rows in _blocks(len(mask)):
        along_x, along_y, known = _slopes(surface, mask, rows, most)
        if points is None:
            x, y, z = along_x[0], along_y[0], np.full_like(along_x[0], -steep)
        else:
            (ax, ay, az), (bx, by, bz) = along_y, along_x
            x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        length = np.sqrt(x * x + y * y + z * z)
        flat = length == 0  # or without neighbours
        z[flat] = length[flat] = -1
        cosines = (x * _TO_LAMP[0] + y * _TO_LAMP[1] + z * _TO_LAMP[2]) / np.abs(length)
        lit = np.float32(0.15) + np.float32(0.85) * cosines.clip(0, 1)
        for channel, full in enumerate(CLAY):
            shaded[rows, :, channel] = np.where(known, lit * full, np.float32(_HIDDEN))
    return shaded


def _blocks(height: int) -> list[slice]:
    return [slice(first, min(first + _ROWS, height)) for first in range(0, height, _ROWS)]


def _steep_slope(values: npt.NDArray[np.float32], mask: npt.NDArray[np.bool_], most: list[float]) -> float:
    """Return the slope that is shown as 50 degrees: where the steep tenth starts, as the usual one may be noise."""
    found = []
    for rows in _blocks(len(mask)):
        along_x, along_y, known = _slopes(values[..., None], mask, rows, most)
        found.append(np.hypot(along_x[0], along_y[0])[known])
    sizes = np.concatenate(found) if found else np.empty(0, np.float32)
    steep = float(np.percentile(sizes, 90)) / 1.2 if len(sizes) else 0.0
    return steep if steep > 0 else 1.0


def _largest_slope(surface: npt.NDArray[np.float32], mask: npt.NDArray[np.bool_], axis: int) -> float:
    """Return the largest change of depth from one pixel to the next that is a slope, and no step."""
    every = max(1, mask.shape[1 - axis] // _ASKED_LINES)
    depth, known = np.moveaxis(surface[..., -1], axis, 1)[::every], np.moveaxis(mask, axis, 1)[::every]
    with np.errstate(invalid="ignore"):  # of pixels without a value
        reach = np.abs(np.diff(depth, axis=1))[known[:, 1:] & known[:, :-1]]
    reach = reach[np.isfinite(reach)]
    # A depth step stands far out of the slopes of surfaces, and is rare.
    return 4 * float(np.percentile(reach, 95)) if len(reach) else 0.0


def _slopes(
    surface: npt.NDArray[np.float32], mask: npt.NDArray[np.bool_], rows: slice, most: list[float]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    """Return the slopes per pixel to the right and down in some rows, (C, H, W) each, and where there is a value."""
    top, bottom = max(rows.start - 1, 0), min(rows.stop + 1, len(mask))
    inner = slice(rows.start - top, rows.stop - top)
    # Each coordinate by itself: arithmetic on them is several times as fast.
    planes = np.moveaxis(surface[top:bottom], -1, 0).copy()
    known = mask[top:bottom] & np.isfinite(planes[-1])
    for plane in planes[:-1]:
        known &= np.isfinite(plane)
    planes[:, ~known] = 0
    along_x = _slope(planes[:, inner], known[inner], most[1], np.s_[..., 1:], np.s_[..., :-1])
    along_y = _slope(planes, known, most[0], np.s_[..., 1:, :], np.s_[..., :-1, :])
    return along_x, along_y[:, inner], known[inner]


def write_png(path: str | Path, image: npt.NDArray[np.uint8]) -> None:
    """Write an RGB image, (H, W, 3) uint8, or one with opacity, (H, W, 4), as a PNG file under any name.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    write_atomically(path, encode_png(image))


def encode_png(image: npt.NDArray[np.uint8]) -> bytes:
    """Return an RGB image, (H, W, 3) uint8, or one with opacity, (H, W, 4), as a PNG file."""
    return bytes(cv2.imencode(".png", image[..., [2, 1, 0, 3][: image.shape[-1]]])[1].tobytes())


def _slope(
    planes: npt.NDArray[np.float32], mask: npt.NDArray[np.bool_], most: float, after: Any, before: Any
) -> npt.NDArray[np.float32]:
    """Return the slope per pixel from what is before to what is after it, (C, H, W); 0 where neither side has one."""
    steps = planes[after] - planes[before]
    whole = mask[after] & mask[before] & (np.abs(steps[-1]) <= most)
    steps *= whole
    sums, counts = np.zeros_like(planes), np.zeros(mask.shape, np.float32)
    for side in (after, before):
        sums[side] += steps
        counts[side] += whole
    sums /= np.maximum(counts, 1)
    return sums
