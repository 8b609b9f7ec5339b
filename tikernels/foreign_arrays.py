"""Arrays of other libraries: what lies in the host's memory is taken without a copy, by the DLPack protocol.

PyTorch, JAX, TensorFlow, CuPy and others speak it (Python array API standard 2022.12, `__dlpack__`). Results are NumPy
arrays, which speak it too: `torch.from_dlpack(frame.unwrapped_phase)` looks at the same memory.
"""

import numpy as np
import numpy.typing as npt

from tikernels import runtime
from tikernels.errors import ShapeError

# DLPack's device types (dlpack.h, DLDeviceType): the host's memory, plain and pinned; and the names of others.
_HOST = {1, 3, 11}
_OTHERS = {2: "a CUDA GPU", 7: "a Vulkan GPU", 8: "a Metal GPU", 10: "a ROCm GPU", 13: "a CUDA GPU"}


def on_host(name: str, array: object) -> object:
    """Return an array of another library as a NumPy array that looks at the same memory; anything else as it is.

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
                # NumPy's stubs ask for more of the protocol than NumPy does.
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
