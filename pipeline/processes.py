"""Processes that we start."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker


@contextmanager
def deaf_children() -> Iterator[Callable[[], None]]:
    """Keep Ctrl-C from the processes that are started by threads which begin before `hear` is called."""
    if not hasattr(signal, "pthread_sigmask"):
        yield lambda: None
        return
    # Where the first process is started it would let Ctrl-C through again.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})

    def hear() -> None:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)

    try:
        yield hear
    finally:
        hear()
