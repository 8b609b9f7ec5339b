"""Bounds of the phase's change from row to row in a frame of a calibrated rig, and causes of other changes.

On a surface that camera and projector both see, the projector's rows come in the same order in the camera's picture as
on the projector, whatever the surface's shape: one that turned them over would show its back to one of the two. A frame
whose phase runs the other way is therefore no picture that this rig took, and depths from it are nonsense.
"""

from dataclasses import dataclass

import numpy as np

from pipeline.calibration import Geometry
from pipeline.causes import Cause, Key
from pipeline.models import FloatArray

# Places in the camera's picture along either side, and depths from which the bounds come; more change nothing.
_PLACES = 9
# Where no depth range is given, things are between these parts of the working distance.
_NEAREST, _FARTHEST = 0.5, 2.0
# Where most of a surface is turned further away from the camera or the projector than the first, neither sees much of
# it; usual surfaces are turned by less than the second: simulated scenes stay within 40 degrees.
_MOST_TILT, _USUAL_TILT = np.radians(70), np.radians(50)
_OTHER = (
    "the projector shows another period than the calibration's {:.4g} px, or the camera another field of view (zoom, "
    "binning, region); one frame does not show which"
)

#: Bounds of the phase's usual change from row to row, stripes along the rows, rad per px; both of one sign.
Bounds = tuple[float, float]


@dataclass(frozen=True)
class ExpectedFringe:
    """Periods and slopes that a rig's geometry gives its pattern in the camera's picture.

    Attributes
    ----------
    possible, usual : Bounds
        Whatever the surface; and of surfaces that are not steep.
    period_px : float
        The pattern's, projector px.
    """

    possible: Bounds
    usual: Bounds
    period_px: float

    @classmethod
    def of(cls, geometry: Geometry, depth_range_mm: tuple[float, float] | None) -> "ExpectedFringe | None":
        """Return that of a rig; None where camera and projector see nothing in common at any depth."""
        distance = geometry.working_distance_mm()
        if depth_range_mm is None and distance is None:
            return None
        possible, usual = (
            _bounds(geometry, depth_range_mm or (_NEAREST * (distance or 0), _FARTHEST * (distance or 0)), tilt)
            for tilt in (_MOST_TILT, _USUAL_TILT)
        )
        if possible is None or usual is None:
            return None
        return cls(possible, usual, geometry.pattern.period_px)

    def is_reversed(self, rate_rad: float) -> bool:
        """Return whether a frame's usual change from row to row (rad per px) has the opposite sign to this rig's."""
        return rate_rad * self.possible[0] < 0

    def contradiction(self, rate_rad: float, period_px: float) -> Cause | None:
        """State why a frame's usual change from row to row and its period cannot be this rig's; None: they can."""
        return self._beyond(self.possible, rate_rad, period_px, "impossible period", "no depth can be determined")

    def surprise(self, rate_rad: float, period_px: float) -> Cause | None:
        """State that a usual surface of this rig shows another period; None: it shows this one."""
        words = "depths are wrong, unless the surface is steep"
        return self._beyond(self.usual, rate_rad, period_px, "unusual period", words)

    def _beyond(self, bounds: Bounds, rate_rad: float, period_px: float, key: Key, what: str) -> Cause | None:
        # Noise and blur bend the changes from row to row of a weak fringe, and not the period that its frame has.
        both = rate_rad, float(np.copysign(2 * np.pi / period_px, rate_rad))
        if rate_rad == 0 or any(bounds[0] <= rate <= bounds[1] for rate in both):
            return None
        seen, *ends = (2 * np.pi / abs(rate) for rate in (rate_rad, *bounds))
        sizes = (
            f"the fringe has {seen:.1f} px per cycle, and the calibrated rig shows {min(ends):.1f} to {max(ends):.1f}"
        )
        return Cause(key, f"{what}: {sizes}: {_OTHER.format(self.period_px)}")


def _bounds(geometry: Geometry, depths_mm: tuple[float, float], most_tilt: float) -> Bounds | None:
    """Return the bounds of surfaces at some depths that are tilted by no more than this, rad; None: none is lit."""
    rates, angle = _lit_places(geometry, depths_mm)
    if len(rates) == 0 or not rates.min() * rates.max() > 0:
        return None
    stretch = np.cos(most_tilt - angle) / np.cos(most_tilt) / np.cos(angle)
    ends = np.sort([np.abs(rates) / stretch, np.abs(rates) * stretch], axis=0)
    sign = float(np.sign(rates[0]))
    least, most = sorted((sign * float(ends[0].min()), sign * float(ends[1].max())))
    return least, most


def _lit_places(geometry: Geometry, depths_mm: tuple[float, float]) -> tuple[FloatArray, FloatArray]:
    """Return places that the projector's picture reaches, of a grid in the camera's picture at several depths.

    Returns
    -------
    (N,) array
        Change of phase from row to row at one depth, rad per px.
    (N,) array
        Angle between the camera's and the projector's ray, rad.
    """
    width, height = geometry.camera.size_px
    rows, columns = (np.linspace(1, n - 2, _PLACES).round().astype(int) for n in (height, width))
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2).astype(np.float64)
    half_a_row = np.array([0, 0.5] if geometry.phase_axis == 1 else [0.5, 0])
    depth = np.geomspace(*depths_mm, _PLACES)[:, None, None]

    def points(rows_down: float) -> FloatArray:
        rays = geometry.camera.rays_through(pixels + rows_down * half_a_row)
        return np.asarray((depth * np.column_stack([rays, np.ones(len(rays))])).reshape(-1, 3))

    here, above, below = points(0), points(-1), points(1)
    away = here + geometry.rotation.T @ geometry.translation_mm  # from the projector
    cosine = (here * away).sum(axis=1) / np.linalg.norm(here, axis=1) / np.linalg.norm(away, axis=1)
    seen = here @ geometry.rotation.T + geometry.translation_mm
    with np.errstate(divide="ignore", invalid="ignore"):
        shown = (seen @ geometry.projector.matrix.T / seen[:, 2:])[:, :2]
    inside = (shown >= 0) & (shown <= np.array(geometry.projector.size_px) - 1)
    lit = inside.all(axis=1) & (seen[:, 2] > 0)
    rates = 2 * np.pi * (geometry.pattern_cycles(below) - geometry.pattern_cycles(above))
    return rates[lit], np.arccos(np.clip(cosine, -1, 1))[lit]
