"""The buffers that results lie in, and the pool that they come back to when nothing refers to them any more.

A fresh buffer costs the kernel a page fault every 4 KiB: 2.3 ms for a frame of 640x480, where the whole chain takes 19.
On the CPU the arrays that a user gets are the buffers themselves, and a slice of one may outlive its frame by hours; so
each array carries a lease as its base, which gives the memory back when the last array that looks at it is gone. On a
GPU users get copies, and buffers come back with the object that holds them.
"""

import weakref
from collections import defaultdict, deque
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from tikernels import runtime
from tikernels.arrays import F32, I32, U8, Array

# Sets of buffers that wait in the pool: a frame and the one before, in video. More would only hold memory.
_MOST_FREE = 2


@dataclass(frozen=True, eq=False)
class PhaseBuffers:
    """What is recovered of every pixel by itself; stripes along the rows."""

    phase: F32  # (H, W) rad, wrapped, smoothed; NO_PHASE outside the mask
    modulation: F32  # (H, W) grey levels
    precision: F32  # (H, W) 1 / rad^2, before smoothing


@dataclass(frozen=True, eq=False)
class SurfaceBuffers:
    """What its neighbours add: regions and whole cycles; stripes along the rows."""

    unwrapped: F32  # (H, W) rad; NaN outside the mask
    mask: U8  # (H, W)
    region: I32  # (H, W) from 1; 0: none
    points: F32 | None  # (H, W, 3) mm; None without a calibration


def clear_buffers(phases: PhaseBuffers, surface: SurfaceBuffers) -> None:
    """Write what a frame holds in which nothing is measured."""
    for buffer in (phases.phase, phases.precision, surface.unwrapped, surface.points):
        if buffer is not None:
            buffer.fill(np.nan)
    for zeros in (phases.modulation, surface.mask, surface.region):
        zeros.fill(0)


_DTYPES = {"mask": np.uint8, "region": np.int32}

G = TypeVar("G", PhaseBuffers, SurfaceBuffers)


class BufferPool:
    """Results' buffers of one image size, used again when nothing refers to them any more.

    Parameters
    ----------
    height, width : int
        Of the image with its stripes along the rows.
    """

    def __init__(self, height: int, width: int) -> None:
        self.shape = (height, width)
        self._free: defaultdict[str, deque[Array[Any]]] = defaultdict(lambda: deque(maxlen=_MOST_FREE))

    def phases(self) -> PhaseBuffers:
        """Return buffers that nobody else writes; their content is arbitrary."""
        return self._lend(PhaseBuffers, {part.name: self.shape for part in fields(PhaseBuffers)})

    def surface(self, *, points: bool) -> SurfaceBuffers:
        """Return buffers that nobody else writes; their content is arbitrary."""
        shapes: dict[str, tuple[int, ...]] = {name: self.shape for name in ("unwrapped", "mask", "region")}
        return self._lend(SurfaceBuffers, {**shapes, "points": (*self.shape, 3)} if points else shapes)

    def _lend(self, kind: type[G], shapes: dict[str, tuple[int, ...]]) -> G:
        memories, lent = {}, {}
        for name, shape in shapes.items():
            free = self._free[name]
            memory = free.pop() if free else runtime.empty(shape, _DTYPES.get(name, np.float32))
            memories[name] = lent[name] = memory
            if isinstance(memory, np.ndarray):
                lease = _Lease(memory)
                lent[name] = np.asarray(lease)
                _give_back_with(lease, memory, free)
        group = kind(**{part.name: lent.get(part.name) for part in fields(kind)})
        for name, memory in memories.items():
            if not isinstance(memory, np.ndarray):
                _give_back_with(group, memory, self._free[name])
        return group


class _Lease:
    """The base of the arrays that look at a pool's memory: it lives as long as the last of them."""

    def __init__(self, memory: npt.NDArray[Any]) -> None:
        self.__array_interface__ = memory.__array_interface__


def _give_back_with(owner: object, memory: Array[Any], free: deque[Array[Any]]) -> None:
    """Give memory back when its owner is gone; not when the program ends."""
    weakref.finalize(owner, free.append, memory).atexit = False
