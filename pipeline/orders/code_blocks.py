"""The contrast of every whole cycle in blocks of four columns, which is what a pattern's code is read from.

The contrast's logarithm is the code's plus what blur and ambient light make of a surface's contrast. What the camera's
blur takes, which is more where a surface turns away and the fringe is finer, is put back; the rest changes slowly.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.models import FloatArray
from pipeline.orders.posterior import Integers
from tikernels.order_evidence.contrast_reading import (
    BACKGROUND,
    BLOCK_WIDTH,
    BLOCKS,
    MODULATION,
    ORDER_SLOTS,
    PHASE,
    TOTAL,
)
from tikernels.phase.camera_blur import VARIANCE_PX
from tikernels.unwrapping.patches import PatchGraph
from tikernels.unwrapping.tables import CELL_HEIGHT, CELL_WIDTH

# A cycle counts from this weight on (a full one of 12 px has 26 in a block), and if it is whole: its pixels' mean phase
# (rad) is near its middle's.
_MIN_WEIGHT, _MAX_MEAN_PHASE = 6.0, 0.3
# Weight of a pixel row of a block, and what blur takes of a contrast's logarithm, times the square of the cycle's
# weight. A cycle is as long as the longest of so many blocks.
_ROW_WEIGHT = BLOCK_WIDTH * 8 / 15
_BLUR, _NEAR_BLOCKS = 2 * np.pi**2 * VARIANCE_PX * _ROW_WEIGHT**2, 9
# Variance of the logarithm, in units of the noise's: of a mean of three channels, and of the fringe in them; a block's
# weight counts as so many pixels.
_OF_BACKGROUND, _OF_MODULATION, _COUNTED = 0.45, 0.9, 0.7


@dataclass(frozen=True)
class Blocks:
    """What is seen of whole cycles, in blocks of some columns, and which patches hold them."""

    root: Integers  # (N,) patch that stands for the part
    order: Integers  # (N,) the cycle's order in it
    place: FloatArray  # (N, 2) row and column of its middle, px
    contrast: FloatArray  # (N,) natural logarithm, before the camera's blur
    variance: FloatArray  # (N,) of that, by the camera's noise
    brightness: FloatArray  # (N,) levels, where the fringe is brightest
    block: Integers  # (M,) a block
    patch: Integers  # (M,) a patch that holds some of it
    share: FloatArray  # (M,) how much


def read_blocks(sums: npt.NDArray[np.float32], graph: PatchGraph, width: int, noise: float) -> Blocks:
    """Put together what the patches of a part show of each cycle, and keep what is whole.

    Parameters
    ----------
    sums : (P, ORDER_SLOTS, BLOCKS, 4) float32
        What `measure_contrast` summed.
    graph : PatchGraph
        The patches, joined to regions, or to parts of them.
    width : int
        The image's, px.
    noise : float
        Standard deviation of a channel, levels.
    """
    patch, slot, block = np.nonzero(sums[..., TOTAL] > 0)
    values = sums[patch, slot, block].astype(np.float64)
    order = graph.offset[patch].astype(np.int64) + slot - ORDER_SLOTS // 2
    root, first = graph.root[patch].astype(np.int64), graph.first[patch]
    column, row = (first % width // CELL_WIDTH * BLOCKS + block).astype(np.int64), first // width // CELL_HEIGHT
    # A cycle that a cell's border cuts is put together again. Sorting a single number is quick.
    least, orders, rows = order.min(initial=0), np.ptp(order) + 1 if len(order) else 1, row.max(initial=0) + 1
    cycle = (root * (column.max(initial=0) + 1) + column) * orders + order - least
    sort = np.argsort(cycle * rows + row, kind="stable")
    patch, order, root, cycle = patch[sort], order[sort], root[sort], cycle[sort]
    column, row, values = column[sort], row[sort], values[sort]
    fresh = np.ones(len(patch), np.bool_)
    fresh[1:] = (np.diff(cycle) != 0) | (np.diff(row) > 1)
    start, of = np.flatnonzero(fresh), np.cumsum(fresh) - 1
    total = np.add.reduceat(values, start, axis=0) if len(start) else np.zeros((0, 4))
    weight = total[:, TOTAL]
    whole = (weight >= _MIN_WEIGHT) & (np.abs(total[:, PHASE]) < _MAX_MEAN_PHASE * weight)
    whole &= np.minimum(total[:, MODULATION], total[:, BACKGROUND]) > 0
    middle = np.bincount(of, values[:, TOTAL] * row, len(start))
    start, total, weight, middle = start[whole], total[whole], weight[whole], middle[whole]
    root, order, column = root[start], order[start], column[start]
    contrast = np.log(total[:, MODULATION] / total[:, BACKGROUND]) + _taken_by_blur(weight, root, order, column)
    modulation, background = total[:, MODULATION] / weight, total[:, BACKGROUND] / weight
    variance = noise**2 * (_OF_MODULATION / modulation**2 + _OF_BACKGROUND / background**2) / (_COUNTED * weight)
    place = np.stack([CELL_HEIGHT * (middle / weight + 0.5), BLOCK_WIDTH * (column + 0.5)], axis=1) - 0.5
    number = np.where(whole, np.cumsum(whole) - 1, -1)[of]
    held = number >= 0
    share = values[held, TOTAL] / weight[number[held]]
    seen = (contrast, variance, modulation + background)
    return Blocks(root, order, place, *seen, number[held], patch[held], share)


def _taken_by_blur(weight: FloatArray, root: Integers, order: Integers, column: Integers) -> FloatArray:
    """Return by how much the camera's blur has lowered the logarithm of the contrast of each cycle, (N,).

    A cycle's weight tells its length, but for pixels that are left out; blocks next to it show the same cycle.
    """
    if len(weight) == 0:
        return np.zeros(0)
    rows, row = np.unique(root * (np.ptp(order) + 1) + order, return_inverse=True)
    grid = np.zeros((len(rows), column.max() + 1), np.float32)
    np.maximum.at(grid, (row, column), weight)
    whole = cv2.dilate(grid, np.ones((1, _NEAR_BLOCKS), np.uint8))[row, column]
    return np.asarray(_BLUR / np.maximum(whole, _MIN_WEIGHT) ** 2)
