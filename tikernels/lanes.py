"""Lanes: sixteen pixels of a row side by side, which a CPU loads, computes and stores at once.

Taichi's compiler takes an array's elements one by one: before every store it reads the array's address again, for it
cannot know that the last store has not changed it. Of an array of vectors it stores a whole one, if it is told to keep
vectors (`kernel(whole_vectors=True)`): what does little but load and store takes a fifth of its time, smoothing three
quarters, and machine code is made in a tenth. So where a row is a whole number of vectors, and begins where one may
begin, kernels see it as such:

    wide = in_vectors(phase, out)
    _smooth_kernel(wide)(as_lanes(phase, wide), as_lanes(out, wide))

and inside

    for t in range(height * lane_count(width)):
        y, place = lanes_at(t, width)
        values = load_lanes(phase, float_lanes, y, place, width, wide)
        for k in range(LANES): compute
        store_lanes(out, y, place, width, values, wide)

Other rows, and those of a GPU, are arrays of numbers, and copied one by one. Kernels that keep vectors must not use any
but lanes: small vectors, as of three channels, would be computed as such.
"""

from functools import cache
from typing import Any, TypeAlias

import numpy as np

from tikernels._taichi import Static, f32, i32, ti
from tikernels.arrays import F32, I32, U8

#: Pixels of a vector.
LANES = 16
#: Where a vector of sixteen float32 may begin: at a multiple of its size.
VECTOR_BYTES = 64

float_lanes, integer_lanes, byte_lanes = (ti.types.vector(LANES, kind) for kind in (ti.f32, ti.i32, ti.u8))
three_lanes = ti.types.vector(3 * LANES, ti.f32)


#: What a frame's pixels lie in.
Rows: TypeAlias = F32 | I32 | U8


@cache
def planes(wide: bool, kind: object = ti.f32, ndim: int = 2) -> Any:
    """Return the type of a kernel's argument (..., H, W), whose rows are vectors if it is wide."""
    return ti.types.ndarray(dtype=ti.types.vector(LANES, kind) if wide else kind, ndim=ndim)


def in_vectors(*arrays: Rows) -> bool:
    """Whether all rows of these (..., H, W) arrays are whole numbers of vectors; those of a GPU are not."""
    return all(
        isinstance(array, np.ndarray) and array.shape[-1] % LANES == 0 and array.ctypes.data % VECTOR_BYTES == 0
        for array in arrays
    )


def as_lanes(array: Rows, wide: bool) -> Rows:
    """Return a contiguous (..., H, W) array as (..., H, W / 16) of vectors, if it is to be wide; else as it is."""
    return array.reshape(*array.shape[:-1], -1, LANES) if wide and isinstance(array, np.ndarray) else array


@ti.func
def width_of(plane: Static, wide: Static) -> i32:
    """Return how many pixels the rows of a (H, W) argument have."""
    return plane.shape[1] * ti.static(LANES if wide else 1)


@ti.func
def lanes_at(number: i32, width: i32):
    """Return the row and the place in it, in vectors, of the vector with a number; rows have `lane_count` each."""
    columns = lane_count(width)
    row = number // columns
    return row, number - row * columns


@ti.func
def lane_count(width: i32) -> i32:
    """Return how many vectors a row of this many pixels has; the last one may reach beyond it."""
    return (width + LANES - 1) // LANES


@ti.func
def load_lanes(plane: Static, kind: Static, y: i32, place: i32, width: i32, wide: Static):
    """Return the pixels of a row at a place, counted in vectors of this kind; 0 beyond the row's end."""
    values = kind(0)
    if ti.static(wide):
        values = plane[y, place]
    else:
        for k in range(ti.min(LANES, width - place * LANES)):
            values[k] = plane[y, place * LANES + k]
    return values


@ti.func
def load_around(plane: Static, kind: Static, y: i32, place: i32, width: i32, beyond: f32, wide: Static):
    """Return the pixels of three vectors of a row, those at a place in the middle, as floats; `beyond` outside it."""
    before = load_lanes(plane, kind, y, ti.max(place - 1, 0), width, wide)
    here = load_lanes(plane, kind, y, place, width, wide)
    after = load_lanes(plane, kind, y, ti.min(place + 1, lane_count(width) - 1), width, wide)
    values = three_lanes(0.0)
    for k in range(LANES):
        values[k] = ti.select(place > 0, ti.cast(before[k], ti.f32), beyond)
        values[LANES + k] = ti.select(place * LANES + k < width, ti.cast(here[k], ti.f32), beyond)
        values[2 * LANES + k] = ti.select((place + 1) * LANES + k < width, ti.cast(after[k], ti.f32), beyond)
    return values


@ti.func
def load_lanes_of(planes: Static, number: i32, y: i32, place: i32, width: i32, wide: Static):
    """Return the pixels of a row of one of several planes of float32."""
    values = float_lanes(0.0)
    if ti.static(wide):
        values = planes[number, y, place]
    else:
        for k in range(ti.min(LANES, width - place * LANES)):
            values[k] = planes[number, y, place * LANES + k]
    return values


@ti.func
def store_lanes(plane: Static, y: i32, place: i32, width: i32, values: Static, wide: Static):
    """Write the pixels of a row at a place, counted in vectors, as far as the row goes on."""
    if ti.static(wide):
        plane[y, place] = values
    else:
        for k in range(ti.min(LANES, width - place * LANES)):
            plane[y, place * LANES + k] = values[k]


@ti.func
def store_lanes_of(planes: Static, number: i32, y: i32, place: i32, width: i32, values: Static, wide: Static):
    """Write the pixels of a row of one of several planes."""
    if ti.static(wide):
        planes[number, y, place] = values
    else:
        for k in range(ti.min(LANES, width - place * LANES)):
            planes[number, y, place * LANES + k] = values[k]
