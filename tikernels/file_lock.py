"""A lock on an open file, which the system takes away from a program that dies."""

import errno
import os
import stat

if os.name == "nt":
    import msvcrt
else:
    import fcntl

# Windows locks bytes: one beyond what is written there, so that others can read the file.
_BYTE = 2**30
# Neither follow a link nor wait for the other end of a pipe; Windows has neither flag.
_CAREFULLY = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)


def open_lock(path: str | os.PathLike[str]) -> int:
    """Open the file of a lock, or make it; a file of that name may be another user's.

    Returns
    -------
    int
        Its descriptor, for reading and writing.

    Raises
    ------
    OSError
        It cannot be opened, or it is a link, a pipe, a folder, or a file that has another name, too: to write who holds
        the lock would change something else.
    """
    other = OSError(errno.EINVAL, f"{os.path.basename(path)} there is a link or no plain file: remove it")
    try:
        if not stat.S_ISREG(os.lstat(path).st_mode):
            raise other
    except FileNotFoundError:
        pass
    file = os.open(path, os.O_RDWR | os.O_CREAT | _CAREFULLY, 0o666)
    about = os.fstat(file)
    if not stat.S_ISREG(about.st_mode) or about.st_nlink > 1:  # none: its holder has just removed it
        os.close(file)
        raise other
    return file


def take(file: int) -> None:
    """Lock an open file for this process alone, until it is closed.

    Parameters
    ----------
    file : int
        Its descriptor.

    Raises
    ------
    OSError
        Somebody else holds it.
    """
    if os.name == "nt":
        os.lseek(file, _BYTE, os.SEEK_SET)
        # Types know this module on Windows only.
        msvcrt.locking(file, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined,unused-ignore]
    else:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
