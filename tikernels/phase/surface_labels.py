"""Label each place with the surface that it shows: the one whose matrix leaves the smallest residual.

At some phases two surfaces look alike: misfits (`surface_misfits.py`) are averaged over a few pixels, which keeps edges
sharp, and over a good part of a cycle. Pixels show what the places of the lattice around them do; they themselves are
compared only where these differ.
"""

from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from tikernels import runtime
from tikernels._taichi import F32Array1, F32Array3, I32Array2, U8Array2, f32, i32, ti, u1
from tikernels.arrays import F32, I32, U8
from tikernels.launching import kernel
from tikernels.phase.balance_window import SIGMA_ACROSS
from tikernels.phase.frame_statistics import FrameLevels
from tikernels.phase.phase_vector import SIGMAS, TINY
from tikernels.phase.surface_misfits import (
    AT_ONCE,
    CELL_ROWS,
    MOST_MISFIT,
    SAYS_NOTHING,
    UNEVEN,
    Lattice,
    NeutralLight,
    cells_of,
    fill_residuals,
    place_lanes,
)
from tikernels.phase.surfaces import NO_SURFACE

_Misfits = npt.NDArray[np.float32]
_Labels = npt.NDArray[np.uint8]
_Mask = npt.NDArray[np.bool_]

# So many pixels on either side of a strip of sixteen are averaged with it.
_BESIDE = 4
_wide_lanes = ti.types.vector(AT_ONCE + 2 * _BESIDE, ti.f32)
cell_lanes = ti.types.matrix(CELL_ROWS, AT_ONCE, ti.f32)
# Gaussians that misfits are averaged over: px across the stripes, and along them where pixels are compared; cycles, and
# how much that one counts.
_NEAR_PX, _ALONG_PX = 1.6, 2.0
_AROUND_CYCLES, _AROUND = 0.4, 0.5
_ALONE = np.ones(1)
# A place that fits no surface counts no more than this against its neighbourhood.
_MOST_AROUND = 4.0
# So far from an edge between two places pixels are compared, px.
_EDGE_PX = 4
# By how much better than any other a surface must explain its places, in variances.
_BETTER = 0.3
# A surface of fewer pixels is none.
LEAST_PX = 400
# No surface explains a place with a larger misfit, or a neighbourhood with one larger than this, also in units of what
# is usual in the frame.
_UNEXPLAINED, _UNEXPLAINED_AROUND, _UNUSUAL = 3.0, 1.4, 1.6
# What is left of unexplained places after an opening by this counts, px; of neighbourhoods, in cycles.
_OPENING_PX, _OPENING_CYCLES = 7, 1.0


class Relabelled(NamedTuple):
    """The surface that each place shows, once misfits have been compared."""

    labels: _Labels
    """(h, w) new numbers; NO_SURFACE stays."""
    kept: list[int]
    """Previous surfaces that have those numbers."""
    unexplained: _Mask
    """(h, w) places that fit none."""
    around: _Misfits
    """(n, h, w) the misfits of what was kept, averaged over a good part of a cycle."""


