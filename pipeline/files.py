"""Complete files or none: a result appears under its name only when it is complete."""

import errno
import os
import secrets
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from pipeline.errors import OutputError

#: How the names of temporary files end, which stay if the program is killed.
LEFTOVER = ".part"
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
    errno.EFBIG: "files may not be as large there: choose another disk, or raise your limit (ulimit -f)",
    errno.EMFILE: "too many files are open: raise your limit (ulimit -n)",
}


def explain(error: OSError) -> str:
    """Return what is wrong with a place that cannot be written, and what to do."""
    return _ADVICE.get(error.errno or 0, error.strerror or str(error))


def write_atomically(path: str | Path, content: bytes | memoryview | Callable[[BinaryIO], None]) -> None:
    """Write a file through a temporary one in the same folder, so that nothing half-written stays.

    Parameters
    ----------
    path : str or Path
        The file to make or replace.
    content : bytes, memoryview or callable
        Its content, or a function that writes it to an open binary file.

    Raises
    ------
    OutputError
        If the folder is missing or not writable, or the disk is full.
    """
    try:
        replace_file(Path(path), content)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {explain(error)}") from error


def sync(*paths: Path) -> None:
    """Return when files, or the names in folders, are on the disk: they are there after a power cut.

    Raises
    ------
    OSError
        One is not there, or the disk refuses.
    """
    for path in paths:
        if path.is_dir() and os.name == "nt":
            continue  # Windows keeps its folders' names by itself, and opens none
        descriptor = os.open(path, os.O_RDWR if path.is_file() else os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def make_folder(path: Path) -> None:
    """Make a folder and those that it is in, as far as they are missing; their names are on the disk, too.

    Raises
    ------
    OSError
        It cannot be made.
    """
    missing = [folder for folder in (path, *path.parents) if not folder.exists()]
    path.mkdir(parents=True, exist_ok=True)
    sync(*(folder.parent for folder in reversed(missing)))


def replace_file(path: Path, content: bytes | memoryview | Callable[[BinaryIO], None], *, safe: bool = False) -> None:
    """Write a file through a temporary one in the same folder; see `write_atomically`.

    Parameters
    ----------
    path : Path
        The file to make or replace.
    content : bytes, memoryview or callable
        Its content, or a function that writes it to an open binary file.
    safe : bool
        True if its content is on the disk before it appears under its name, in case the power fails.

    Raises
    ------
    OSError
        It cannot be written.
    """
    temporary = path.with_name(f".{secrets.token_hex(8)}{LEFTOVER}")
    try:
        with temporary.open("xb") as file:
            if callable(content):
                content(file)
            else:
                file.write(content)
            if safe:
                file.flush()
                os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        # The folder itself may be unreachable: then nothing was left in it.
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise
