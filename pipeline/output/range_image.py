"""A range image for people: in colours with a scale, and shaded as the camera sees it."""

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.files import write_atomically
from pipeline.output.mesh import Unit

# Grey level of pixels that hold no value.
_HIDDEN = 48
#: RGB of a fully lit surface that has no colour of its own.
CLAY = np.array([236, 228, 216], np.float32)


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
    low, high = _limits(values, mask) if limits is None else limits
    fractions = np.where(mask, (values - low) / (high - low), 0).clip(0, 1)
    return np.where(mask[..., None], _colormap(fractions), np.uint8(_HIDDEN))


def write_range_image(
    path: str | Path, values: npt.NDArray[np.float32], mask: npt.NDArray[np.bool_], unit: Unit
) -> None:
    """Write a range image as a coloured PNG with a scale beside it.

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
    image = depth_colors(values, mask)
    mask = mask & np.isfinite(values)
    height = max(len(image), 160)  # room for the scale's numbers beside a small image
    canvas = np.full((height, image.shape[1], 3), _HIDDEN, np.uint8)
    canvas[: len(image)] = image
    limits = _limits(values, mask) if mask.any() else None
    write_png(path, np.hstack([canvas, _scale_bar(height, limits, unit)]))


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
    write_atomically(path, cv2.imencode(".png", image[..., ::-1])[1].tobytes())


def _limits(values: npt.NDArray[np.float32], mask: npt.NDArray[np.bool_]) -> tuple[float, float]:
    """Return the 1st and the 99th percentile, never equal."""
    low, high = np.percentile(values[mask], (1, 99)).tolist() if mask.any() else (0.0, 1.0)
    return low, max(high, low + 1e-6 * max(abs(low), 1.0))


def _colormap(fractions: npt.NDArray[np.floating]) -> npt.NDArray[np.uint8]:
    levels = (20 + 215 * fractions).round().astype(np.uint8)  # the map's ends are too dark to tell apart
    colors: npt.NDArray[np.uint8] = cv2.applyColorMap(levels, cv2.COLORMAP_TURBO)[..., ::-1]
    return colors


def _scale_bar(height: int, limits: tuple[float, float] | None, unit: Unit) -> npt.NDArray[np.uint8]:
    """Draw a colour scale with round numbers, (height, W, 3); without limits there is nothing to tell."""
    size = max(height / 480, 0.75)
    gap, width = round(14 * size), round(110 * size)
    bar = np.full((height, width, 3), _HIDDEN, np.uint8)
    if limits is None:
        return bar
    low, high = limits
    top, bottom = 3 * gap, height - gap
    bar[top:bottom, gap : 2 * gap] = _colormap(np.linspace(1, 0, bottom - top)[:, None])

    def write(text: str, x: int, y: int) -> None:
        cv2.putText(bar, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.45 * size, (235, 235, 235), 1, cv2.LINE_AA)

    write(unit if unit == "mm" else "rad, not mm", gap if unit == "mm" else gap // 3, 2 * gap)
    step = _round_step((high - low) / 6)
    decimals = max(0, -int(np.floor(np.log10(step))))
    for value in np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step:
        y = round(bottom - 1 - (value - low) / (high - low) * (bottom - 1 - top))
        bar[y, 2 * gap : 2 * gap + gap // 3] = 235
        write(f"{value + 0.0:.{decimals}f}", 2 * gap + gap // 2, y + round(5 * size))
    return bar


def _round_step(step: float) -> float:
    """Return the least of 1, 2 and 5 times a power of ten that is at least ``step``."""
    power: float = 10.0 ** np.floor(np.log10(step))
    return next(factor * power for factor in (1, 2, 5, 10) if factor * power >= step)


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
