"""Metadata of a frame's arrays: one table for the store and for xarray.

Names and units are those of the CF (Climate and Forecast) conventions 1.11: https://cfconventions.org.
"""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from pipeline.calibration import Calibration
from pipeline.decoding.fields import Field
from pipeline.errors import OutputError
from pipeline.settings import DecodeSettings

if TYPE_CHECKING:
    from xarray import Dataset

#: The coordinates that there may be; each is an array of one axis.
COORDINATES = ("frame", "time", "y", "x", "xyz", "rgb", "row_time")
#: The names of `dataset_labels`' entries, and of the list of coordinates next to them.
DATASET_LABELS = ("Conventions", "title", "source", "history", "coordinates")

Coordinate = tuple[tuple[str, ...], npt.NDArray[Any], dict[str, Any]]
"""The names of its axes, its values and its attributes, from which xarray makes a variable."""

# UDUNITS knows no grey levels.
_UNITS = {"grey levels": "1"}
# What 0 and 1 mean.
_MEANINGS = {"mask": "not_measured measured", "absolute": "relative_to_its_region absolute"}
_LABELS = {
    "frame": {"long_name": "number of the frame in its footage"},
    "y": {"long_name": "row of the camera's picture", "units": "1", "comment": "px, at the centres of pixels"},
    "x": {"long_name": "column of the camera's picture", "units": "1", "comment": "px, at the centres of pixels"},
    "xyz": {"long_name": "axis of the camera's frame", "comment": "x right, y down, z forward"},
    "rgb": {"long_name": "channel", "comment": "sRGB"},
    "row_time": {
        "long_name": "time that a row's points are of, after the first row's exposure",
        "units": "s",
        "comment": "the middle row's where motion is carried to it; where the frame before does not show motion, as in "
        "the first frame, a row's own: y times row_s of the settings",
    },
}

_SINCE_FIRST = {"long_name": "time since the first frame", "units": "s"}
_EXPOSED = {"long_name": "time at which the frame was exposed", "standard_name": "time"}


def result_attributes(settings: DecodeSettings, calibration: Calibration | None) -> dict[str, Any]:
    """Return a result's provenance: settings, calibration's hash, version; and its range's unit."""
    return {
        "colorphase_version": version("colorphase"),
        "settings": json.loads(settings.model_dump_json()),
        "calibration_sha256": None if calibration is None else calibration.digest(),
        "range_unit": "mm" if calibration is not None and calibration.has_geometry else "rad",
    }


def dataset_labels(made_by: str | None = None) -> dict[str, str]:
    """Return the attributes of a set of fields; `made_by` is the version of colorphase that decoded it, if another.

    Neither times nor hosts nor paths are in it, so that the same footage gives the same bytes.
    """
    program = f"colorphase {made_by or version('colorphase')}"
    return {
        "Conventions": "CF-1.11",
        "title": "range images from single colour frames",
        "source": f"colour frames of three phase-shifted fringes, one in each of R, G and B, decoded by {program}",
        "history": f"decoded by {program}",
    }


def field_labels(name: str, field: Field[Any], range_unit: str) -> dict[str, Any]:
    """Return the attributes of a field's array; `range_unit` is that of ranges, "mm" or "rad"."""
    labels: dict[str, Any] = {"long_name": name.replace("_", " "), "comment": " ".join(field.meaning.split())}
    if field.unit is not None:
        unit = range_unit if field.unit == "range" else field.unit
        labels["units"] = _UNITS.get(unit, unit)
    if name in _MEANINGS:
        labels |= {"flag_values": [0, 1], "flag_meanings": _MEANINGS[name]}
    return labels


