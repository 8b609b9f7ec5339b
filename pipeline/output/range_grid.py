"""A frame's places in mm as the camera's grid has them, for formats that keep the grid."""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from pipeline.calibration.model import Lens
from pipeline.output.mesh import RESERVED

# Fields of records that are no property: places, colours, and what fills gaps between fields.
_NO_PROPERTIES = {*"xyz", "rgb", "rgba", "_", *RESERVED}


@dataclass(frozen=True, eq=False)
class RangeGrid:
    """A frame's places in mm, pixel by pixel."""

    points: npt.NDArray[np.float32]
    """(H, W, 3), mm, camera frame; NaN where nothing was measured."""
    texture: npt.NDArray[np.uint8] | None = None
    """(H, W, 3), sRGB."""
    properties: dict[str, npt.NDArray[np.float32]] = field(default_factory=dict)
    """More about each pixel, (H, W), by the names that meshes' vertices have."""
    camera: Lens | None = None
    """None: a store of a version that did not keep it."""
    time_s: float = 0.0
    """Since the first frame, or since 1970 where the footage says when it was taken."""
    provenance: dict[str, str] = field(default_factory=dict)
    """How it was made."""

    @classmethod
    def of_records(cls, records: npt.NDArray[np.void]) -> "RangeGrid":
        """Return the grid that robots' programs hold as (H, W) records, of numbers of any kind; see `records`.

        A place that is not finite, or not in front of the camera, is none.

        Raises
        ------
        ValueError
            It has no rows and columns, or its points no x, y and z.
        """
        height, width = records.shape
        if min(width, height) < 2:
            raise ValueError(f"its {width} times {height} points are no grid: an organised cloud has rows and columns")
        names = records.dtype.names or ()
        if not {*"xyz"} <= {*names}:
            raise ValueError("its points have no x, y and z")
        with np.errstate(over="ignore"):
            points = np.stack([records[axis].astype(np.float32) for axis in "xyz"], axis=-1) * np.float32(1000)
        points[~(np.isfinite(points).all(axis=-1) & (points[..., 2] > 0))] = np.nan
        properties = {name: np.ascontiguousarray(records[name], np.float32) for name in {*names} - _NO_PROPERTIES}
        return cls(points, _colors(records), {name: properties[name] for name in names if name in properties})

    @property
    def depth(self) -> npt.NDArray[np.float32]:
        """(H, W) float32, mm."""
        return self.points[..., 2]

    def records(self) -> npt.NDArray[np.void]:
        """Return the grid as robots' programs have it: (H, W) records of x, y, z, rgb and the properties, float32.

        Places are in m; a colour is the bits 0x00RRGGBB. What was not measured is NaN, and black.
        """
        kinds = [(name, "<f4") for name in (*"xyz", *([] if self.texture is None else ["rgb"]), *self.properties)]
        records = np.empty(self.points.shape[:2], kinds)
        for axis, name in enumerate("xyz"):
            records[name] = self.points[..., axis] * np.float32(0.001)
        if self.texture is not None:
            red, green, blue = (self.texture[..., color].astype(np.uint32) for color in range(3))
            records["rgb"] = (red << 16 | green << 8 | blue).view(np.float32)
        for name, values in self.properties.items():
            records[name] = values
        return records


def _colors(records: npt.NDArray[np.void]) -> npt.NDArray[np.uint8] | None:
    """Return the colours of points, whose bits are 0x00RRGGBB; None: they have none."""
    name = next((name for name in ("rgb", "rgba") if name in (records.dtype.names or ())), None)
    if name is None:
        return None
    bits = np.ascontiguousarray(records[name])
    bits = bits.view(np.uint32) if bits.dtype == np.float32 else bits.astype(np.uint32)
    return np.stack([bits >> 16, bits >> 8, bits], axis=-1).astype(np.uint8)
