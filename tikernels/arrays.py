"""Types of the arrays that host functions take and return: NumPy's, or an ndarray of the kernel language."""

from typing import Any, Protocol, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

E = TypeVar("E", bound=np.generic)


class DeviceArray(Protocol[E]):
    """An ndarray of the kernel language, in the memory of the device that runs."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Length of each axis."""

    @property
    def element_type(self) -> object:
        """The kernel language's type of its elements."""

    def to_numpy(self) -> npt.NDArray[E]:
        """Return a copy on the host."""

    def from_numpy(self, values: npt.NDArray[E]) -> None:
        """Write the values of an array of the same shape and type."""

    def fill(self, value: float) -> None:
        """Write one value everywhere."""


#: Either kind, by its element type.
Array: TypeAlias = npt.NDArray[E] | DeviceArray[E]
F32: TypeAlias = Array[np.float32]
I32: TypeAlias = Array[np.int32]
U8: TypeAlias = Array[np.uint8]
#: A plane of a frame as it was stored.
Plane: TypeAlias = Array[np.uint8] | Array[np.uint16] | Array[np.float32]
#: A mask: kernels take uint8; NumPy's bool is viewed as it.
Mask: TypeAlias = Array[np.bool_] | Array[np.uint8]
#: A frame in any element type that cameras and files give.
LevelsImage: TypeAlias = npt.NDArray[np.uint8 | np.uint16 | np.float32] | DeviceArray[Any]
