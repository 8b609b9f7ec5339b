"""The argument checks that Taichi does not make.

Taichi checks neither shapes across arguments nor whether a NumPy array may be written, and dies obscurely when no
device is started: every host function comes through here first. A frame makes some eighty of these checks, so what is
in order is found out without building names or texts: 1 us an array.
"""

from collections.abc import Sequence
from typing import TypeVar, cast

import numpy as np
import numpy.typing as npt

from tikernels import runtime
from tikernels.arrays import U8, Array, E, Mask
from tikernels.errors import ShapeError
from tikernels.launching import is_constant

# DLPack's device types (dlpack.h, DLDeviceType): the host's memory, plain and pinned; and the names of others.
_HOST = {1, 3, 11}
_OTHERS = {2: "a CUDA GPU", 7: "a Vulkan GPU", 8: "a Metal GPU", 10: "a ROCm GPU", 13: "a CUDA GPU"}

#: Any array, as a host function declares it.
A = TypeVar("A")


def read_array(name: str, array: A, shape: Sequence[int | None], *dtypes: type[np.generic]) -> A:
    """Return an input as kernels take it, after checking its shape (None: any length) and its dtype.

    Raises
    ------
    ShapeError
        The shape or dtype is another one.
    """
    arch = runtime.started()
    _check(name, array, shape, dtypes)
    if not isinstance(array, np.ndarray):
        return array
    contiguous = np.ascontiguousarray(array)
    # A GPU launch copies every NumPy argument back, which a read-only array does not survive.
    if arch != "cpu" and not contiguous.flags.writeable and not is_constant(contiguous):
        contiguous = contiguous.copy()
    return cast(A, contiguous)


def read_mask(name: str, mask: Mask, shape: Sequence[int | None]) -> U8:
    """Return a bool or uint8 mask as the uint8 array that kernels take.

    Raises
    ------
    ShapeError
        The shape or dtype is another one.
    """
    if isinstance(mask, np.ndarray) and mask.dtype == np.bool_:
        mask = mask.view(np.uint8)
    return cast(U8, read_array(name, mask, shape, np.uint8))


def out_array(name: str, out: Array[E] | None, shape: tuple[int, ...], dtype: type[E]) -> Array[E]:
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


def out_buffer(name: str, out: Array[E] | None, shape: tuple[int, ...], dtype: type[E]) -> Array[E]:
    """Return the caller's output buffer after checking it, or a fresh buffer of the device.

    Raises
    ------
    ShapeError
        The buffer has another shape or dtype, is not contiguous, or is read-only.
    """
    return runtime.empty(shape, dtype) if out is None else out_array(name, out, shape, dtype)


def on_host(name: str, array: object) -> object:
    """Return an array of another library as a NumPy array that looks at the same memory; anything else as it is.

    It is taken by the DLPack protocol (Python array API standard 2022.12, `__dlpack__`), which PyTorch, JAX,
    TensorFlow, CuPy and others support, and which NumPy arrays support, too:
    `torch.from_dlpack(frame.unwrapped_phase)` looks at the same memory.

    Raises
    ------
    ShapeError
        It lies on a device, or its elements are of a type that NumPy does not have.

    Examples
    --------
    >>> import numpy as np
    >>> class Tensor:
    ...     def __init__(self, values): self.values = values
    ...     def __dlpack__(self, **asked): return self.values.__dlpack__(**asked)
    ...     def __dlpack_device__(self): return self.values.__dlpack_device__()
    >>> values = np.arange(3)
    >>> bool(np.shares_memory(on_host("image", Tensor(values)), values))
    True
    """
    if isinstance(array, np.ndarray) or runtime.is_device_array(array):
        return array
    place = getattr(array, "__dlpack_device__", None)
    if place is not None:
        kind = int(place()[0])
        if kind in _HOST:
            try:
                # NumPy's stubs require more of the protocol than NumPy does.
                looked_at: npt.NDArray[np.generic] = np.from_dlpack(array)  # type: ignore[arg-type]
                return looked_at
            except (BufferError, TypeError, RuntimeError, ValueError) as error:
                raise ShapeError(f"{name} is a {type(array).__name__} that NumPy cannot look at: {error}") from error
        where = _OTHERS.get(kind, "a device")
    elif hasattr(array, "__cuda_array_interface__"):
        where = "a CUDA GPU"
    else:
        return array
    raise ShapeError(
        f"{name} lies on {where}, and is taken from the host's memory only: hand over array.cpu() of PyTorch, "
        "array.get() of CuPy, or numpy.asarray(array) of JAX"
    )


def element_type(array: Array[E]) -> type[E]:
    """Return NumPy's type of an array's elements."""
    return cast(type[E], np.dtype(runtime.dtype_name(array)).type)


def _check(name: str, array: object, shape: Sequence[int | None], dtypes: Sequence[type[np.generic]]) -> None:
    if isinstance(array, np.ndarray):
        got, right_type = array.shape, array.dtype in dtypes
    elif runtime.is_device_array(array):
        got, right_type = array.shape, runtime.has_dtype(array, dtypes)
    else:
        raise ShapeError(f"{name} is a {type(array).__name__}: pass a NumPy array or a Taichi ndarray")
    if got != shape and not _fits(got, shape):
        raise ShapeError(f"{name} has shape {_text(got)}, expected {_text(shape)}")
    if 0 in got:
        raise ShapeError(f"{name} is empty: its shape is {_text(got)}")
    if not right_type:
        names = " or ".join(np.dtype(dtype).name for dtype in dtypes)
        raise ShapeError(f"{name} is {runtime.dtype_name(array)}, expected {names}: convert it with .astype()")


def _fits(got: tuple[int, ...], shape: Sequence[int | None]) -> bool:
    if len(got) != len(shape):
        return False
    return all(want is None or n == want for n, want in zip(got, shape, strict=True))


def _text(shape: Sequence[int | None]) -> str:
    return "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
