"""The compiled kernels that Taichi keeps on the disk: one process at a time reads or writes the list of them.

Taichi locks the list by a file next to it. Where another process holds that for longer than a quarter of a second, it
compiles all its kernels, which takes a minute, and keeps none; yet to write fifty of them takes as long. And the file
of a process that was killed meanwhile stays for ever. So processes take turns by a lock that ends with them, and what
one of them has left is removed.
"""

import contextlib
import os
import time
from collections.abc import Iterator

from tikernels._taichi import language, ti
from tikernels.file_lock import open_lock, take

# How long to wait for others, s: many times as long as any of them takes.
_PATIENCE_S = 10.0
# How often it is looked whether they are done, s.
_LOOK_S = 0.01


@contextlib.contextmanager
def list_locked() -> Iterator[None]:
    """Keep other processes from the list of compiled kernels; nothing is locked where the folder cannot be written."""
    if language != "taichi":
        yield
        return
    folder = os.environ.get("TI_OFFLINE_CACHE_FILE_PATH") or os.path.join(ti._lib.core.get_repo_dir(), "ticache")
    with contextlib.ExitStack() as held:
        with contextlib.suppress(OSError):
            os.makedirs(folder, exist_ok=True)
            file = open_lock(os.path.join(folder, "colorphase.lock"))
            held.callback(os.close, file)
            _take_in_time(file)
        _await_removal(os.path.join(folder, "ticache.lock"))
        yield


def _take_in_time(file: int) -> None:
    """Lock a file, or go on without where somebody has held it for too long."""
    end = time.monotonic() + _PATIENCE_S
    while time.monotonic() < end:
        try:
            return take(file)
        except OSError:
            time.sleep(_LOOK_S)


def _await_removal(path: str) -> None:
    """Wait until another program of Taichi's has removed its lock; one that is old was left by a killed process."""
    with contextlib.suppress(OSError):  # there is none, or it is another user's
        end = time.monotonic() + min(_PATIENCE_S, os.stat(path).st_mtime + _PATIENCE_S - time.time())
        while time.monotonic() < end:
            os.stat(path)
            time.sleep(_LOOK_S)
        os.remove(path)