def relabel(
    lattice: Lattice,
    misfits: _Misfits,
    before: _Labels,
    founding: _Mask,
    alike: _Mask,
    *,
    afresh: bool = False,
) -> Relabelled:
    """Give every place to the surface that fits it best, and drop surfaces that none needs.

    Parameters
    ----------
    lattice : Lattice
        The places.
    misfits : (N, h, w) float32
        Squares of residuals, at most `MOST_MISFIT`; -1 where a place has no evidence.
    before : (h, w) uint8
        The surfaces that places are taken to show so far.
    founding : (N,) bool
        True for those that the frame began with: none that came later takes the place of one.
    alike : (N,) bool
        True for those that are the same paint as another one: they go.
    afresh : bool
        True if only NO_SURFACE is known of what places showed before.
    """
    shown = before != NO_SURFACE
    said = (misfits[0] >= 0) & shown
    averages, around = _averaged(lattice, misfits, said)
    if afresh:
        before = np.where(shown, averages.argmin(axis=0), NO_SURFACE).astype(np.uint8)
    kept = list(range(len(misfits)))
    own = (np.where(said, before, NO_SURFACE).ravel() == np.arange(len(misfits))[:, None]).astype(np.float32)
    sizes = own.sum(axis=1)
    means = (own @ averages.reshape(len(misfits), -1).T) / np.maximum(sizes, 1)[:, None]
    for k in sorted(kept, key=lambda k: (bool(founding[k]), sizes[k])):
        others = [j for j in kept if j != k]
        rivals = [j for j in others if founding[j] or not founding[k]]
        if others and sizes[k] == 0:
            kept = others
        elif rivals and (alike[k] or means[k, rivals].min() - means[k, k] < _BETTER):
            kept = others
    nearest = np.asarray(kept)[averages[kept].argmin(axis=0)]
    while True:
        sizes = np.bincount(nearest[said], minlength=len(misfits))[kept]
        if len(kept) == 1 or sizes.min() >= LEAST_PX / lattice.pixels:
            break
        left = nearest == kept.pop(int(sizes.argmin()))
        nearest[left] = np.asarray(kept)[averages[:, left][kept].argmin(axis=0)]
    numbers = np.zeros(len(misfits), np.uint8)
    numbers[kept] = np.arange(len(kept))
    labels = np.where(shown, numbers[nearest], NO_SURFACE).astype(np.uint8)
    least, own_misfit = (np.take_along_axis(values, nearest[None], 0)[0] for values in (averages, misfits))
    unexplained = _opened(said & (least > _UNEXPLAINED), lattice.square(_OPENING_PX))
    wide = lattice.square(_OPENING_CYCLES * lattice.period_px)
    unexplained |= _opened(_unusual_neighbourhoods(lattice, own_misfit, said), wide)
    return Relabelled(labels, kept, unexplained, around[kept])


def _averaged(lattice: Lattice, misfits: _Misfits, said: _Mask) -> tuple[_Misfits, _Misfits]:
    """Average every surface's misfits over a few pixels and a part of a cycle, and over the latter alone."""
    sigma, weight = _AROUND_CYCLES * lattice.period_px, said.astype(np.float32)
    near = cv2.getGaussianKernel(2 * int(SIGMAS * _NEAR_PX / lattice.rows) + 1, _NEAR_PX / lattice.rows)
    near_share = np.maximum(cv2.sepFilter2D(weight, -1, _ALONE, near), TINY)
    wide_share = np.maximum(lattice.blurred(weight, sigma), TINY)
    averages, wide = np.empty_like(misfits), np.empty_like(misfits)
    for surface, misfit in enumerate(misfits):
        counted = np.where(said, misfit, np.float32(0))
        wide[surface] = lattice.blurred(counted, sigma) / wide_share
        averages[surface] = cv2.sepFilter2D(counted, -1, _ALONE, near) / near_share + _AROUND * wide[surface]
    averages /= 1 + _AROUND
    return averages, wide


