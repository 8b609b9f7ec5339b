"""The argument checks that Taichi does not make.

Taichi checks neither shapes across arguments nor whether a NumPy array may be written, and dies obscurely when no
device is started: every host function comes through here first.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from tikernels import runtime
from tikernels.errors import ShapeError


def read_array(name: str, array: Any, shape: Sequence[int | None], *dtypes: npt.DTypeLike) -> Any:
    """Return an input as kernels take it, after checking its shape (None: any length) and its dtype.

    Raises
    ------
    ShapeError
        The shape or dtype is another one.
    """
    arch = runtime.started()
    _check(name, array, shape, dtypes)
    if isinstance(array, np.ndarray):
        array = np.ascontiguousarray(array)
        # A GPU launch copies every NumPy argument back, which a read-only array does not survive.
        if arch != "cpu" and not array.flags.writeable:
            array = array.copy()
    return array


def read_mask(name: str, mask: Any, shape: Sequence[int | None]) -> Any:
    """Return a bool or uint8 mask as the uint8 array that kernels take.

    Raises
    ------
    ShapeError
        The shape or dtype is another one.
    """
    if isinstance(mask, np.ndarray) and mask.dtype == np.bool_:
        mask = mask.view(np.uint8)
    return read_array(name, mask, shape, np.uint8)


def out_array(name: str, out: Any | None, shape: tuple[int, ...], dtype: npt.DTypeLike) -> Any:
    """Return the caller's output buffer after checking it, or a fresh NumPy array.

    Raises
    ------
    ShapeError
        The buffer has another shape or dtype, is not contiguous, or is read-only.
    """
    runtime.started()
    if out is None:
        return np.empty(shape, dtype)
    _check(name, out, shape, (dtype,))
    if isinstance(out, np.ndarray) and not (out.flags.writeable and out.flags.c_contiguous):
        raise ShapeError(f"{name} is read-only or not contiguous: pass an array that NumPy just allocated")
    return out


def out_buffer(name: str, out: Any | None, shape: tuple[int, ...], dtype: npt.DTypeLike) -> Any:
    """Return the caller's output buffer after checking it, or a fresh buffer of the device.

    Raises
    ------
    ShapeError
        The buffer has another shape or dtype, is not contiguous, or is read-only.
    """
    return runtime.empty(shape, dtype) if out is None else out_array(name, out, shape, dtype)


def dtype_name(array: Any) -> str:
    """Return the NumPy name of an array's element type."""
    return array.dtype.name if isinstance(array, np.ndarray) else runtime.dtype_name(array)


def _check(name: str, array: Any, shape: Sequence[int | None], dtypes: Sequence[npt.DTypeLike]) -> None:
    if not isinstance(array, np.ndarray) and not runtime.is_device_array(array):
        raise ShapeError(f"{name} is a {type(array).__name__}: pass a NumPy array or a Taichi ndarray")
    got = tuple(array.shape)
    if len(got) != len(shape) or any(want is not None and n != want for n, want in zip(got, shape, strict=False)):
        raise ShapeError(f"{name} has shape {_text(got)}, expected {_text(shape)}")
    if 0 in got:
        raise ShapeError(f"{name} is empty: its shape is {_text(got)}")
    dtype = dtype_name(array)
    names = [np.dtype(d).name for d in dtypes]
    if dtype not in names:
        raise ShapeError(f"{name} is {dtype}, expected {' or '.join(names)}: convert it with .astype()")


def _text(shape: Sequence[int | None]) -> str:
    return "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
