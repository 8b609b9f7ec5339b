"""The contrast of every cycle in blocks of four columns, which is what a pattern's code is read from.

The contrast's logarithm is the code's plus the effect of blur and ambient light on a surface's contrast. The loss to
the camera's blur, which is larger where a surface turns away and the fringe is finer, is restored; the rest changes
slowly.
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
    COSINE,
    MODULATION,
    PHASE,
    SUMS,
    TOTAL,
)
from tikernels.phase.camera_blur import VARIANCE_PX
from tikernels.unwrapping.patches import PatchGraph
from tikernels.unwrapping.tables import CELL_HEIGHT, CELL_WIDTH

# A cycle counts from this weight on (a full one of 12 px has 26 in a block), and from this share of a full one's; what
# is that much shorter than the cycles next to it is cut.
_MIN_WEIGHT, _MIN_SHARE, _MIN_WHOLE = 6.0, 0.35, 0.7
# Weight of a pixel row of a block, and what blur takes of a contrast's logarithm, times the square of the cycle's
# weight. A cycle is as long as the longest of so many blocks.
_ROW_WEIGHT = BLOCK_WIDTH * 8 / 15
_BLUR, _NEAR_BLOCKS = 2 * np.pi**2 * VARIANCE_PX * _ROW_WEIGHT**2, 9
# Variance of the logarithm, in units of the noise's: of a mean of three channels, and of the fringe in them; a block's
# weight counts as so many pixels.
_OF_BACKGROUND, _OF_MODULATION, _COUNTED = 0.45, 0.9, 0.7
# Pieces determine the ripple from this weight on, and unless they deviate by more; without any there is none (the
# weight that this counts as).
_MIN_PIECE, _MOST_RIPPLE, _RIPPLE_DOUBT = 3.0, 0.3, 10.0


@dataclass(frozen=True)
class Blocks:
    """Contrasts of whole cycles in blocks of some columns, and the patches that hold them."""

    root: Integers  # (N,) patch that represents the part
    order: Integers  # (N,) the cycle's order in it
    place: FloatArray  # (N, 2) row and column of its middle, px
    contrast: FloatArray  # (N,) natural logarithm, before the camera's blur
    variance: FloatArray  # (N,) of that, by the camera's noise
    brightness: FloatArray  # (N,) levels, where the fringe is brightest
    off: FloatArray  # (N,) cycles from the cycle's middle to that of what is seen of it
    block: Integers  # (M,) a block
    patch: Integers  # (M,) a patch that holds some of it
    share: FloatArray  # (M,) how much
    ripple: FloatArray  # (2,) cosine and sine of three times the phase that the contrast's logarithm had


def read_blocks(
    sums: npt.NDArray[np.float32], graph: PatchGraph, width: int, noise: float, ripple: FloatArray | None = None
) -> Blocks:
    """Put together what the patches of a part show of each cycle, and keep what is enough of one.

    Parameters
    ----------
    sums : (P, slots, BLOCKS, SUMS) float32
        The sums of `measure_contrast`.
    graph : PatchGraph
        The patches, joined to regions, or to parts of them.
    width : int
        The image's, px.
    noise : float
        Standard deviation of a channel, levels.
    ripple : (2,) float, optional
        The ripple, if the frame's blocks were read before; see `Blocks`.
    """
    slots = sums.shape[1]
    piece = np.flatnonzero(sums[..., TOTAL] > 0)
    patch = piece // (slots * BLOCKS)
    slot, block = piece // BLOCKS % slots, piece % BLOCKS
    row, column = graph.first // width // CELL_HEIGHT, graph.first % width // CELL_WIDTH * BLOCKS
    # A cycle that a cell's border cuts is put together again: numbers of its pieces, one per row, follow each other.
    least, rows = graph.offset.min(initial=0), row.max(initial=0) + 2
    orders = graph.offset.max(initial=0) - least + slots
    number = graph.root.astype(np.int64) * (column.max(initial=0) + BLOCKS) + column
    number = ((number * orders + graph.offset - least) * rows + row)[patch] + (block * orders + slot) * rows
    sort = np.argsort(number, kind="stable")
    fresh = np.diff(number[sort], prepend=-2) > 1
    of = np.cumsum(fresh) - 1
    first, patch = sort[fresh], patch[sort]
    of_first = patch[fresh]
    root, order = graph.root[of_first].astype(np.int64), graph.offset[of_first] + slot[first] - slots // 2
    column = column[of_first] + block[first]
    values = sums.reshape(-1, SUMS).take(piece[sort], axis=0).T.astype(np.float64, order="C")
    total = np.stack([np.bincount(of, summed, len(first)) for summed in values])
    middle = np.bincount(of, values[TOTAL] * row[patch], len(first))
    weight = total[TOTAL]
    shown = np.minimum(total[MODULATION], total[BACKGROUND]) > 0
    mean = total / weight
    contrast = np.log(np.where(shown, total[MODULATION], 1.0) / np.where(shown, total[BACKGROUND], 1.0))
    ripple = _ripple(values, of, mean, contrast) if ripple is None else ripple
    contrast -= ripple @ mean[COSINE:]
    full = _full_weight(weight, root, order, column)
    contrast += _BLUR / full**2
    shown &= (weight >= _MIN_WEIGHT) & (weight > _MIN_SHARE * full)
    variance = _OF_MODULATION / mean[MODULATION] ** 2 + _OF_BACKGROUND / mean[BACKGROUND] ** 2
    variance *= noise**2 / (_COUNTED * weight)
    place = np.stack([CELL_HEIGHT * (middle / weight + 0.5), BLOCK_WIDTH * (column + 0.5)], axis=1) - 0.5
    brightness, off = mean[MODULATION] + mean[BACKGROUND], mean[PHASE] / (2 * np.pi)
    seen = contrast[shown], variance[shown], brightness[shown], off[shown]
    number = np.where(shown, np.cumsum(shown) - 1, -1)[of]
    held = np.flatnonzero(number >= 0)
    share = values[TOTAL, held] / weight[of[held]]
    place = place.compress(shown, axis=0)
    return Blocks(root[shown], order[shown], place, *seen, number[held], patch[held], share, ripple)


def change_by_cycle(blocks: Blocks) -> float:
    """Return the median change of the contrast's logarithm from a cycle to the next one; 0 where none is seen."""
    sort = np.lexsort((blocks.order, blocks.place[:, 1], blocks.root))
    same = (np.diff(blocks.root[sort]) == 0) & (np.diff(blocks.place[sort, 1]) == 0)
    changes = np.abs(np.diff(blocks.contrast[sort]))[same & (np.diff(blocks.order[sort]) == 1)]
    return float(np.median(changes)) if len(changes) else 0.0


