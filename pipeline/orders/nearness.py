"""Expected places of a frame's parts, from those that the code has surely placed.

Surfaces are near each other rather than anywhere in the projector's picture.
"""

import numpy as np
import numpy.typing as npt

from pipeline.models import FloatArray
from pipeline.orders.posterior import Integers
from tikernels.unwrapping.patches import PatchGraph

# Half of all surfaces lie within this many cycles of those that are known, relative to a plane through the frame.
_NEAR_CYCLES = 4.0


def nearness(
    graph: PatchGraph, roots: npt.NDArray[np.int32], width: int, offsets: dict[int, int]
) -> npt.NDArray[np.float64]:
    """Return the number of cycles that each part lacks to lie where the frame's placed parts are.

    Parameters
    ----------
    graph : PatchGraph
        The patches.
    roots : (P,) int32
        The patch that represents each patch's part.
    width : int
        The image's, px.
    offsets : dict
        Of the placed parts, by their roots: what their orders lack.

    Returns
    -------
    (P,) float64
        By root; elsewhere it has no meaning.
    """
    place = np.stack([graph.first // width, graph.first % width]).astype(np.float64)
    cycles, pixels = graph.offset.astype(np.float64), graph.pixels
    count = len(roots)
    held = np.bincount(roots, pixels, count)
    share = pixels / np.maximum(held, 1)[roots]  # of each patch in its part
    middle = np.stack([np.bincount(roots, share * values, count) for values in place])
    mean = np.bincount(roots, share * cycles, count)
    # The slopes that all parts have in common, whatever their orders.
    within = place - middle[:, roots]
    weighted = within * pixels
    slopes = np.linalg.lstsq(weighted @ within.T, weighted @ (cycles - mean[roots]), rcond=None)[0]
    level = mean - slopes @ middle
    known = np.array(list(offsets))
    here = level[known] + np.array([offsets[root] for root in known])
    sort = np.argsort(here)
    below = np.cumsum(held[known][sort])
    usual = here[sort][np.searchsorted(below, 0.5 * below[-1])]
    return np.asarray(usual - level)


def log_nearness(lacking: float, offsets: Integers) -> FloatArray:
    """Return the logarithm of how usual these offsets are, for a part that lacks so many cycles to be near the rest."""
    return np.asarray(-np.log1p(((offsets - lacking) / _NEAR_CYCLES) ** 2))
