"""Find where in a region the code shows another offset than the region's: in windows, and in pieces of like brightness.

A patch alone shows little, so windows of several sizes are laid everywhere over the grid of cells. A surface that is
joined across a step of whole cycles is seldom a rectangle, but mostly brighter or darker than what is behind it: so the
pieces of cells that are connected above and below some levels of brightness are checked as well (the extremal regions
of J. Matas et al., Robust wide baseline stereo from maximally stable extremal regions, BMVC 2002). All blocks of a
window or a piece may be off alike, as those of another paint are; apart from that, the likelihood ratio of two offsets
determines which of them it shows.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from tikernels import runtime
from tikernels._taichi import (
    F32Array3,
    I32Array1,
    I32Array2,
    I32Array3,
    Static,
    Vec16Array3,
    f32,
    i32,
    ti,
    vec16,
)
from tikernels.lanes import whole_rows
from tikernels.launching import kernel
from tikernels.order_evidence.offset_labelling import LANES, OffsetEvidence
from tikernels.unwrapping.patches import one_thread_is_faster

# Levels of brightness, evenly spaced between these quantiles of the cells'.
_LEVELS, _FROM_TO = 8, (0.02, 0.98)
# Pieces of fewer cells than the smallest windows are not checked.
_LEAST_CELLS = 9


@kernel(whole_vectors=True)
def sum_tables_kernel(
    serial: Static,  # whether one thread does it
    patch: I32Array1,  # (P,) sorted by cell
    starts: I32Array1,  # (R * C + 1,) where each cell's begin
    columns: i32,  # C, of cells
    values: Vec16Array3,  # (P, groups, 2)
    out_table: Vec16Array3,  # ((R + 1) * (C + 1), groups, 2) sum of all cells before; 0 along the edges
):
    """Sum up the patches of a grid's cells above and to the left: four places of the table give a window's sum."""
    ti.loop_config(serialize=serial)
    for group, kind in ti.ndrange(values.shape[1], 2):
        for row in range((starts.shape[0] - 1) // columns):
            total = vec16(0.0)
            for column in range(columns):
                cell = row * columns + column
                for p in range(starts[cell], starts[cell + 1]):
                    total += values[patch[p], group, kind]
                here = (row + 1) * (columns + 1) + column + 1
                out_table[here, group, kind] = total + out_table[here - columns - 1, group, kind]


@ti.func
def window_sum(table: Static, corner: i32, below: i32, beside: i32, group: i32, kind: Static):
    """Return the sum of the cells between a place of a table, and those so far below it and to its right."""
    all_of = table[corner + below + beside, group, kind] - table[corner + below, group, kind]
    return all_of - table[corner + beside, group, kind] + table[corner, group, kind]


@ti.func
def window_remains(table: Static, scale: f32, corner: i32, below: i32, beside: i32, group: i32):
    """Return what is left of a window's squares where its blocks are all off alike."""
    depart = window_sum(table, corner, below, beside, group, 1)
    return window_sum(table, corner, below, beside, group, 0) - scale * depart * depart


@ti.func
def best_offset(table: Static, scale: f32, corner: i32, below: i32, beside: i32, offsets: i32, own: i32, now: f32):
    """Return which offset leaves least of a window's squares, and by how much less than the region's."""
    best, better = own, 0.0
    for group in range(table.shape[1]):
        remains = window_remains(table, scale, corner, below, beside, group)
        for k in ti.static(range(LANES)):
            if group * LANES + k < offsets and now - remains[k] > better:
                best, better = group * LANES + k, now - remains[k]
    return best, better