def _unusual_neighbourhoods(lattice: Lattice, misfit: _Misfits, said: _Mask) -> _Mask:
    """Return where the misfit of places to their own surfaces is larger than elsewhere, cycle by cycle."""
    sigma = SIGMA_ACROSS * lattice.period_px
    share = lattice.blurred(said, sigma)
    mean = lattice.blurred(np.where(said, np.minimum(misfit, _MOST_AROUND), 0), sigma) / np.maximum(share, 0.1)
    whole = mean[share > 0.5]
    usual = float(np.partition(whole, len(whole) // 2)[len(whole) // 2]) if len(whole) else 1.0
    return np.asarray(said & (mean > max(_UNEXPLAINED_AROUND, _UNUSUAL * usual)))


def _opened(mask: _Mask, square: npt.NDArray[np.uint8]) -> _Mask:
    return np.asarray(cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, square) > 0)


def cells_of_pixels(lattice: Lattice, labels: _Labels, size: tuple[int, int]) -> I32:
    """Return a bit for each surface that the pixels of a cell may show, where that are several; else 0.

    Parameters
    ----------
    lattice : Lattice
        The places.
    labels : (h, w) uint8
        Surfaces that these show.
    size : (int, int)
        The image's height and width, px.
    """
    bits = np.where(labels == NO_SURFACE, 0, 1 << labels.astype(np.int32)).astype(np.int32)
    for axis, reach in ((0, -(-_EDGE_PX // lattice.rows)), (1, -(-_EDGE_PX // lattice.columns))):
        bits = np.moveaxis(bits, axis, 0)
        near = bits.copy()
        for step in range(1, reach + 1):
            near[step:] |= bits[:-step]
            near[:-step] |= bits[step:]
        bits = np.moveaxis(near, 0, axis)
    rows, columns = (
        np.minimum(np.arange(cells) * side // step, places - 1)
        for cells, side, step, places in zip(
            cells_of(size), (CELL_ROWS, AT_ONCE), (lattice.rows, lattice.columns), labels.shape, strict=True
        )
    )
    cells = np.bitwise_or.reduceat(np.bitwise_or.reduceat(bits, rows, axis=0), columns, axis=1)
    return np.ascontiguousarray(np.where(cells & (cells - 1), cells, 0))


@ti.func
def place_at(values: F32Array3, surface: i32, v: f32, j: i32) -> f32:
    """Interpolate a surface's values between two rows of places, in a column."""
    row, column = ti.min(v, values.shape[1] - 1.0), ti.min(ti.max(j, 0), values.shape[2] - 1)
    i = ti.cast(row, ti.i32)
    upper = values[surface, i, column]
    return upper + (row - i) * (values[surface, ti.min(i + 1, values.shape[1] - 1), column] - upper)


@ti.func
def values_between(values: F32Array3, surface: i32, v: f32, x: i32, columns: i32):
    """Interpolate a surface's values between places, bilinearly, at sixteen pixels."""
    result, ramp = place_lanes(0.0), place_lanes(0.0)
    for k in range(AT_ONCE):
        ramp[k] = k
    first = (x + columns // 2) // columns
    right = place_at(values, surface, v, first - 1)
    for j in range(first, (x + AT_ONCE - 1 + columns // 2) // columns + 1):
        left = right
        right = place_at(values, surface, v, j)
        along = ramp - ti.cast(j * columns - columns // 2 - x, ti.f32)  # from the last place on
        result = ti.select(along < 0.0, result, left + (right - left) / columns * (along + 0.5))
    return result


@ti.func
def asks(cells: I32Array2, y: i32, strip: i32, surface: i32) -> u1:
    """Return whether a surface is compared at sixteen places of a row."""
    return (cells[y // CELL_ROWS, strip] >> surface) & 1 == 1


@ti.func
def row_misfits(misfits: F32Array3, cells: I32Array2, surface: i32, y: i32, strip: i32):
    """Load a surface's misfits of sixteen pixels and their neighbours; SAYS_NOTHING where it is not compared."""
    first, last = strip * AT_ONCE, misfits.shape[2] - 1
    before, after = ti.max(strip - 1, 0), ti.min(strip + 1, cells.shape[1] - 1)
    left = _wide_lanes(SAYS_NOTHING)
    if asks(cells, y, before, surface):
        for k in range(ti.min(_BESIDE, first)):
            left[_BESIDE - 1 - k] = misfits[surface, y, first - 1 - k]
    if asks(cells, y, strip, surface):
        for k in range(ti.min(AT_ONCE, last + 1 - first)):
            left[_BESIDE + k] = misfits[surface, y, first + k]
    if asks(cells, y, after, surface):
        for k in range(ti.min(_BESIDE, last + 1 - first - AT_ONCE)):
            left[_BESIDE + AT_ONCE + k] = misfits[surface, y, first + AT_ONCE + k]
    return left


@ti.func
def near_misfits(
    misfits: F32Array3, cells: I32Array2, near: F32Array1, along: F32Array1, surface: i32, i: i32, strip: i32
):
    """Return the squares of a surface's misfits around a cell's rows, averaged along the stripes, then across."""
    first, reach = i * CELL_ROWS, near.shape[0] - 1
    total, weight = (
        [place_lanes(0.0) for _ in ti.static(range(CELL_ROWS))],
        [place_lanes(TINY) for _ in ti.static(range(CELL_ROWS))],
    )
    for v in range(ti.max(first - reach, 0), ti.min(first + CELL_ROWS + reach, misfits.shape[1])):
        left, part = row_misfits(misfits, cells, surface, v, strip), place_lanes(0.0)
        sums, counts = place_lanes(0.0), place_lanes(0.0)
        for u in ti.static(range(2 * _BESIDE + 1)):
            for k in range(AT_ONCE):
                part[k] = left[k + u]
            share = ti.select(part > SAYS_NOTHING, along[ti.abs(u - _BESIDE)], 0.0)
            sums += share * ti.min(part * part, MOST_MISFIT)
            counts += share
        for row in ti.static(range(CELL_ROWS)):
            distance = ti.abs(v - first - row)
            if distance <= reach:
                total[row] += near[distance] * sums
                weight[row] += near[distance] * counts
    return [total[row] / weight[row] for row in ti.static(range(CELL_ROWS))]


@kernel(whole_vectors=True)
def choose_surfaces_kernel(
    misfits: F32Array3,  # (N, H, W) standard deviations of pixels; see `surface_residuals_kernel`
    around: F32Array3,  # (N, h, w) their squares' averages around places of the lattice
    cells: I32Array2,  # (H / 8 up, W / 16 up) a bit for each surface that is compared
    near: F32Array1,  # weights of pixels so far across the stripes
    along: F32Array1,  # and along them: _BESIDE + 1
    rows: i32,  # px between places
    columns: i32,
    labels: U8Array2,  # (H, W) changed where surfaces are compared, unless NO_SURFACE
):
    height, width, strips = labels.shape[0], labels.shape[1], cells.shape[1]
    for t in range(cells.shape[0] * strips):
        i, strip, first = t // strips, t % strips, t % strips * AT_ONCE
        if cells[i, strip] != 0:
            best = [place_lanes(-SAYS_NOTHING) for _ in ti.static(range(CELL_ROWS))]
            which = [place_lanes(0.0) for _ in ti.static(range(CELL_ROWS))]
            for surface in range(misfits.shape[0]):
                if (cells[i, strip] >> surface) & 1 == 1:
                    value = near_misfits(misfits, cells, near, along, surface, i, strip)
                    beyond = cell_lanes(0.0)
                    for row in range(CELL_ROWS):
                        between = values_between(around, surface, (i * CELL_ROWS + row) / rows, first, columns)
                        for k in range(AT_ONCE):
                            beyond[row, k] = between[k]
                    for row in ti.static(range(CELL_ROWS)):
                        misfit = value[row]
                        for k in range(AT_ONCE):
                            misfit[k] += _AROUND * beyond[row, k]
                        which[row] = ti.select(misfit < best[row], ti.cast(surface, ti.f32), which[row])
                        best[row] = ti.min(misfit, best[row])
            for row in ti.static(range(CELL_ROWS)):
                y = i * CELL_ROWS + row
                for k in range(ti.select(y < height, ti.min(AT_ONCE, width - first), 0)):
                    if ti.cast(labels[y, first + k], ti.i32) != NO_SURFACE:
                        labels[y, first + k] = ti.cast(which[row][k], ti.u8)


def choose_surfaces(
    light: F32,
    contrast: F32,
    cells: I32,
    neutral: NeutralLight,
    levels: FrameLevels,
    code_doubt: float,
    scatter: float,
    lattice: Lattice,
    around: _Misfits,
    out: U8,
) -> None:
    """Give every pixel of some cells to the surface that fits it best.

    Parameters
    ----------
    light, contrast : (H, W, 3), (H, W) float32
        Of single pixels; see `average_light`.
    cells : int32
        A bit for each surface that pixels of a cell of 8 x 16 may show; 0: its labels stay.
    neutral, levels, code_doubt, scatter, lattice
        See `surface_residuals` and `measure_scatter`.
    around : (N, h, w) float32
        See `Relabelled`.
    out : (H, W) uint8
        The labels; NO_SURFACE stays.
    """
    misfits = runtime.empty((len(neutral.unmixing), *(int(n) for n in contrast.shape)), np.float32)
    # A pixel does not show its cycle's contrast.
    even = float(np.hypot(code_doubt, UNEVEN))
    fill_residuals(light, contrast, cells, neutral, levels, 1, even, scatter, misfits)
    near, along = (
        np.exp(-0.5 * (np.arange(_BESIDE + 1) / sigma) ** 2).astype(np.float32) for sigma in (_NEAR_PX, _ALONG_PX)
    )
    choose_surfaces_kernel(misfits, around, cells, near, along, lattice.rows, lattice.columns, out)
