"""Steps and cycles of surfaces that show the contrast code, without a picture."""

import numpy as np
from pipeline.orders.contrast_cycles import Cycles, Steps

from pipeline.pattern import contrast_levels
from tikernels.unwrapping import PatchGraph
from tikernels.unwrapping.surface_borders import Borders

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
        first=(y * 16 * WIDTH + x * 8).astype(np.int32),
        ends=ends.astype(np.int32),
        votes=np.full(len(px), 300, np.int32),
        borders=borders,
    )


def shown(rows, columns, lacks, factor=0.0, noise=0.004, seed=0):
    """Return what a grid shows of one cycle a patch, the first row's order 0, and its columns' steps.

    lacks : (columns,) whole cycles that the orders of each column lack to be absolute.
    """
    rng = np.random.default_rng(seed)
    y, x = np.divmod(np.arange(rows * columns), columns)
    contrast = contrast_levels()[y + np.asarray(lacks)[x]] + factor + rng.normal(0, noise, y.shape)
    cycles = Cycles(np.arange(len(y)), y, np.ones(len(y)), contrast, np.full(len(y), 100.0))
    by_column = np.arange(len(y)).reshape(rows, columns)
    low, high = by_column[:-1].T.ravel(), by_column[1:].T.ravel()
    return cycles, Steps(low, high, y[low], contrast[high] - contrast[low], x[low], np.full(len(low), 100.0))