@kernel(whole_vectors=True)
def scan_windows_kernel(
    serial: Static,  # whether one thread does it
    windows: I32Array2,  # (W, 2) cells, rows by columns
    weights: F32Array3,  # ((R + 1) * (C + 1), 1, 1) table of what the blocks count
    table: Vec16Array3,  # ((R + 1) * (C + 1), groups, 2) of the patches' sums
    offsets: i32,  # how many there are
    own: i32,  # the region's
    common: f32,  # variance of what all blocks of a window may be off alike, in variances
    least: f32,  # where no offset can be better by more, none is looked at
    out_gain: F32Array3,  # (W, R, C) by how much another offset is better, in variances
    out_offset: I32Array3,  # (W, R, C) the best offset
):
    """Find for each window, by its first cell, which offset its blocks fit best, and by how much better than theirs."""
    ti.loop_config(serialize=serial)
    for row, column in ti.ndrange(out_gain.shape[1], out_gain.shape[2]):
        for w in range(windows.shape[0]):
            best, better = own, 0.0
            # Large ones are laid wider apart.
            high, wide = windows[w, 0], windows[w, 1]
            steps = row % ti.max(high // 4, 1) + column % ti.max(wide // 4, 1)
            if steps == 0 and row + high <= out_gain.shape[1] and column + wide <= out_gain.shape[2]:
                line = out_gain.shape[2] + 1
                corner, below = row * line + column, high * line
                scale = 1 / (window_sum(weights, corner, below, wide, 0, 0) + 1 / common)
                remains = window_remains(table, scale, corner, below, wide, own // LANES)
                now = 0.0
                for k in ti.static(range(LANES)):
                    now += ti.select(k == own % LANES, remains[k], 0.0)
                if now > least:
                    best, better = best_offset(table, scale, corner, below, wide, offsets, own, now)
            out_gain[w, row, column] = better
            out_offset[w, row, column] = best


class Cells(NamedTuple):
    """Places of a region's patches in the image's grid of cells, counted from the region's first ones."""

    row: npt.NDArray[np.int64]
    """(P,)"""
    column: npt.NDArray[np.int64]
    """(P,)"""
    rows: int
    columns: int

    @classmethod
    def of(cls, row: npt.NDArray[np.integer], column: npt.NDArray[np.integer]) -> "Cells":
        """Count rows and columns of the image's grid from the region's first ones."""
        row, column = (np.asarray(place - place.min(), np.int64) for place in (row, column))
        return cls(row, column, int(row.max()) + 1, int(column.max()) + 1)

    @property
    def number(self) -> npt.NDArray[np.int64]:
        """(P,) number of each patch's cell, row by row."""
        return self.row * self.columns + self.column


class _Found(NamedTuple):
    """Windows or pieces: their cells, the offset that they show, and by how much it is better than the region's."""

    cells: Sequence[tuple[slice, slice] | npt.NDArray[np.bool_]]
    offset: npt.NDArray[np.integer]
    gain: npt.NDArray[np.floating]


class _Rule(NamedTuple):
    """Conditions under which a window or a piece shows another offset; see `find_other_offsets`."""

    most_columns: float
    common: float
    least: float


def find_other_offsets(
    evidence: OffsetEvidence,
    cells: Cells,
    brightness: npt.NDArray[np.floating],
    own: int,
    windows: npt.NDArray[np.int32],
    *,
    most_columns: float,
    common: float,
    least: float,
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.float32]]:
    """Find windows and pieces whose blocks show another offset than the region's; of those that overlap the surest.

    Parameters
    ----------
    evidence : OffsetEvidence
        Of the patches.
    cells : Cells
        Their places.
    brightness : (P,) float
        The logarithm of their blocks' brightness, times as how much they count.
    own : int
        The region's offset, counted from the first one.
    windows : (W, 2) int32
        Rows and columns of cells.
    most_columns : float
        As how many columns of cells a row of them counts at most; inf if each shows symbols of its own.
    common : float
        Variance of what all blocks of a window may be off alike, in their own variances.
    least : float
        By how much the other offset must be better, in variances.

    Returns
    -------
    (P,) int64
        Number of each patch's window or piece, -1 without one.
    (K,) int64
        The offset that each of these shows, the surest first.
    (K,) float32
        By how much it is better, in variances.
    """
    rule = _Rule(most_columns, common, least)
    evidence = evidence._replace(sums=np.asarray(whole_rows(evidence.sums)[0][0]))
    scanned, pieces = _scan(evidence, cells, own, windows, rule), _pieces(evidence, cells, own, brightness, rule)
    places, gain = [*scanned.cells, *pieces.cells], np.append(scanned.gain, pieces.gain)
    taken = np.full((cells.rows, cells.columns), -1, np.int64)
    chosen: list[int] = []
    for k in np.argsort(-gain, kind="stable"):
        if (taken[places[k]] < 0).all():
            taken[places[k]] = len(chosen)
            chosen.append(k)
    offset = np.append(scanned.offset, pieces.offset)[chosen].astype(np.int64)
    return taken[cells.row, cells.column], offset, gain[chosen].astype(np.float32)


def _scan(evidence: OffsetEvidence, cells: Cells, own: int, windows: npt.NDArray[np.int32], rule: _Rule) -> _Found:
    """Lay windows everywhere."""
    rows, columns = cells.rows, cells.columns
    windows = np.minimum(windows, (rows, columns)).astype(np.int32)
    cell = cells.number
    sort = np.argsort(cell, kind="stable")
    starts = np.searchsorted(cell[sort], np.arange(rows * columns + 1))
    table = _sum_table(sort, starts, columns, evidence.sums)
    weights = np.zeros((rows + 1, columns + 1), np.float32)
    weights[1:, 1:] = np.bincount(cell, evidence.weight, rows * columns).reshape(rows, columns).cumsum(0).cumsum(1)
    gain = np.empty((len(windows), rows, columns), np.float32)
    offset = np.empty(gain.shape, np.int32)
    tables, numbers = (weights.reshape(-1, 1, 1), table), (evidence.offsets, own, rule.common, rule.least)
    scan_windows_kernel(one_thread_is_faster(len(sort)), windows, *tables, *numbers, gain, offset)
    gain *= np.minimum(1, rule.most_columns / windows[:, 1])[:, None, None]
    found = np.nonzero(gain > rule.least)
    high, wide = windows[found[0]].T
    places = [
        (slice(top, bottom), slice(left, right))
        for top, bottom, left, right in np.transpose([found[1], found[1] + high, found[2], found[2] + wide]).tolist()
    ]
    return _Found(places, offset[found], gain[found])


def _sum_table(
    patch: npt.NDArray[np.integer], starts: npt.NDArray[np.integer], columns: int, values: npt.NDArray[np.float32]
) -> npt.NDArray[np.float32]:
    """Return a table of sums of patches' values (P, groups, 2, LANES); see `sum_tables_kernel`."""
    shape = ((len(starts) - 1) // columns + 1, columns + 1, *values.shape[1:])
    table = runtime.empty_on_host(shape, np.float32)
    table[0] = table[:, 0] = 0
    places, table = (patch.astype(np.int32), starts.astype(np.int32)), table.reshape(-1, *values.shape[1:])
    sum_tables_kernel(one_thread_is_faster(len(patch)), *places, columns, values, table)
    return table


def _pieces(
    evidence: OffsetEvidence, cells: Cells, own: int, brightness: npt.NDArray[np.floating], rule: _Rule
) -> _Found:
    """Ask the pieces above and below levels of brightness. Of more than half of the cells the region has its offset."""
    cell, rows, columns = cells.number, cells.rows, cells.columns
    weight = np.bincount(cell, evidence.weight, rows * columns)
    seen = np.flatnonzero(weight)
    bright = np.full(rows * columns, np.nan, np.float32)
    bright[seen] = np.bincount(cell, brightness, rows * columns)[seen] / weight[seen]
    ends = [round(share * (len(seen) - 1)) for share in _FROM_TO]
    darkest, brightest = np.partition(bright[seen], ends)[ends]
    levels = np.linspace(darkest, brightest, _LEVELS + 2)[1:-1, None]
    # One below the other, with a row between them.
    sides = np.zeros((2 * _LEVELS, rows + 1, columns), np.uint8)
    sides[:, :rows] = np.concatenate([bright > levels, bright < levels]).reshape(-1, rows, columns)
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(sides.reshape(-1, columns), connectivity=4)
    labels = labels.reshape(sides.shape)[:, :rows]
    size = boxes[:, cv2.CC_STAT_AREA]
    asked = (size >= _LEAST_CELLS) & (2 * size < len(seen))
    asked[0] = False  # what lies on the other side of the levels
    of_patch = labels.reshape(len(labels), -1).take(cell, axis=1).ravel()
    held = np.flatnonzero(asked[of_patch])
    if len(held) == 0:
        return _Found([], np.zeros(0, np.int64), np.zeros(0, np.float32))
    held = held[np.argsort(of_patch[held], kind="stable")]
    starts = np.flatnonzero(np.diff(of_patch[held], prepend=-1))
    number, patch = of_patch[held[starts]], held % len(cell)
    # As a row of cells, whose table adds up.
    table = _sum_table(patch, np.append(starts, len(held)), len(starts), evidence.sums)
    of_pieces = np.diff(table[len(starts) + 1 :], axis=0)
    squares, departs = np.moveaxis(of_pieces, 2, 0).reshape(2, len(starts), -1)
    weights = np.add.reduceat(evidence.weight[patch], starts)[:, None]
    remains = (squares - departs**2 / (weights + 1 / rule.common))[:, : evidence.offsets]
    best = remains.argmin(axis=1)
    gain = remains[:, own] - remains.min(axis=1)
    gain *= np.minimum(1, rule.most_columns * boxes[number, cv2.CC_STAT_HEIGHT] / size[number])
    shown = np.flatnonzero(gain > rule.least)
    of_shown = number[shown]
    places = [labels[k] == n for k, n in zip(boxes[of_shown, cv2.CC_STAT_TOP] // (rows + 1), of_shown, strict=True)]
    return _Found(places, best[shown], gain[shown])
