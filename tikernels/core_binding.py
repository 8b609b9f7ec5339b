"""Every thread of the CPU's kernels on a core of its own.

A kernel takes a fraction of a millisecond, each thread its share of it. A scheduler that wakes several of them on one
core and spreads them a few milliseconds later comes too late: on a virtual machine of two cores the kernels of a frame
took 23 ms with their threads bound, and 30 to 34 without.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager

from tikernels._taichi import ti


@contextmanager
def bound_to_cores() -> Iterator[None]:
    """Bind the threads that starting the CPU creates in the body, if there is one for every core of the process.

    With fewer, which cores they ought to leave to others is not known here, and they stay unbound; so they do where the
    operating system offers no binding.
    """
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = _threads()
    yield
    cores = sorted(os.sched_getaffinity(0))
    count = ti.lang.impl.current_cfg().cpu_max_num_threads
    # The compiler's threads are created before the kernels'.
    created = sorted(_threads() - before)[-count:]
    if not 1 < count == len(cores) == len(created):
        return
    for thread, core in zip(created, cores, strict=True):
        try:
            os.sched_setaffinity(thread, {core})
        except OSError:  # a core that has been taken away since, or a thread that has ended
            return


def _threads() -> set[int]:
    """Return the numbers of this process's threads."""
    return {int(name) for name in os.listdir("/proc/self/task")}
