"""A range image as what meshing needs: depth, its standard deviation, the width of a pixel, and regions."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.robust import robust_sigma

Floats = npt.NDArray[np.float32]
Pixels = npt.NDArray[np.bool_]

#: By how many widths of a pixel a surface's depth may change from one to the next: what is turned away by more, 81
#: degrees, cannot be told from a step. On simulated busts no triangle then joins what lies 5 mm apart.
MAX_SLOPE = float(np.tan(np.radians(81.0)))
# Without a calibration a pixel's width in rad is not known. A neighbour that differs by this much lies on another
# surface: unwrapping joins none that differs by more than 0.8 rad from what is usual.
_MAX_STEP_RAD = 1.0
# Where nothing is known of noise, second differences over pixels so far apart that smoothing has not made them alike
# tell it, px.
_APART_PX = 4
# Rows that tell what a pixel is wide: a median of more changes nothing.
_ASKED_ROWS = 40


@dataclass(frozen=True, eq=False)
class RangeSurface:
    """A range image; outside its regions the numbers are of no account."""

    depth: Floats
    """(H, W) float32: mm or rad."""
    sigma: Floats
    """(H, W) float32: its standard deviation, in the same unit."""
    width: Floats
    """(H, W) float32: of a pixel, in the same unit."""
    region: npt.NDArray[np.int32]
    """(H, W) int32: connected surfaces from 1; 0: none."""

    @classmethod
    def of(
        cls,
        values: Floats,
        mask: Pixels,
        points: Floats | None,
        sigma: Floats | None,
        region: npt.NDArray[np.int32] | None,
    ) -> "RangeSurface":
        """Prepare a range image.

        Parameters
        ----------
        values : (H, W) float32
            Relative phase, rad; of no account where there are points.
        mask : (H, W) bool
            Pixels that have a range.
        points : (H, W, 3) float32 or None
            mm, camera frame.
        sigma : (N,) float32 or None
            Standard deviation of each masked pixel, row by row; None: the range image's own scatter.
        region : (H, W) int32 or None
            Connected surfaces; None: all may be one.
        """
        depth = np.where(mask, values if points is None else points[..., 2], np.float32(0))
        doubt = np.ones(mask.shape, np.float32)
        doubt[mask] = _scatter(depth, mask) if sigma is None else np.nan_to_num(sigma, nan=np.inf)
        known = mask & np.isfinite(doubt) & (doubt > 0)
        doubt[~known] = 1
        if points is None:
            width = np.full(mask.shape, _MAX_STEP_RAD / MAX_SLOPE, np.float32)
        else:
            width = depth * np.float32(_ray_step(points, mask))
        whole = mask.astype(np.int32) if region is None else region
        return cls(depth, doubt, width, np.where(known, whole, np.int32(0)))

    def without(self, pixels: Pixels) -> "RangeSurface":
        """Return the surface with some pixels in no region."""
        return RangeSurface(self.depth, self.sigma, self.width, np.where(pixels, np.int32(0), self.region))


def _scatter(depth: Floats, mask: Pixels) -> float:
    """Return what the depth's second differences along the rows say of its standard deviation."""
    first, middle, last = (slice(_APART_PX * k, depth.shape[1] - _APART_PX * (2 - k)) for k in range(3))
    both = mask[:, first] & mask[:, middle] & mask[:, last]
    bends = (depth[:, first] - 2 * depth[:, middle] + depth[:, last])[both].astype(np.float64)
    known = robust_sigma(bends) / np.sqrt(6) if len(bends) else 0.0
    return max(known, float(np.finfo(np.float32).eps) * float(np.abs(depth).max(initial=1)))


def _ray_step(points: Floats, mask: Pixels) -> float:
    """Return how far the rays of neighbouring pixels are apart at unit depth."""
    every = max(1, len(mask) // _ASKED_ROWS)
    points, mask = points[::every], mask[::every]
    both = mask[:, 1:] & mask[:, :-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        rays = points[..., :2] / points[..., 2:]
    steps = np.linalg.norm(np.diff(rays, axis=1)[both], axis=-1)
    return float(np.median(steps)) if len(steps) else 1.0
