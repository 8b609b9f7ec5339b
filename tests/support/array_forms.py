"""Arrays in every form in which host functions must take them."""

from typing import Any

import numpy as np
import numpy.typing as npt

from tikernels._taichi import ti


def every_second(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the same values, every second one of a larger array's."""
    larger = np.zeros((*array.shape[:-1], 2 * array.shape[-1]), array.dtype)
    larger[..., ::2] = array
    return larger[..., ::2]


def read_only(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return a copy that cannot be written."""
    copy = array.copy()
    copy.setflags(write=False)
    return copy


def on_device(array: npt.NDArray[Any]) -> Any:
    """Return the same values as an ndarray of the kernel language."""
    values = array.view(np.uint8) if array.dtype == np.bool_ else array
    kinds = {"float32": ti.f32, "int32": ti.i32, "uint8": ti.u8, "uint16": ti.u16}
    buffer = ti.ndarray(kinds[values.dtype.name], values.shape)
    buffer.from_numpy(np.ascontiguousarray(values))
    return buffer