def axis_coordinates(
    axes: Iterable[str],
    size_px: tuple[int, int],
    corner_px: tuple[int, int] = (0, 0),
    row_s: float = 0.0,
    *,
    at_once: bool = False,
) -> dict[str, Coordinate]:
    """Return the coordinates along the axes of fields.

    Parameters
    ----------
    axes : iterable of str
        Some of y, x, xyz and rgb.
    size_px, corner_px : (2,) int
        Width and height of a frame, and x and y of its first pixel in the camera's picture, where a part is decoded.
    row_s : float
        Time from one row's exposure to the next one's in a rolling shutter, s; 0: rows have no times.
    at_once : bool
        True if motion is carried to the time of the middle row.
    """
    (width, height), (x, y) = size_px, corner_px
    values: dict[str, npt.NDArray[Any]] = {
        "y": np.arange(y, y + height, dtype=np.int32),
        "x": np.arange(x, x + width, dtype=np.int32),
        "xyz": np.array(["x", "y", "z"], np.object_),
        "rgb": np.array(["R", "G", "B"], np.object_),
    }
    found: dict[str, Coordinate] = {
        name: ((name,), values[name], dict(_LABELS[name])) for name in values if name in set(axes)
    }
    if row_s and "y" in found:
        times = row_s * values["y"]
        found["row_time"] = (("y",), np.full(height, times.mean()) if at_once else times, dict(_LABELS["row_time"]))
    return found


def frame_coordinates(
    n_frames: int, seconds: npt.NDArray[np.float64] | None = None, since: str | None = None
) -> dict[str, Coordinate]:
    """Return the coordinates along the frames of footage: their numbers and, where it is known, their times.

    Parameters
    ----------
    n_frames : int
        Their number.
    seconds : (n_frames,) float64, optional
        The time of each.
    since : str, optional
        The origin of `seconds`, UTC; None: the first frame. Then the unit is ``s``, without a date.
    """
    numbers: Coordinate = (("frame",), np.arange(n_frames, dtype=np.int64), dict(_LABELS["frame"]))
    if seconds is None:
        return {"frame": numbers}
    labels = _SINCE_FIRST
    if since is not None:
        labels = {**_EXPOSED, "units": f"seconds since {since}", "calendar": "standard"}
    return {"frame": numbers, "time": (("frame",), seconds, dict(labels))}


@dataclass(frozen=True)
class FrameLabels:
    """Metadata of a frame in addition to its fields."""

    range_unit: str
    """Of ranges, "mm" or "rad"."""
    warnings: tuple[str, ...] = ()
    """Warnings for the user, which become the ``comment``."""
    number: int | None = None
    """The frame's, in its footage."""
    time_s: float | None = None
    """Time of the frame, s."""
    dated: bool = False
    """True if the time is since 1970, not since the first frame."""

    def coordinates(self) -> dict[str, Any]:
        """Return the frame's number and its time as coordinates along an axis of one frame, where it has a number."""
        if self.number is None:
            return {}
        found: dict[str, Any] = {"frame": (("frame",), [self.number], dict(_LABELS["frame"]))}
        if self.time_s is not None and self.dated:
            found["time"] = (
                ("frame",),
                [np.datetime64(round(1e6 * self.time_s), "us").astype("datetime64[ns]")],
                dict(_EXPOSED),
            )
        elif self.time_s is not None:
            found["time"] = (("frame",), [self.time_s], dict(_SINCE_FIRST))
        return found


def make_dataset(fields: dict[str, tuple[Field[Any], npt.NDArray[Any]]], labels: FrameLabels) -> "Dataset":
    """Return a frame's fields, by their names, with all their metadata, as an `xarray.Dataset`.

    Raises
    ------
    OutputError
        xarray is not installed.
    """
    try:
        import xarray  # slow to import, and of the extra `xarray`
    except ImportError:
        raise OutputError("xarray is not installed: pip install 'colorphase[xarray]'") from None
    unit = labels.range_unit
    of_one = () if labels.number is None else ("frame",)
    arrays = {
        name: ((*of_one, *field.axes), values[None] if of_one else values, field_labels(name, field, unit))
        for name, (field, values) in fields.items()
    }
    axes = {axis for field, _ in fields.values() for axis in field.axes}
    height, width = next((values.shape[:2] for field, values in fields.values() if field.axes), (0, 0))
    known = {**axis_coordinates(axes, (width, height)), **labels.coordinates()}
    about = {**dataset_labels(), "range_unit": unit}
    if comment := "\n".join(labels.warnings):
        about["comment"] = comment
    return xarray.Dataset(arrays, known, about)
