"""Stores of a plane's frames, written as a run over footage writes them."""

import numpy as np
import pytest
import zarr

pytestmark = pytest.mark.usefixtures("cpu")


HEIGHT, WIDTH = 60, 80


def plane(distance_mm):
    """Return the points of a plane, 1 mm a pixel, with a hole in its lower right corner."""
    y, x = np.indices((HEIGHT, WIDTH), np.float32)
    points = np.stack([x - WIDTH / 2, y - HEIGHT / 2, np.full_like(x, distance_mm)], axis=-1)
    mask = (y < HEIGHT - 15) | (x < WIDTH - 20)
    points[~mask] = np.nan
    return points, mask


def store(path, distances, missing=(), in_mm=True, step=1, leave_out=()):
    """Write a store as a run over footage does; None stands for a frame without any surface."""
    n_frames = len(distances)
    group = zarr.open_group(
        path, mode="w", attributes={"settings": {}, "step": step, "range_unit": "mm" if in_mm else "rad"}
    )
    arrays = {}

    def put(name, number, values):
        if name in leave_out:
            return
        if name not in arrays:
            fill = np.nan if values.dtype.kind == "f" else 0
            arrays[name] = group.create_array(
                name, shape=(n_frames, *values.shape), chunks=(1, *values.shape), dtype=values.dtype, fill_value=fill
            )
        arrays[name][number] = values

    done = group.create_array(
        "done",
        shape=(n_frames, 1024),
        chunks=(1, 1024),
        dtype="u1",
        fill_value=0x20,
        compressors=None,
        chunk_key_encoding={"name": "default", "separator": "."},
    )
    for number, distance in enumerate(distances):
        if number in missing:
            continue
        points, mask = plane(distance or 400.0)
        mask &= distance is not None
        put("mask", number, mask)
        put("modulation", number, np.where(mask, np.float32(50), np.float32(0)))
        put("phase_sigma", number, np.where(mask, np.float32(0.02), np.float32(np.nan)))
        put("range_image", number, points[..., 2] if in_mm else points[..., 2] / 100)
        if in_mm:
            put("points", number, points)
            put("point_sigma", number, np.where(mask, np.float32(0.1), np.float32(np.nan)))
        done[number] = np.frombuffer(b"{}".ljust(1024), np.uint8)
    return path
