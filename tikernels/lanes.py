"""Lanes: sixteen pixels of a row side by side, which a CPU loads, computes and stores at once.

Taichi's compiler takes an array's elements one by one: before every store it reads the array's address again, for it
cannot know that the last store has not changed it. Of an array of vectors it stores a whole one, if it is set to keep
vectors (`kernel(whole_vectors=True)`): what does little but load and store takes a fifth of its time, smoothing three
quarters, and machine code is made in a tenth. So where a row is a whole number of vectors, and begins where one may
begin, kernels see it as such; others are copied:

    rows, wide = whole_rows(phase, out, beyond=NO_PHASE)
    _smooth_kernel(wide)(*(as_lanes(array, wide) for array in rows))
    put_back(rows[1], out)

and inside

    lanes = Lanes.of(wide)
    for t in range(height * lane_count(width, wide)):
        y, place = lanes_at(t, width, wide)
        values = load_lanes(phase, lanes.floats, y, place, width, wide)
        for k in range(lanes.count): compute
        store_lanes(out, y, place, width, values, wide)

or, in half of the time where a compiler does not know how wide the processor's vectors are, with whole vectors: sums,
products, quotients, `ti.min`, `ti.max`, `ti.sqrt`, `ti.floor` and `ti.select` take them, all else takes their numbers.

A GPU's rows are arrays of numbers, in strips (`strips.py`). Kernels that keep vectors must not use any but lanes: small
vectors, as of three channels, would be computed as such; lists of three lanes are not.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any, TypeAlias

import numpy as np

from tikernels._taichi import Static, f32, i32, ti
from tikernels.arrays import F32, I32, U8
from tikernels.traffic import traffic

#: Pixels of a vector.
LANES = 16
#: Where a vector of sixteen float32 may begin: at a multiple of its size.
VECTOR_BYTES = 64

# Pixels that a thread of a GPU works on: at least as many as a window reaches to either side.
_NUMBERS = 8
#: Sixteen numbers of samples, or of blocks of them.
float_lanes = ti.types.vector(LANES, ti.f32)

#: What a frame's pixels lie in.
Rows: TypeAlias = F32 | I32 | U8


@dataclass(frozen=True, eq=False)
class Lanes:
    """Pixels that a thread processes at once, for the kernel's factory: vectors of this many."""

    count: int
    floats: Any
    integers: Any
    bytes: Any
    three_floats: Any  # three times as many

    @classmethod
    @cache
    def of(cls, wide: bool) -> "Lanes":
        """Return them for rows of vectors, or of numbers."""
        count = _count(wide)
        floats, integers, of_bytes = (ti.types.vector(count, kind) for kind in (ti.f32, ti.i32, ti.u8))
        return cls(count, floats, integers, of_bytes, ti.types.vector(3 * count, ti.f32))


def _count(wide: bool) -> int:
    return LANES if wide else _NUMBERS


@cache
def planes(wide: bool, kind: object = ti.f32, ndim: int = 2) -> Any:
    """Return the type of a kernel's argument (..., H, W), whose rows are vectors if it is wide."""
    return ti.types.ndarray(dtype=ti.types.vector(LANES, kind) if wide else kind, ndim=ndim)


def in_vectors(*arrays: Rows) -> bool:
    """Return whether all rows of these (..., H, W) arrays are multiples of a vector; those of a GPU are not."""
    return all(
        isinstance(array, np.ndarray) and array.shape[-1] % LANES == 0 and array.ctypes.data % VECTOR_BYTES == 0
        for array in arrays
    )


def as_lanes(array: Rows, wide: bool) -> Rows:
    """Return a contiguous (..., H, W) array as (..., H, W / 16) of vectors, if it is to be wide; else as it is."""
    return array.reshape(*array.shape[:-1], -1, LANES) if wide and isinstance(array, np.ndarray) else array


def whole_rows(*arrays: Rows, beyond: float = 0) -> tuple[list[Rows], bool]:
    """Return planes whose rows are vectors, and whether they are: a GPU's are not.

    The CPU's that are not yet are copied to longer rows. Beyond their end there is 0, in the first array this value.
    """
    if traffic.on_device:
        return list(arrays), False
    return [_longer(array, 0 if n else beyond) for n, array in enumerate(arrays)], True


