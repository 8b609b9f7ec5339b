"""The buffers of results, and the pool that they return to when nothing refers to them any more.

A fresh buffer costs the kernel a page fault every 4 KiB: 2.3 ms for a frame of 640x480, where the whole chain takes 19.
On the CPU the arrays that a user gets are the buffers themselves, and a slice of one may outlive its frame by hours; so
each array carries a lease as its base, which gives the memory back when the last array that refers to it is gone. On a
GPU users get copies, and buffers come back with the object that holds them.
"""

import weakref
from collections import defaultdict, deque
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from tikernels import runtime
from tikernels.arrays import F32, I32, U8, LevelsImage

# Sets of buffers that wait in the pool: a frame and the one before, in video. More would only hold memory.
_MOST_FREE = 2


@dataclass(frozen=True, eq=False)
class PhaseBuffers:
    """Results of every pixel by itself; stripes along the rows."""

    modulation: F32  # (H, W) grey levels
    precision: F32  # (H, W) 1 / rad^2, before smoothing
    variance: F32  # (H, W) rad^2, after smoothing
    misfit: F32  # (H, W) the square of what the model of the channels leaves over, over its variance


@dataclass(frozen=True, eq=False)
class SurfaceBuffers:
    """Results that depend on neighbours: regions and whole cycles; stripes along the rows."""

    unwrapped: F32  # (H, W) rad; NaN outside the mask
    mask: U8  # (H, W)
    region: I32  # (H, W) from 1; 0: none
    points: F32 | None  # (H, W, 3) mm; None without a calibration


_Free = defaultdict[str, deque[Any]]
G = TypeVar("G", PhaseBuffers, SurfaceBuffers)


def clear_buffers(phases: PhaseBuffers, surface: SurfaceBuffers) -> None:
    """Write the values of a frame in which nothing is measured."""
    for buffer in (phases.precision, surface.unwrapped, surface.points):
        if buffer is not None:
            buffer.fill(np.nan)
    for zeros in (phases.modulation, phases.variance, phases.misfit, surface.mask, surface.region):
        zeros.fill(0)


class BufferPool:
    """Results' buffers, used again when nothing refers to them any more."""

    def __init__(self) -> None:
        self._shape: tuple[int, int] | None = None
        self._free: _Free = defaultdict(lambda: deque(maxlen=_MOST_FREE))

    def lend(self, shape: tuple[int, int], *, points: bool) -> tuple[PhaseBuffers, SurfaceBuffers]:
        """Return buffers for exclusive use; their content is arbitrary.

        Parameters
        ----------
        shape : (height, width)
            Of the image with its stripes along the rows.
        points : bool
            True if there is room for points.
        """
        if shape != self._shape:
            self._shape = shape
            self._free.clear()  # frames come in one size, so what is left of another one is not needed again
        pixels, unwrapping = _Loan(self._free), _Loan(self._free)
        phases = PhaseBuffers(*(pixels.take(name, shape) for name in ("modulation", "precision", "variance", "misfit")))
        surface = SurfaceBuffers(
            unwrapping.take("unwrapped", shape),
            unwrapping.take("mask", shape, np.uint8),
            unwrapping.take("region", shape, np.int32),
            unwrapping.take("points", (*shape, 3)) if points else None,
        )
        return pixels.held_by(phases), unwrapping.held_by(surface)

    def keep(self, image: LevelsImage) -> LevelsImage:
        """Return a copy of a frame's image, of which the memory may change as soon as the frame is decoded."""
        host = runtime.to_host(image)
        loan = _Loan(self._free)
        copy: LevelsImage = loan.take(f"{host.dtype.name} image", host.shape, host.dtype.type)
        runtime.write(host, copy)
        return copy


class _Loan:
    """Memory on its way from the pool, and how it comes back."""

    def __init__(self, free: _Free) -> None:
        self._free = free
        self._on_device: list[tuple[deque[Any], Any]] = []

    def take(self, name: str, shape: tuple[int, ...], dtype: type[np.generic] = np.float32) -> Any:
        """Return memory that waits under a name, or fresh one."""
        free = self._free[name]
        memory = free.pop() if free else runtime.empty(shape, dtype)
        if not isinstance(memory, np.ndarray):
            self._on_device.append((free, memory))
            return memory
        lease = _Lease(memory)
        _give_back_with(lease, memory, free)
        return np.asarray(lease)

    def held_by(self, group: G) -> G:
        """Give memory of a GPU back when this object is gone."""
        for free, memory in self._on_device:
            _give_back_with(group, memory, free)
        return group


class _Lease:
    """The base of the arrays that refer to a pool's memory: it lives as long as the last of them."""

    def __init__(self, memory: npt.NDArray[Any]) -> None:
        self.__array_interface__ = memory.__array_interface__


def _give_back_with(owner: object, memory: Any, free: deque[Any]) -> None:
    """Give memory back when its owner is gone; not when the program ends."""
    weakref.finalize(owner, free.append, memory).atexit = False
