"""What the captures of a pose show beside the corners: how sharp they are, and whether the board stood still.

The mean of a level's fringes, over its steps, is a picture evenly lit, for the steps are spread evenly over a cycle. So
the board is seen in it as in the white picture, only later, and its corners can be compared.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from pipeline.calibration.multishot import fringe_groups
from pipeline.models import FloatArray, ImageArray

# Within this part of a square's side about a corner there are its edges, and no others.
_REACH = 0.4
# The least reach, px: an edge blurred by 1 px is 4 px wide.
_MIN_REACH_PX = 4
# The smoothing, px, before slopes are measured, so that noise does not pass for a sharp edge; and what it and the
# difference of neighbours add to an edge's variance, px^2.
_SMOOTHING_PX, _ADDED_PX2 = 1.0, 1.0 + 1 / 3


@dataclass(frozen=True)
class PictureEvidence:
    """What the pictures of one pose show of how they were taken."""

    blur_px: float  # sigma of the edges at the corners; NaN: there is no room to see it
    drift_px: tuple[tuple[str, float], ...]  # by how much corners have moved since the white picture, and the name of
    # the picture before which they had, in order of projection

    @property
    def moved_px(self) -> float:
        """The largest move of the corners while the pictures were taken; 0 where none was looked for."""
        return max((moved for _, moved in self.drift_px), default=0.0)

    @property
    def moved_before(self) -> str:
        """The first picture by which corners had moved by half as much or more."""
        return next(name for name, moved in self.drift_px if moved >= 0.5 * self.moved_px)


def edge_blur_px(grey: FloatArray, corners: FloatArray, side_px: float) -> float:
    """Return how blurred a picture is at a board's corners, as the sigma of its edges, px.

    Parameters
    ----------
    grey : (H, W)
        Any scale.
    corners : (N, 2)
        Where black meets white, px.
    side_px : float
        A square's side.

    Notes
    -----
    An edge of height h that is blurred by a Gaussian of sigma has the slope h / (sigma sqrt(2 pi)) in its middle. The
    result is the corners' median; what noise and the edge's own smoothing add is taken off.
    """
    smooth = cv2.GaussianBlur(grey, (0, 0), _SMOOTHING_PX)
    slope = np.hypot(*np.gradient(smooth))
    reach = max(round(_REACH * side_px), _MIN_REACH_PX)
    found = []
    for x, y in np.rint(corners).astype(int):
        if min(x, y) < reach or x + reach >= grey.shape[1] or y + reach >= grey.shape[0]:
            continue
        window = np.s_[y - reach : y + reach + 1, x - reach : x + reach + 1]
        height = float(np.ptp(smooth[window]))
        steepest = float(slope[window].max())
        if steepest > 0:
            found.append((height / steepest) ** 2 / (2 * np.pi) - _ADDED_PX2)
    return float(np.sqrt(max(np.median(found), 0.0))) if found else float("nan")


def find_drift(
    captures: Mapping[str, ImageArray],
    grey: FloatArray,
    corners: FloatArray,
    refine: Callable[[FloatArray, FloatArray], FloatArray],
) -> tuple[tuple[str, float], ...]:
    """Return how far a board's corners have moved since the white picture, group by group of fringes.

    Parameters
    ----------
    captures : mapping from name to (H, W, 3)
        The captures of `multishot_sequence`.
    grey : (H, W)
        The white one, 0..1.
    corners : (N, 2)
        Its corners, px.
    refine : callable
        From a picture and corners nearby to the corners in it.

    Returns
    -------
    tuple of (str, float)
        A group's first picture, and the median distance, px, of its corners from those of the white picture.
    """
    before = refine(grey, corners)
    found = []
    for names in fringe_groups():
        lit = sum(captures[name].astype(np.float64).mean(axis=-1) for name in names)
        # As bright as the white picture, which the refinement's smoothing and thresholds are made for.
        after = refine(lit * (grey.max() / max(float(np.max(lit)), 1e-9)), before)
        found.append((names[0], float(np.median(np.linalg.norm(after - before, axis=1)))))
    return tuple(found)
