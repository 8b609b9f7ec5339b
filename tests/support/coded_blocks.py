"""Blocks of made-up surfaces that show a pattern's code, without a picture."""

from functools import cache

import numpy as np

from pipeline.contrast_code import GAMMAS, ContrastCode
from pipeline.orders.code_blocks import Blocks
from pipeline.orders.code_evidence import CodeReader
from pipeline.orders.stripe_columns import StripeColumns, column_at
from pipeline.simulation import simulated_rig
from tikernels.order_evidence.contrast_reading import BLOCK_WIDTH, BLOCKS
from tikernels.unwrapping import PatchGraph
from tikernels.unwrapping.surface_borders import Borders
from tikernels.unwrapping.tables import CELL_HEIGHT, CELL_WIDTH

CODES = ("contrast", "contrast2")
WIDTH = 640


def grid(rows, columns):
    """Return the graph of one region of whole patches side by side, the surface going on over all borders."""
    number = np.arange(rows * columns).reshape(rows, columns)
    along = np.stack([number[:, :-1].ravel(), number[:, 1:].ravel()])
    down = np.stack([number[:-1].ravel(), number[1:].ravel()])
    ends = np.concatenate([along, down], axis=1)
    y, x = np.divmod(number.ravel(), columns)
    px = np.concatenate([np.full(along.shape[1], 16.0), np.full(down.shape[1], 8.0)])
    count = number.size
    borders = Borders(ends, y[ends[1]] - y[ends[0]], px, np.zeros(len(px)))
    return PatchGraph(
        root=np.zeros(count, np.int32),
        offset=y.astype(np.int32),
        pixels=np.full(count, 128, np.int32),
        first=(y * CELL_HEIGHT * WIDTH + x * CELL_WIDTH).astype(np.int32),
        ends=ends.astype(np.int32),
        votes=np.full(len(px), 300, np.int32),
        borders=borders,
    )


@cache
def code_and_columns(name):
    """Return a code, and where the simulated rig's camera looks."""
    geometry = simulated_rig((WIDTH, 480), code=name).geometry()
    return ContrastCode.of(geometry.pattern), StripeColumns(geometry, geometry.camera.rays(np.zeros(2)))


def reader_of(name, rows, columns, lacks, *, root=0, gamma=2.0, factor=0.0, noise=0.004, shift_px=0.0, seed=0):
    """Return the reader of the blocks of a grid that shows one cycle a patch, the first row's order 0.

    Parameters
    ----------
    name : {"contrast", "contrast2"}
        The code.
    rows, columns : int
        Of patches, each of which shows two blocks.
    lacks : (columns,) int
        Whole cycles that the orders of each column of patches lack to be absolute.
    root : (columns,) int
        The patch that stands for each column's part.
    gamma : float
        The projector's response.
    factor : (blocks,) float
        Logarithm of what the contrasts have beside the code's, blocks counted along the rows.
    noise : float
        Standard deviation of the contrasts' logarithm.
    shift_px : float
        By how many projector px the code lies further along the stripe than the reader is told.
    """
    y, block = np.divmod(np.arange(rows * columns * BLOCKS), columns * BLOCKS)
    x = block // BLOCKS
    lacks, root = np.broadcast_to(lacks, columns)[x], np.broadcast_to(root, columns)[x]
    place = np.stack([CELL_HEIGHT * (y + 0.5), BLOCK_WIDTH * (block + 0.5)], axis=1) - 0.5
    code, seen = code_and_columns(name)
    along, levels = np.zeros(len(y)), code.levels()
    if code.cell_px is not None:
        levels, along = code.levels(seen.block_px), column_at(seen.terms(place), y + lacks) + shift_px
    contrast = levels[GAMMAS.index(gamma), y + lacks, code.place_at(along)] + factor
    contrast = contrast + np.random.default_rng(seed).normal(0, noise, len(y))
    one = np.ones(len(y))
    held = np.arange(len(y)), y * columns + x, one, np.zeros(2)
    return CodeReader(Blocks(root, y, place, contrast, noise**2 * one, 100 * one, 0 * one, *held), code, seen)
