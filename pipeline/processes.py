"""Processes that this one starts."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker


@contextmanager
def block_interrupts() -> Iterator[Callable[[], None]]:
    """Block Ctrl-C, so that processes which are started meanwhile never get it; this one gets it at the end.

    Threads and processes inherit the blocked signal from the thread that starts them, and keep it.

    Yields
    ------
    callable
        Unblocks Ctrl-C in this thread before the end of the block.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield lambda: None
        return
    # Python starts its resource tracker with the first process, and then unblocks Ctrl-C: so it is started before.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})

    def unblock() -> None:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)

    try:
        yield unblock
    finally:
        unblock()
