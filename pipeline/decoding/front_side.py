"""Determine without a calibration which side of a surface faces the camera: whether phase grows towards it or away.

Neither shadow nor shading can show it [1]: a convex surface lit from above looks like a hollow one lit from below, and
the phases agree. The decision rests on a prior: a surface that ends before the frame does turns away from the camera
there, as the outlines of faces, limbs and balls do. A bowl is mistaken for a dome.

References
----------
[1] P. N. Belhumeur, D. J. Kriegman, A. L. Yuille, "The bas-relief ambiguity", International Journal of Computer
    Vision 35(1), 1999.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

# Frames are reduced to about this many px along the shorter side.
_SHORTER_PX = 480
# The bend of the phase is measured at a rim and two places inside it, apart by this share of the frame's shorter side.
_REACH = 1 / 40
# How far inside a surface's end its phase is still its own, px.
_INSIDE_PX = 2
# A rim votes if its phase bends by more than this, rad: noise bends it by less.
_LEAST_BEND = 0.02
# A side is clear if it leads by this share of the votes, and by as many as rims of this share of the shorter side have.
_CLEAR_SHARE, _CLEAR_LENGTH = 0.1, 1 / 4


@dataclass(frozen=True)
class RimVotes:
    """Counts of rims where the phase falls and where it grows as surfaces turn away from the camera."""

    falls: int = 0
    grows: int = 0
    needed: int = 1  # the lead from which a side is clear

    @property
    def clear(self) -> bool:
        """True if the rims agree well enough."""
        lead = abs(self.grows - self.falls)
        return lead >= max(self.needed, _CLEAR_SHARE * (self.grows + self.falls))


def ask_rims(unwrapped: npt.NDArray[np.float32], region: npt.NDArray[np.int32]) -> RimVotes:
    """Count which way the rims of a frame's surfaces bend, where the frame does not cut them off.

    Parameters
    ----------
    unwrapped : (H, W) float32
        rad; NaN where there is no surface.
    region : (H, W) int32
        Surfaces from 1; 0: none.
    """
    every = max(1, round(min(region.shape) / _SHORTER_PX))
    unwrapped, region = unwrapped[::every, ::every], region[::every, ::every]
    shorter = min(region.shape)
    reach = max(round(_REACH * shorter), 2)
    rims = _ends(region)
    if not rims.any():
        return RimVotes()
    distance = cv2.distanceTransform((~rims).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    down, right = np.gradient(cv2.GaussianBlur(distance, (0, 0), _INSIDE_PX))
    steep = np.hypot(down, right)
    at = (region > 0) & (distance >= _INSIDE_PX) & (distance < _INSIDE_PX + 1) & (steep > 0.3)
    rim = np.stack(np.nonzero(at))
    # Both steps are alike, so that a ramp leaves no bend.
    inward = np.rint(reach * np.stack([down[at], right[at]]) / steep[at]).astype(int)
    bend, whole = unwrapped[at], np.ones(rim.shape[1], np.bool_)
    for steps, weight in ((1, -2), (2, 1)):
        y, x = place = rim + steps * inward
        within = ((place >= 0) & (place < np.array(region.shape)[:, None])).all(axis=0)
        y, x = np.where(within, place, 0)
        # Beyond the middle of what is thin lies its other rim.
        whole &= within & (region[y, x] == region[at]) & (distance[y, x] > steps * reach / 2)
        bend = bend + weight * unwrapped[y, x]
    bend = bend[whole]
    return RimVotes(int((bend < -_LEAST_BEND).sum()), int((bend > _LEAST_BEND).sum()), round(_CLEAR_LENGTH * shorter))


def _ends(region: npt.NDArray[np.int32]) -> npt.NDArray[np.bool_]:
    """Return the pixels with a neighbour of another surface, or of none; the frame's own edge is no end."""
    ends = np.zeros(region.shape, np.bool_)
    for one, other in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        differs = region[one] != region[other]
        ends[one] |= differs
        ends[other] |= differs
    return ends
