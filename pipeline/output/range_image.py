"""A range image for people: in colours with a scale, and shaded as the camera sees it."""

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.files import write_atomically
from pipeline.output.mesh import Unit
from pipeline.output.pictures.color_scale import ColorScale, color_bar_width, draw_color_bar
from pipeline.output.pictures.lighting import CLAY
from pipeline.output.pictures.object_choice import object_pixels

# Grey level of pixels that hold no value.
_HIDDEN = 48


def depth_colors(
    values: npt.NDArray[np.float32], mask: npt.NDArray[np.bool_], limits: tuple[float, float] | None = None
) -> npt.NDArray[np.uint8]:
    """Colour a range image from blue to red.

    Parameters
    ----------
    values : (H, W) float32
        Range in mm or rad.
    mask : (H, W) bool
        Pixels that hold a value; NaN pixels are left out too.
    limits : (float, float), optional
        What is blue, and what is red; None: the 1st and the 99th percentile.

    Returns
    -------
    (H, W, 3) uint8
        RGB; dark grey where there is no value.
    """
    mask = mask & np.isfinite(values)
    scale = ColorScale.over(values[mask], "", "") if limits is None else ColorScale(*limits, "", "")
    return np.where(mask[..., None], scale.colors(np.where(mask, values, scale.low)), np.uint8(_HIDDEN))


def write_range_image(
    path: str | Path, values: npt.NDArray[np.float32], mask: npt.NDArray[np.bool_], unit: Unit
) -> None:
    """Write a range image as a coloured PNG with a scale beside it; its limits are those of the object, not of a wall.

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
    chosen = object_pixels(values, mask) if unit == "mm" else mask
    name, told = ("depth", "mm") if unit == "mm" else ("", "rad, not mm")
    scale = ColorScale.over(values[chosen], name, told, grey_beyond=not np.array_equal(chosen, mask))
    image = np.where(mask[..., None], scale.colors(np.where(mask, values, scale.low)), np.uint8(_HIDDEN))
    height = max(len(image), 160)  # room for the scale's numbers beside a small image
    gap = round(height / 40)
    width = gap * 3 + color_bar_width(scale, height - 2 * gap)
    canvas = np.full((height, image.shape[1] + width, 3), _HIDDEN, np.uint8)
    canvas[: len(image), : image.shape[1]] = image
    if mask.any():  # else there is nothing to tell
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
    mask = mask & np.isfinite(values) & np.isfinite(surface).all(axis=-1)
    surface = np.where(mask[..., None], surface, 0)
    along_x = _slope(surface, mask)
    along_y = _slope(surface.swapaxes(0, 1), mask.T).swapaxes(0, 1)
    if points is None:
        slopes = np.concatenate([along_x, along_y], axis=-1)
        # The steep tenth starts at 50 degrees; the typical slope may be a flat wall's noise.
        steep = np.percentile(np.linalg.norm(slopes[mask], axis=-1), 90) if mask.any() else 0
        slopes *= 1.2 / steep if steep > 0 else 1
        normals = np.concatenate([slopes, np.full_like(values, -1)[..., None]], axis=-1)
    else:
        normals = np.cross(along_y, along_x)
        normals[~normals.any(axis=-1)] = (0, 0, -1)
    light = np.array([-1, -1, -2], np.float32)  # from the surface to the lamp
    cosines = normals @ light / (np.linalg.norm(normals, axis=-1) * np.linalg.norm(light))
    shaded = (0.15 + 0.85 * cosines.clip(0, 1))[..., None] * CLAY
    return np.where(mask[..., None], shaded, _HIDDEN).astype(np.uint8)


def write_png(path: str | Path, image: npt.NDArray[np.uint8]) -> None:
    """Write an RGB image, (H, W, 3) uint8, as a PNG file under any name.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    write_atomically(path, encode_png(image))


def encode_png(image: npt.NDArray[np.uint8]) -> bytes:
    """Return an RGB image, (H, W, 3) uint8, as a PNG file."""
    return bytes(cv2.imencode(".png", image[..., ::-1])[1].tobytes())


def _slope(surface: npt.NDArray[np.float32], mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.float32]:
    """Return the slope a pixel from left to right, (H, W, C); 0 where neither side has one."""
    steps = np.diff(surface, axis=1)
    reach = np.abs(steps[..., -1])
    whole = mask[:, 1:] & mask[:, :-1]
    if whole.any():
        # A depth step stands far out of the slopes of surfaces, and is rare.
        whole = whole & (reach <= 4 * np.percentile(reach[whole], 95))
    steps[~whole] = 0
    sums, counts = np.zeros_like(surface), np.zeros(mask.shape, np.float32)
    for side in (np.s_[:, 1:], np.s_[:, :-1]):
        sums[side] += steps
        counts[side] += whole
    sums /= np.maximum(counts, 1)[..., None]
    return sums
