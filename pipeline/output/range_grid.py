"""A frame's places in mm as the camera's grid has them, for formats that keep the grid."""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from pipeline.calibration.model import Lens


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
