"""How fast the phase can change from row to row in a frame of a calibrated rig, and why it does otherwise.

On a surface that camera and projector both see, the projector's rows come in the same order in the camera's picture as
on the projector, whatever the surface's shape: one that turned them over would show its back to one of the two. A frame
whose phase runs the other way is therefore no picture that this rig took, and depths from it are nonsense.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.calibration import Geometry
from pipeline.models import FloatArray

# Places in the camera's picture along either side, and depths from which the bounds come; more change nothing.
_PLACES, _DEPTHS = 9, 12
_LEAST_PX = 16  # smaller pictures have no surface
# Where no depth range is given, things are at these parts of the working distance, which is far more than lenses allow.
_NEAREST, _FARTHEST = 0.5, 2.5
# Where most of a surface is turned further away from the camera or the projector than this, neither sees much of it.
_MOST_TILT = np.radians(70)


@dataclass(frozen=True)
class ExpectedFringe:
    """What a rig's geometry makes of its pattern in the camera's picture, whatever the surface.

    Attributes
    ----------
    least, most : float
        Bounds of the phase's usual change from row to row, stripes along the rows, rad a px; both of one sign.
    period_px : float
        The pattern's, projector px.
    """

    least: float
    most: float
    period_px: float

    @classmethod
    def of(cls, geometry: Geometry, depth_range_mm: tuple[float, float] | None) -> "ExpectedFringe | None":
        """Return that of a rig; None where camera and projector see nothing in common at any depth."""
        depths = depth_range_mm
        if depths is None:
            distance = geometry.working_distance_mm()
            if distance is None:
                return None
            depths = (_NEAREST * distance, _FARTHEST * distance)
        if min(geometry.camera.size_px) < _LEAST_PX:
            return None
        places = _seen_places(geometry, depths)
        rates = 2 * np.pi * (geometry.pattern_cycles(places.below) - geometry.pattern_cycles(places.above))
        rates = rates[places.lit]
        if len(rates) == 0 or not rates.min() * rates.max() > 0:
            return None
        angle = places.angle_rad[places.lit]
        stretch = np.cos(_MOST_TILT - angle) / np.cos(_MOST_TILT) / np.cos(angle)
        ends = np.sort([np.abs(rates) / stretch, np.abs(rates) * stretch], axis=0)
        sign = float(np.sign(rates[0]))
        least, most = sorted((sign * float(ends[0].min()), sign * float(ends[1].max())))
        return cls(least, most, geometry.pattern.period_px)

    def contradiction(self, rate_rad: float) -> str | None:
        """Say why a frame's usual change from row to row (rad a px) is none of this rig's; None: it may be."""
        if self.least <= rate_rad <= self.most or rate_rad == 0:
            return None
        if rate_rad * self.least < 0:
            return (
                "the phase runs against the calibrated rig's, so that no depth can be told: the picture is upside down "
                "or mirrored, or its colours are stored in the order B, G, R: turn it, or swap them"
            )
        seen, *bounds = (2 * np.pi / abs(rate) for rate in (rate_rad, self.least, self.most))
        return (
            f"the fringe has {seen:.1f} px a cycle, and the calibrated pattern of {self.period_px:.4g} projector px "
            f"shows {min(bounds):.1f} to {max(bounds):.1f}, so that no depth can be told: project the pattern of the "
            "calibration, or set its pattern's period_px"
        )


@dataclass(frozen=True)
class _SeenPlaces:
    above: FloatArray  # (N, 3) mm, half a camera row above the place at its depth
    below: FloatArray  # (N, 3) half a row below
    angle_rad: FloatArray  # (N,) between the camera's and the projector's ray
    lit: npt.NDArray[np.bool_]  # (N,) whether the projector's picture reaches it


def _seen_places(geometry: Geometry, depths_mm: tuple[float, float]) -> _SeenPlaces:
    """Return places on a grid in the camera's picture at several depths."""
    axis = geometry.phase_axis
    width, height = geometry.camera.size_px
    rows, columns = (np.linspace(1, n - 2, _PLACES).round().astype(int) for n in (height, width))
    y, x = (grid.ravel() for grid in np.meshgrid(rows, columns, indexing="ij"))
    down = (1, 0) if axis == 1 else (0, 1)
    depth = np.geomspace(*depths_mm, _DEPTHS)[:, None, None]

    def points(step: int) -> FloatArray:
        places = np.column_stack([x + step * down[1], y + step * down[0]]).astype(np.float64)
        along = np.column_stack([geometry.camera.rays_through(places), np.ones(len(y))])
        return np.asarray((depth * along).reshape(-1, 3))

    here, before, after = points(0), points(-1), points(1)
    projector = -geometry.rotation.T @ geometry.translation_mm
    away = here - projector
    cosine = (here * away).sum(axis=1) / np.linalg.norm(here, axis=1) / np.linalg.norm(away, axis=1)
    seen = here @ geometry.rotation.T + geometry.translation_mm
    pixels = seen @ geometry.projector.matrix.T
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = pixels[:, :2] / pixels[:, 2:]
    inside = (pixels >= 0) & (pixels <= np.array(geometry.projector.size_px) - 1)
    return _SeenPlaces(
        above=(here + before) / 2,
        below=(here + after) / 2,
        angle_rad=np.arccos(np.clip(cosine, -1, 1)),
        lit=inside.all(axis=1) & (seen[:, 2] > 0),
    )
