"""Whole files or none: a result appears under its name only when it is complete."""

import errno
import os
import secrets
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from pipeline.errors import OutputError

_ADVICE = {
    errno.ENOENT: "its folder does not exist: create the folder first",
    errno.ENOTDIR: "its folder is a file: choose another folder",
    errno.EEXIST: "its folder is a file: choose another folder",
    errno.EISDIR: "it is a folder: name a file in it",
    errno.EACCES: "the folder is not writable: choose another one",
    errno.EPERM: "the folder is not writable: choose another one",
    errno.EROFS: "the disk is read-only: choose another folder",
    errno.ENOSPC: "the disk is full: free some space",
    errno.EDQUOT: "your disk quota is used up: free some space",
}


def explain(error: OSError) -> str:
    """Return what is wrong with a place that cannot be written, and what to do."""
    return _ADVICE.get(error.errno or 0, error.strerror or str(error))


def write_atomically(path: str | Path, content: bytes | Callable[[BinaryIO], None]) -> None:
    """Write a file through a temporary one in the same folder, so that nothing half-written stays.

    Parameters
    ----------
    path : str or Path
        The file to make or replace.
    content : bytes or callable
        What it holds, or a function that writes it to an open binary file.

    Raises
    ------
    OutputError
        If the folder is missing or not writable, or the disk is full.
    """
    path = Path(path)
    temporary = path.with_name(f".{secrets.token_hex(8)}.part")
    try:
        with temporary.open("xb") as file:
            if callable(content):
                content(file)
            else:
                file.write(content)
        os.replace(temporary, path)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {explain(error)}") from error
    finally:
        # After an error the folder itself may be unreachable: then nothing was left in it.
        try:
            temporary.unlink(missing_ok=True)
        except OSError:
            pass
