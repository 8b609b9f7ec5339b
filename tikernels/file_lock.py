"""A lock on an open file, which the system takes away from a program that dies."""

import os

if os.name == "nt":
    import msvcrt
else:
    import fcntl

# Windows locks bytes: one beyond what is written there, so that others can read the file.
_BYTE = 2**30


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
