"""Binary messages for the page: a JSON header, followed by arrays."""

import json
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.decoding.frame import FIELDS
from pipeline.decoding.frame_fields import FrameFields
from pipeline.errors import SettingsError

Array = npt.NDArray[Any]

# Maps of the page, and the fields that they show: the first one that exists.
_MAPS = {
    "depth": ("range_image", "points"),
    "sigma": ("point_sigma", "phase_sigma"),
    "texture": ("texture",),
    "order": ("fringe_order",),
    "mask": ("mask",),
    "absolute": ("absolute",),
    "doubt": ("order_error_probability",),
    "modulation": ("modulation",),
    "region": ("region",),
    "phase": ("wrapped_phase",),
}
# Alignment of the arrays, bytes.
_ALIGNMENT = 8


def maps_of(stored: Iterable[str], *, in_mm: bool) -> dict[str, str]:
    """Return the field behind each map, for a frame with these fields."""
    there = {name for name in stored if in_mm or not FIELDS[name].in_mm}
    found = {name: next((field for field in fields if field in there), None) for name, fields in _MAPS.items()}
    return {name: field for name, field in found.items() if field is not None}


def describe_maps(stored: Iterable[str], *, in_mm: bool) -> dict[str, dict[str, str]]:
    """Return unit and kind (color or number) of each map."""
    unit = "mm" if in_mm else "rad"
    described = {}
    for name, source in maps_of(stored, in_mm=in_mm).items():
        entry = FIELDS[source]
        kind = "color" if entry.axes[2:] == ("rgb",) else "number"
        shown = unit if entry.unit == "range" or name == "depth" else entry.unit
        described[name] = {"unit": "" if shown in (None, "1") else str(shown), "kind": kind}
    return described


@dataclass(frozen=True)
class ViewedFrame:
    """A frame for the page.

    Attributes
    ----------
    arrays : mapping of str to array
        By name: maps (H, W) or (H, W, 3), ``points`` (H, W, 3), ``picture`` (H, W, 3) uint8; of a mesh ``points``
        (N, 3), ``faces`` (M, 3) and one value per vertex.
    number, time_s, dated, warnings
        See `FrameFields`.
    more : mapping
        Further entries of the header.
    """

    arrays: Mapping[str, Array]
    number: int | None = None
    time_s: float | None = None
    dated: bool = False
    warnings: tuple[str, ...] = ()
    more: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, frame: FrameFields, names: Iterable[str], picture: Array | None = None) -> "ViewedFrame":
        """Return a decoded or stored frame with those of the named maps that it has.

        Raises
        ------
        FootageError
            A field is damaged.
        """
        fields = maps_of(frame.fields, in_mm=frame.calibrated) | {"points": "points"}
        if "points" not in frame.fields or not frame.calibrated:
            del fields["points"]
        elif fields["depth"] == "points" or "points" in names:
            fields.pop("depth")  # the page takes depth from the points
        arrays = {name: getattr(frame, fields[name]) for name in dict.fromkeys(names) if name in fields}
        if picture is not None and "picture" in names:
            arrays["picture"] = picture
        return cls(arrays, frame.number, frame.time_s, frame.dated, frame.warnings)

    def pack(self, step: int = 1) -> bytes:
        """Return the message: the length of a JSON text in four bytes, that text, and the arrays, offsets from its end.

        Parameters
        ----------
        step : int
            Keep every `step`-th pixel along rows and columns; a mesh is kept whole.

        Raises
        ------
        SettingsError
            The step is below 1.
        """
        if step < 1:
            raise SettingsError(f"step is {step}: give 1 or more")
        grid = "faces" not in self.arrays
        kept = {name: _plain(values[::step, ::step] if grid else values) for name, values in self.arrays.items()}
        places: dict[str, Any] = {}
        end = 0
        for name, values in kept.items():
            places[name] = {"type": values.dtype.str[1:], "shape": values.shape, "offset": end}
            end += -(-values.nbytes // _ALIGNMENT) * _ALIGNMENT
        height, width = next(iter(kept.values())).shape[:2] if grid and kept else (0, 0)
        head: dict[str, Any] = {
            "number": self.number,
            "time_s": self.time_s,
            "dated": self.dated,
            "warnings": self.warnings,
        }
        head |= {"width": width, "height": height, "step": step, **self.more, "arrays": places}
        text = json.dumps(head, allow_nan=False).encode()
        text = text.ljust(-(-(4 + len(text)) // _ALIGNMENT) * _ALIGNMENT - 4)
        message = bytearray(4 + len(text) + end)
        struct.pack_into("<I", message, 0, len(text))
        message[4 : 4 + len(text)] = text
        for name, values in kept.items():
            start = 4 + len(text) + places[name]["offset"]
            np.frombuffer(message, values.dtype, values.size, start)[:] = values.ravel()
        return bytes(message)


def _plain(values: Array) -> Array:
    """Return values in a type that the page reads."""
    kinds = {"f": "<f4", "i": "<i4", "b": "u1"}
    kind = "u1" if values.dtype.itemsize == 1 else "<u4"
    return values.astype(kinds.get(values.dtype.kind, kind), copy=False)
