"""Read and write a part of a table: tables have a place for every pixel that may need one, and few are used.

On the CPU a table is a NumPy array, and its first columns are a look at it.
"""

import numpy as np
import numpy.typing as npt

from tikernels import runtime
from tikernels._taichi import I32Array1, I32Array2
from tikernels.arrays import I32
from tikernels.launching import kernel


@kernel
def copy_columns_kernel(
    table: I32Array2,  # (rows, columns)
    out: I32Array2,  # (rows, as many columns or fewer)
):
    for i in range(out.shape[0] * out.shape[1]):
        row, column = i // out.shape[1], i % out.shape[1]
        out[row, column] = table[row, column]


@kernel
def take_columns_kernel(
    table: I32Array2,  # (rows, columns)
    places: I32Array1,  # (N,) columns
    out: I32Array2,  # (rows, N)
):
    for i in range(out.shape[0] * out.shape[1]):
        row, column = i // out.shape[1], i % out.shape[1]
        out[row, column] = table[row, places[column]]


@kernel
def put_columns_kernel(
    columns: I32Array2,  # (rows, N)
    out: I32Array2,  # (rows, N columns or more)
):
    for i in range(columns.shape[0] * columns.shape[1]):
        row, column = i // columns.shape[1], i % columns.shape[1]
        out[row, column] = columns[row, column]


def first_columns(table: I32, count: int) -> npt.NDArray[np.int32]:
    """Return the first columns of a table: on the CPU a look at them, on a GPU a copy; see `put_columns`."""
    if isinstance(table, np.ndarray):
        return np.asarray(table[:, :count])
    columns = runtime.empty((int(table.shape[0]), max(count, 1)), np.int32)
    copy_columns_kernel(table, columns)
    return runtime.to_host(columns)[:, :count]  # synchronises


def put_columns(columns: npt.NDArray[np.int32], table: I32) -> None:
    """Write back what `first_columns` has read, changed or not."""
    if not isinstance(table, np.ndarray) and columns.size:
        put_columns_kernel(runtime.to_device(np.ascontiguousarray(columns)), table)


def columns_at(table: I32, places: npt.NDArray[np.integer]) -> npt.NDArray[np.int32]:
    """Return some columns of a table, (rows, N), as a copy."""
    if isinstance(table, np.ndarray):
        return np.asarray(table.take(places, axis=1))
    columns = runtime.empty((int(table.shape[0]), max(len(places), 1)), np.int32)
    if len(places):
        take_columns_kernel(table, runtime.to_device(places.astype(np.int32)), columns)
    return runtime.to_host(columns)[:, : len(places)]  # synchronises
