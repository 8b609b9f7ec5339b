"""``result.zarr``: every field of every frame, in a form that other programs read (Zarr v3)."""

import json
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.calibration import Calibration
from pipeline.results import DecodedFrame
from pipeline.settings import DecodeSettings

#: Fields of a frame that are stored, in the order of the contract; absent ones are left out.
FIELDS = (
    "wrapped_phase",
    "unwrapped_phase",
    "fringe_order",
    "mask",
    "modulation",
    "region",
    "absolute",
    "order_error_probability",
    "phase_sigma",
    "constant_sigma",
    "points",
    "point_sigma",
    "range_image",
)


def result_attributes(settings: DecodeSettings, calibration: Calibration | None) -> dict[str, Any]:
    """Return what a result says about how it was made: settings, calibration's hash, version."""
    return {
        "colorphase_version": version("colorphase"),
        "settings": json.loads(settings.model_dump_json()),
        "calibration_sha256": None if calibration is None else calibration.digest(),
    }


def write_store(path: Path, frame: DecodedFrame, settings: DecodeSettings, calibration: Calibration | None) -> None:
    """Write one frame as a new store.

    Parameters
    ----------
    path : Path
        The folder to make; it must not exist.
    frame : DecodedFrame
        What to store: each field becomes an array whose first axis is the frame, one chunk a frame.
    settings, calibration
        How it was decoded; kept as attributes.

    Raises
    ------
    OSError
        The place cannot be written.
    """
    import zarr  # slow to import, and only needed here
    from zarr.codecs import BloscCodec

    # LZ4 with bit shuffling takes a third of the default's time and gives files as small.
    compressor = BloscCodec(cname="lz4", clevel=5, shuffle="bitshuffle")
    group = zarr.open_group(path, mode="w-", attributes=result_attributes(settings, calibration))
    for name in FIELDS:
        if getattr(frame, name) is None:
            continue
        values = np.asarray(getattr(frame, name))
        array = group.create_array(
            name,
            shape=(1, *values.shape),
            chunks=(1, *values.shape),
            dtype=values.dtype,
            fill_value=np.nan if values.dtype.kind == "f" else 0,
            compressors=compressor,
        )
        array[0] = values