def _ripple(values: FloatArray, of: Integers, mean: FloatArray, contrast: FloatArray) -> FloatArray:
    """Return how much cosine and sine of three times the phase are in the contrast's logarithm.

    By the pieces of cycles that cells' borders cut: a piece has more or less of them than the whole.
    """
    counts = values[TOTAL] > _MIN_PIECE
    counts &= np.minimum(values[MODULATION], values[BACKGROUND]) > 0
    piece, of = values.compress(counts, axis=1), of[counts]
    departs = np.log(piece[MODULATION] / piece[BACKGROUND]) - contrast[of]
    waves = piece[COSINE:] / piece[TOTAL] - mean[COSINE:].take(of, axis=1)
    weighted = waves * (piece[TOTAL] * (np.abs(departs) < _MOST_RIPPLE))
    share = np.linalg.solve(weighted @ waves.T + _RIPPLE_DOUBT * np.eye(2), weighted @ departs)
    return np.asarray(share, np.float64)


def _full_weight(weight: FloatArray, root: Integers, order: Integers, column: npt.NDArray[np.integer]) -> FloatArray:
    """Return what each block would weigh if its cycle were whole (N,): as the longest of those around it does.

    Blocks of a root follow each other.
    """
    if len(weight) == 0:
        return np.zeros(0)
    number = np.cumsum(np.diff(root, prepend=root[0]) != 0) * (np.ptp(order) + 1) + order - order.min()
    rows, columns = np.cumsum(np.bincount(number) > 0), column.max() + 1
    place, grid = (rows[number] - 1) * columns + column, np.zeros((rows[-1], columns), np.float32)
    np.maximum.at(grid.reshape(-1), place, weight.astype(np.float32))
    beside = cv2.dilate(grid, np.ones((1, _NEAR_BLOCKS), np.uint8))
    around = cv2.dilate(beside, np.ones((3, 1), np.uint8))
    # A cycle that a surface's edge cuts all along is as long as the next one.
    longest = np.where(beside < _MIN_WHOLE * around, around, beside)
    return np.asarray(np.maximum(longest.reshape(-1)[place], _MIN_WEIGHT), np.float64)
