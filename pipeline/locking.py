"""One writer at a time: a lock that names its holder, and that the system takes away from a program that dies."""

import getpass
import json
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from pipeline.errors import OutputError
from pipeline.files import explain
from tikernels.file_lock import open_lock, take

#: How the name of a lock's file ends.
LOCK = ".lock"
# More is not what we have written.
_MOST_BYTES = 1000


@contextmanager
def locked(target: Path) -> Iterator[None]:
    """Keep others from writing to a place; its folder must be there.

    The lock is held by an open file next to it, ``.NAME.lock``, so that nothing is locked any more once this program
    has ended, killed or not; what a killed one leaves is an unlocked file, which the next one takes over.

    Raises
    ------
    OutputError
        Somebody else writes there, the folder cannot be written, or something else has the lock's name.
    """
    path = target.with_name(f".{target.name}{LOCK}")
    file = _open_and_take(path, target)
    try:
        about = {"pid": os.getpid(), "host": socket.gethostname(), "since": time.strftime("%Y-%m-%d %H:%M:%S")}
        with suppress(OSError, KeyError, ImportError):  # some accounts have no name
            about["user"] = getpass.getuser()
        with suppress(OSError):  # the disk may be full: the lock holds all the same
            os.ftruncate(file, 0)
            os.lseek(file, 0, os.SEEK_SET)
            os.write(file, json.dumps(about).encode())
        yield
    finally:
        with suppress(OSError):
            path.unlink()  # while it is held: whoever has opened it meanwhile sees that it is gone
        os.close(file)


def _open_and_take(path: Path, target: Path) -> int:
    """Return the lock's file, open and locked."""
    while True:
        try:
            file = open_lock(path)
        except OSError as error:
            raise OutputError(f"cannot write {target}: {explain(error)}") from error
        try:
            take(file)
            if os.path.samestat(os.fstat(file), os.lstat(path)):
                return file
        except FileNotFoundError:
            pass
        except OSError:
            holder = _holder(file)
            os.close(file)
            raise OutputError(f"{target} is being written by another run{holder}: wait until it ends") from None
        # Its holder has just removed it.
        os.close(file)


def _holder(file: int) -> str:
    """Return the holder of a lock, as far as its file shows."""
    try:
        os.lseek(file, 0, os.SEEK_SET)
        about: Any = json.loads(os.read(file, _MOST_BYTES))
        return f" (process {about['pid']} on {about['host']}, since {about['since']})"
    except (OSError, ValueError, KeyError, TypeError):
        return ""
