"""Limits on the size of what is read: a small file can claim more than any machine holds."""

import codecs
import errno
import os
import re
import stat
from io import BufferedReader
from pathlib import Path

from pipeline.errors import FootageError, SettingsError

#: The environment variable by which users of larger cameras allow more.
MAX_PIXELS = "COLORPHASE_MAX_PIXELS"
ALLOW_MORE = f"set {MAX_PIXELS} to a larger number if your camera has that many"
# The largest colour cameras for machine vision have 65 megapixels; decoding one such frame takes 8 GB.
_MAX_PIXELS = 2**26
# Above this OpenCV reads no picture.
_MOST_PIXELS = 2**30
#: Bytes of a picture's file for each of its pixels, at most: four channels of float32, not compressed.
BYTES_A_PIXEL = 16
#: Frames of a recording or a result; a camera takes as many in a week, at 165 per second.
MOST_FRAMES = 10**8
# Of fewer frames than the second number a list of those that are missing is never too long; a recording that has lost
# as many as the first for each that is there is not worth one.
_MOST_MISSING, _FEW = 100, 10_000
# Opening waits for no other end of a pipe, makes no terminal ours, and changes no line ends.
_CAREFULLY = os.O_RDONLY | sum(getattr(os, name, 0) for name in ("O_NONBLOCK", "O_NOCTTY", "O_BINARY"))
#: Ten times a calibration with all that it can hold.
TEXT_BYTES = 2**20
# The largest float, written out, has 309.
_MOST_DIGITS = 400
_LONG_NUMBER = re.compile(rf"[0-9_]{{{_MOST_DIGITS + 1}}}")
# A calibration's keys are three deep. Of a.a.a... TOML's reader makes a table each: its time grows as their square.
_DEEP_KEY = re.compile(r"""(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){20}""")

# Byte order marks; one of UTF-32 begins like one of UTF-16.
_WIDE_MARKS = {
    "UTF-32": (codecs.BOM_UTF32_LE, codecs.BOM_UTF32_BE),
    "UTF-16": (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE),
}


def max_pixels() -> int:
    """Return how many pixels a frame may have.

    Raises
    ------
    SettingsError
        The environment variable holds no such number.
    """
    said = os.environ.get(MAX_PIXELS, "").strip()
    if not said:
        return _MAX_PIXELS
    if not re.fullmatch("[0-9]{1,10}", said) or not 0 < int(said) <= _MOST_PIXELS:
        raise SettingsError(f"{MAX_PIXELS} is {said[:40]!r}: give a number of pixels from 1 to {_MOST_PIXELS}")
    return int(said)


def ffmpeg_limits() -> dict[str, str]:
    """Return the options by which FFmpeg refuses frames that are larger than their file's head states.

    It counts whole blocks, which reach beyond a picture's edges, so it gets twice as many.
    """
    return {"max_pixels": str(2 * max_pixels())}


def check_size(what: str, width: int, height: int) -> None:
    """Check that a picture's size is one that a camera can have, before memory is taken for it.

    Raises
    ------
    FootageError
        It is not.
    """
    if width < 1 or height < 1:
        raise FootageError(f"{what} says that it has {width}x{height} px: copy it again")
    if width * height > max_pixels():
        raise FootageError(f"{what} has {width}x{height} px, and {max_pixels()} pixels are read at most: {ALLOW_MORE}")


def check_mesh_size(vertices: int, faces: int, repeated: int = 1) -> None:
    """Refuse meshes larger than a frame's: a pixel is a vertex, which may be repeated, and four make two triangles.

    Raises
    ------
    ValueError
        `max_pixels` allows fewer.
    """
    if vertices > repeated * max_pixels() or faces > 2 * max_pixels():
        raise ValueError(
            f"it has {vertices} vertices and {faces} faces, and {max_pixels()} pixels make fewer: {ALLOW_MORE}"
        )


def check_missing(what: str, n_frames: int, n_there: int) -> None:
    """Refuse footage that lacks nearly all of the frames that it claims to hold.

    Raises
    ------
    FootageError
        It does.
    """
    if n_frames > max(_FEW, _MOST_MISSING * (n_there + 1)):
        raise FootageError(f"{what} says that it holds {n_frames} frames, but {n_there} are there: copy it again")


def open_plain(path: str | Path) -> BufferedReader:
    """Open a file for reading; what has its name may come from anywhere.

    Raises
    ------
    OSError
        It cannot be opened, or is no plain file: a pipe or a device may never end.
    """
    _check_plain(os.stat(path))
    descriptor = os.open(path, _CAREFULLY)
    try:
        _check_plain(os.fstat(descriptor))
    except OSError:
        os.close(descriptor)
        raise
    return open(descriptor, "rb")


def _check_plain(about: os.stat_result) -> None:
    if stat.S_ISDIR(about.st_mode):
        raise IsADirectoryError(errno.EISDIR, "it is a folder: give a file")
    if not stat.S_ISREG(about.st_mode):
        raise OSError(errno.EINVAL, "it is no file")


def read_plain(path: str | Path, most_bytes: int) -> bytes:
    """Return what a file holds: the one way to read a complete file that others may have made.

    Raises
    ------
    OSError
        It cannot be read, is no plain file, is longer than allowed, or does not fit into memory.
    """
    with open_plain(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > most_bytes:
            raise OSError(errno.EOVERFLOW, f"it is larger than {most_bytes:,} bytes")
        try:
            if hasattr(os, "sysconf") and size > os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2:
                raise MemoryError
            return file.read(size)
        except MemoryError:
            raise OSError(errno.ENOMEM, f"its {size:,} bytes do not fit into memory") from None


def read_text(path: str | Path) -> str:
    """Return what a text file in UTF-8 holds, without a byte order mark.

    Raises
    ------
    OSError
        It cannot be read, or is longer than any file that a rig needs.
    ValueError
        It is no text, or in another encoding, or holds what takes its reader too long.
    """
    data = read_plain(path, TEXT_BYTES)
    for encoding, marks in _WIDE_MARKS.items():
        if data.startswith(marks):
            raise ValueError(f"it is text in {encoding}: save it as UTF-8")
    try:
        text = data.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError:
        raise ValueError("it is no text file in UTF-8: save it as that") from None
    if "\0" in text:
        raise ValueError("it is no text file, or text in UTF-16: save it as UTF-8")
    if _LONG_NUMBER.search(text):
        raise ValueError(f"a number in it has more than {_MOST_DIGITS} digits")
    if _DEEP_KEY.search(text):
        raise ValueError("its tables are nested too deep")
    return text
