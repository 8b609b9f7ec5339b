"""The contrast of every cycle that a column of patches shows whole, and its steps from cycle to cycle.

The contrast's logarithm is the code's, times a strength, plus what blur and ambient light make of a surface's contrast.
What the camera's blur takes, which is more where a surface turns away and the fringe is finer, is put back; the rest
changes slowly and cancels in the steps.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.models import FloatArray
from pipeline.orders.posterior import Integers
from tikernels.order_evidence.contrast_reading import BACKGROUND, MODULATION, ORDER_SLOTS, PHASE, TOTAL
from tikernels.phase.camera_blur import VARIANCE_PX
from tikernels.unwrapping.patches import PatchGraph
from tikernels.unwrapping.tables import CELL_HEIGHT, CELL_WIDTH

# A cycle counts from this weight on (a full one of 12 px has 13 in a patch's columns), and if it is whole: its pixels'
# mean phase (rad) is near its middle's.
_MIN_WEIGHT, _MAX_MEAN_PHASE = 3.0, 0.3
# What blur takes of a contrast's logarithm, times the square of the cycle's weight: p px weigh 16 / 15 p in a patch's
# two columns. A cycle is as long as the longest of so many columns of patches.
_BLUR, _NEAR_COLUMNS = 2 * np.pi**2 * VARIANCE_PX * (16 / 15) ** 2, 5


@dataclass(frozen=True)
class Cycles:
    """What patches show of whole cycles; a cycle that a cell's border cuts is there once for each of its patches."""

    patch: Integers  # (N,)
    order: Integers  # (N,) the cycle's order in its region
    share: FloatArray  # (N,) how much of the cycle the patch holds
    contrast: FloatArray  # (N,) natural logarithm, before the camera's blur
    brightness: FloatArray  # (N,) levels


@dataclass(frozen=True)
class Steps:
    """By how much the logarithm of the contrast rises from one cycle to the next, patch by patch."""

    low: Integers  # (N,) patch that holds most of the lower cycle
    high: Integers  # (N,) and of the higher one
    order: Integers  # (N,) the lower cycle's order in its region
    rise: FloatArray  # (N,)
    column: Integers  # (N,) of patches
    brightness: FloatArray  # (N,) levels, the darker cycle's


def read_cycles(sums: npt.NDArray[np.float32], graph: PatchGraph, width: int, rising: bool) -> tuple[Cycles, Steps]:
    """Put the cycles of every column of patches in a row and take the steps between whole ones.

    Parameters
    ----------
    sums : (P, ORDER_SLOTS, 4) float32
        What `measure_contrast` summed.
    graph : PatchGraph
        The patches, joined to regions.
    width : int
        The image's, px.
    rising : bool
        Whether the orders grow with the rows.
    """
    patch, slot = np.nonzero(sums[..., TOTAL] > 0)
    values = sums[patch, slot].astype(np.float64)
    order = graph.offset[patch].astype(np.int64) + slot - ORDER_SLOTS // 2
    root, first = graph.root[patch], graph.first[patch]
    column, row = first % width // CELL_WIDTH, first // width // CELL_HEIGHT
    sign = 1 if rising else -1
    sort = np.lexsort((sign * order, row, column, root))
    patch, order, root = patch[sort], order[sort], root[sort]
    column, row, values = column[sort], row[sort], values[sort]
    if len(patch) == 0:
        nothing, none = np.zeros(0, np.int64), np.zeros(0)
        cycles = Cycles(nothing, nothing, none, none, none)
        return cycles, Steps(nothing, nothing, nothing, none, nothing, none)
    # A cycle that a cell's border cuts is put together again.
    fresh = np.ones(len(patch), np.bool_)
    fresh[1:] = (np.diff(root) != 0) | (np.diff(column) != 0) | (np.diff(order) != 0) | (np.diff(row) > 1)
    start = np.flatnonzero(fresh)
    last = np.append(start[1:], len(patch)) - 1
    total = np.add.reduceat(values, start, axis=0)
    whole = total[:, TOTAL] >= _MIN_WEIGHT
    whole &= np.abs(total[:, PHASE]) < _MAX_MEAN_PHASE * total[:, TOTAL]
    whole &= np.minimum(total[:, MODULATION], total[:, BACKGROUND]) > 0
    contrast = np.log(np.where(whole, total[:, MODULATION], 1.0) / np.where(whole, total[:, BACKGROUND], 1.0))
    contrast += _taken_by_blur(
        total[:, TOTAL], root[start].astype(np.int64), order[start], column[start].astype(np.int64)
    )
    upper, lower = start[:-1], start[1:]
    follows = whole[:-1] & whole[1:] & (order[lower] - order[upper] == sign)
    follows &= (root[lower] == root[upper]) & (column[lower] == column[upper]) & (row[lower] - row[last[:-1]] <= 1)
    place = np.flatnonzero(follows)
    low, high = start[place + (not rising)], start[place + rising]
    rise = contrast[place + rising] - contrast[place + (not rising)]
    light = total[:, BACKGROUND] / np.maximum(total[:, TOTAL], 1e-9)
    darker = np.minimum(light[place], light[place + 1])
    steps = Steps(patch[low], patch[high], order[low], rise, column[low].astype(np.int64), darker)
    of_cycle = np.cumsum(fresh) - 1
    held = np.flatnonzero(whole[of_cycle])
    of_cycle, mine = of_cycle[held], values[held]
    share = mine[:, TOTAL] / total[of_cycle, TOTAL]
    brightness = mine[:, BACKGROUND] / mine[:, TOTAL]
    return Cycles(patch[held], order[held], share, contrast[of_cycle], brightness), steps


def _taken_by_blur(weight: FloatArray, root: Integers, order: Integers, column: Integers) -> FloatArray:
    """Return by how much the camera's blur has lowered the logarithm of the contrast of each cycle, (N,).

    A cycle's weight tells its length, but for pixels that are left out; columns next to it show the same cycle.
    """
    rows, row = np.unique(root * (order.max() - order.min() + 1) + order, return_inverse=True)
    grid = np.zeros((len(rows), column.max() + 1), np.float32)
    np.maximum.at(grid, (row, column), weight)
    whole = cv2.dilate(grid, np.ones((1, _NEAR_COLUMNS), np.uint8))[row, column]
    return np.asarray(_BLUR / np.maximum(whole, _MIN_WEIGHT) ** 2)
