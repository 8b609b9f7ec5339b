"""A range image for people: in colours with a scale, and shaded as the camera sees it."""

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.decoding.frame_fields import FrameFields
from pipeline.files import write_atomically
from pipeline.output.background import object_pixels
from pipeline.output.mesh import Unit
from pipeline.output.pictures.picture_overlay import ColorScale, color_bar_width, draw_color_bar
from pipeline.output.pictures.viewpoint import CLAY, Viewpoint, lit_colors
from pipeline.output.surface_mesh import fitted_normals

Floats = npt.NDArray[np.float32]
Pixels = npt.NDArray[np.bool_]

#: Grey level of pixels that hold no value.
HIDDEN = 48
# Pixels that are shaded at a time: of a large picture each temporary would be fresh memory.
_BLOCK = 2**15
# Where the camera is as seen from its surfaces, all in the same direction.
_CAMERA = Viewpoint(position=(0.0, 0.0, -1.0), focal_point=(0.0, 0.0, 0.0))
# Slope that a surface in rad is shown with where its steep tenth begins: the usual one may be noise.
_STEEP = 1.2
# Pixels per side that distinguish the object from a wall.
_ASKED_LINES = 500


def depth_colors(
    values: npt.NDArray[np.float32], mask: npt.NDArray[np.bool_], scale: ColorScale
) -> npt.NDArray[np.uint8]:
    """Return a range image in the colours of a scale, (H, W, 3) RGB; dark grey where there is no value."""
    mask = mask & np.isfinite(values)
    return np.where(mask[..., None], scale.colors(np.where(mask, values, scale.low)), np.uint8(HIDDEN))


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
    write_png(path, with_color_bar(image, scale) if mask.any() else image)  # of nothing there is no scale


def with_color_bar(image: npt.NDArray[np.uint8], scale: ColorScale) -> npt.NDArray[np.uint8]:
    """Return an image, (H, W, 3) RGB, with the bar that explains its colours to the right of it, on dark grey."""
    height = max(len(image), 160)  # room for the scale's numbers next to a small image
    gap = round(height / 40)
    width = gap * 3 + color_bar_width(scale, height - 2 * gap)
    canvas = np.full((height, image.shape[1] + width, 3), HIDDEN, np.uint8)
    canvas[: len(image), : image.shape[1]] = image
    draw_color_bar(canvas, scale, (image.shape[1] + gap, gap), height - 2 * gap)
    return canvas


def shade_range(
    values: Floats, mask: Pixels, points: Floats | None = None, sigma: Floats | None = None
) -> npt.NDArray[np.uint8]:
    """Shade the surface fitted to a range image, as seen by the camera, lit from the upper left.

    Parameters
    ----------
    values : (H, W) float32
        Range in mm or rad, larger is farther. Its slopes are scaled until the relief shows.
    mask : (H, W) bool
        Pixels that hold a value; NaN pixels are left out too.
    points : (H, W, 3) float32, optional
        The surface in mm, camera frame: its true normals are used instead.
    sigma : (H, W) float32, optional
        Standard deviation of the range; None: the range image's own scatter.

    Returns
    -------
    (H, W, 3) uint8
        RGB; dark grey where there is no value.
    """
    depth = values if points is None else points[..., 2]
    mask = mask & np.isfinite(depth)
    normals = fitted_normals(depth, mask, points, None if sigma is None else sigma[mask])
    places = np.flatnonzero(np.isfinite(normals[..., 0]))
    shaded = np.full((*mask.shape, 3), HIDDEN, np.uint8)
    shaded.reshape(-1, 3)[places] = shade_normals(normals.reshape(-1, 3)[places], "rad" if points is None else "mm")
    return shaded


def shade_frame(frame: FrameFields) -> npt.NDArray[np.uint8]:
    """Shade a frame, decoded or stored, as `shade_range` does."""
    points = frame.points if "points" in frame.fields else None
    values = frame.range_image if points is None else points[..., 2]
    name = "point_sigma" if frame.calibrated else "phase_sigma"
    sigma = getattr(frame, name) if name in frame.fields else None
    return shade_range(values, frame.mask, points, sigma)


def shade_normals(normals: Floats, unit: Unit) -> npt.NDArray[np.uint8]:
    """Return the RGB of clay, (N, 3), as a camera sees it along z: by normals, (N, 3), of a surface in mm or rad.

    A surface in rad has no true slopes: the steep tenth begins at 50 degrees.
    """
    if unit == "rad" and len(normals):
        slopes = normals[:, :2] / -normals[:, 2:]
        steep = float(np.percentile(np.linalg.norm(slopes, axis=1), 90)) / _STEEP
        normals = np.column_stack([slopes / steep if steep > 0 else slopes, np.full(len(slopes), -1, np.float32)])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    shaded = np.empty(normals.shape, np.uint8)
    for start in range(0, len(normals), _BLOCK):
        part = normals[start : start + _BLOCK]
        shaded[start : start + _BLOCK] = lit_colors(np.zeros_like(part), part, CLAY.astype(np.uint8), _CAMERA)
    return shaded


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