def _longer(array: Rows, beyond: float) -> Any:
    if in_vectors(array):
        return array
    values: Any = array if isinstance(array, np.ndarray) else array.to_numpy()
    width = values.shape[-1]
    size = values.nbytes // width * (-(-width // LANES) * LANES)
    memory = np.empty(size + VECTOR_BYTES, np.uint8)
    start = -memory.ctypes.data % VECTOR_BYTES
    rows = memory[start : start + size].view(values.dtype).reshape(*values.shape[:-1], -1)
    rows[..., :width], rows[..., width:] = values, beyond
    return rows


def put_back(rows: Rows, array: Rows) -> None:
    """Write what a kernel has written to `whole_rows` to the array that they were made of."""
    if rows is array or not isinstance(rows, np.ndarray):
        return
    written: Any = rows[..., : array.shape[-1]]
    if isinstance(array, np.ndarray):
        array[...] = written
    else:
        array.from_numpy(np.ascontiguousarray(written))


@ti.func
def width_of(plane: Static, wide: Static) -> i32:
    """Return how many pixels the rows of a (H, W) argument have."""
    return plane.shape[1] * ti.static(LANES if wide else 1)


@ti.func
def lanes_at(number: i32, width: i32, wide: Static):
    """Return the row and the place in it, in vectors, of the vector with a number; rows have `lane_count` each."""
    columns = lane_count(width, wide)
    row = number // columns
    return row, number - row * columns


@ti.func
def lane_count(width: i32, wide: Static) -> i32:
    """Return how many vectors a row of this many pixels has; the last one may reach beyond it."""
    count = ti.static(_count(wide))
    return (width + count - 1) // count


@ti.func
def load_lanes(plane: Static, kind: Static, y: i32, place: i32, width: i32, wide: Static):
    """Return the pixels of a row at a place, counted in vectors of this kind; 0 beyond the row's end."""
    values = kind(0)
    if ti.static(wide):
        values = plane[y, place]
    else:
        for k in range(ti.min(_NUMBERS, width - place * _NUMBERS)):
            values[k] = plane[y, place * _NUMBERS + k]
    return values


@ti.func
def load_around(plane: Static, kind: Static, y: i32, place: i32, width: i32, reach: Static, beyond: f32, wide: Static):
    """Return the pixels of three vectors of a row of floats, those at a place in the middle; `beyond` outside the row.

    Of those before and after, as many as are in reach of the middle; the kind is that of all three.
    """
    values, count = kind(0.0), ti.static(_count(wide))
    if ti.static(wide):
        before, here = plane[y, ti.max(place - 1, 0)], plane[y, place]
        after = plane[y, ti.min(place + 1, plane.shape[1] - 1)]
        for k in range(LANES):
            values[k] = ti.select(place > 0, before[k], beyond)
            values[count + k] = here[k]
            values[2 * count + k] = ti.select(place + 1 < plane.shape[1], after[k], beyond)
    else:
        first = (place - 1) * count
        for k in range(count - reach, 2 * count + reach):
            values[k] = beyond
        for k in range(ti.max(count - reach, -first), ti.min(2 * count + reach, width - first)):
            values[k] = plane[y, first + k]
    return values


@ti.func
def load_lanes_of(planes: Static, kind: Static, number: i32, y: i32, place: i32, width: i32, wide: Static):
    """Return the pixels of a row of one of several planes."""
    values = kind(0)
    if ti.static(wide):
        values = planes[number, y, place]
    else:
        for k in range(ti.min(_NUMBERS, width - place * _NUMBERS)):
            values[k] = planes[number, y, place * _NUMBERS + k]
    return values


@ti.func
def store_lanes(plane: Static, y: i32, place: i32, width: i32, values: Static, wide: Static):
    """Write the pixels of a row at a place, counted in vectors, as far as the row goes on."""
    if ti.static(wide):
        plane[y, place] = values
    else:
        for k in range(ti.min(_NUMBERS, width - place * _NUMBERS)):
            plane[y, place * _NUMBERS + k] = values[k]


@ti.func
def store_lanes_of(planes: Static, number: i32, y: i32, place: i32, width: i32, values: Static, wide: Static):
    """Write the pixels of a row of one of several planes."""
    if ti.static(wide):
        planes[number, y, place] = values
    else:
        for k in range(ti.min(_NUMBERS, width - place * _NUMBERS)):
            planes[number, y, place * _NUMBERS + k] = values[k]
