"""Stores of a plane's frames, written as a run over footage writes them."""

import json
from types import SimpleNamespace

import numpy as np

from pipeline.calibration.lens import Lens
from pipeline.output.store import ResultStore, chosen_fields
from pipeline.output.store_files import _digest
from pipeline.text import one_line

HEIGHT, WIDTH = 60, 80
#: That sees a plane at 400 mm.
LENS = Lens(size_px=(WIDTH, HEIGHT), matrix=np.array([[400, 0, WIDTH / 2], [0, 400, HEIGHT / 2], [0, 0, 1]]))


def plane(distance_mm):
    """Return the points of a plane, 1 mm a pixel, with a hole in its lower right corner."""
    y, x = np.indices((HEIGHT, WIDTH), np.float32)
    points = np.stack([x - WIDTH / 2, y - HEIGHT / 2, np.full_like(x, distance_mm)], axis=-1)
    mask = (y < HEIGHT - 15) | (x < WIDTH - 20)
    points[~mask] = np.nan
    return points, mask


def store(path, distances, missing=(), in_mm=True, step=1, leave_out=(), also=(), lens=None, footage=None):
    """Write a store as a run over footage does; None stands for a frame without any surface."""
    fields = ["mask", "modulation", "phase_sigma", "range_image", *(["points", "point_sigma"] if in_mm else []), *also]
    fields = chosen_fields([name for name in fields if name not in leave_out], in_mm=in_mm)
    identity = {"colorphase_version": "1", "settings": {}, "step": step, "range_unit": "mm" if in_mm else "rad"}
    if footage is not None:
        identity["footage"] = {"name": one_line(footage)}
    if lens is not None:
        identity["camera"] = lens.model_dump(mode="json")
    written = ResultStore.make(path, identity, fields, len(distances), (WIDTH, HEIGHT))
    for number, distance in enumerate(distances):
        if number not in missing:
            frame = _frame(distance, in_mm)
            vars(frame).update(dict.fromkeys(also, frame.modulation))
            written.commit([written.write(number, frame)])
    return path


def reseal(path):
    """Make the checksum of a store's metadata right again, as anybody can; what is no metadata stays as it is."""
    try:
        about = json.loads((path / "zarr.json").read_bytes())
        names = [*about["attributes"]["fields"], "done", *about["attributes"]["coordinates"].split()]
        keys = [f"{name}/zarr.json" for name in names]
        keys += [f"{name}/c.0" for name in about["attributes"]["coordinates"].split()]
        held = {key: (path / key).read_bytes() for key in keys}
        about["attributes"]["metadata_sha256"] = _digest(about, held)
        (path / "zarr.json").write_text(json.dumps(about, indent=2))
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return


def edit(path, change):
    """Change what a JSON file of a store says, and make its checksums right again."""
    about = json.loads(path.read_bytes())
    change(about)
    path.write_text(json.dumps(about))
    reseal(next(folder for folder in path.parents if (folder / "done").exists()))


def _frame(distance, in_mm):
    points, mask = plane(distance or 400.0)
    mask &= distance is not None
    return SimpleNamespace(
        period_px=12.0,
        noise_levels=1.0,
        constant_known=True,
        warnings=(),
        calibrated=in_mm,
        mask=mask,
        measured_px=int(mask.sum()),
        modulation=np.where(mask, np.float32(50), np.float32(0)),
        phase_sigma=np.where(mask, np.float32(0.02), np.float32(np.nan)),
        range_image=points[..., 2] if in_mm else points[..., 2] / 100,
        points=points,
        point_sigma=np.where(mask, np.float32(0.1), np.float32(np.nan)),
    )
