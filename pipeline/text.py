"""Text from outside (names of files and instruments, tags of footage, messages) when it is printed; sizes in words."""

import re

# What moves the cursor, colours, rings or ends a line on a terminal (C0, C1, DEL, separators of lines), and what turns
# the order of the letters around (Unicode's bidirectional controls).
_CONTROLS = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028\u2029\u202a-\u202e\u2066-\u2069]")


def one_line(text: str) -> str:
    r"""Return a text as one line that any file and terminal can hold.

    Control characters are dropped, those that part words are blanks. A byte of a file's name that is not UTF-8, which
    Python keeps as a surrogate, is a question mark, as `ls` shows it.

    >>> one_line("m\udcfcller\n.png")
    'm?ller .png'
    """
    whole = text.encode("utf-8", "replace").decode()
    return _CONTROLS.sub(lambda control: " " if control[0].isspace() else "", whole)


def sizes_differ(what: str, size_px: tuple[int, ...], other: str, other_px: tuple[int, ...]) -> str:
    """Return the begin of a message about two sizes (width, height) in px that should be the same.

    >>> sizes_differ("frame", (480, 640), "the calibration is for", (640, 480))
    'frame is 480x640 but the calibration is for 640x480 (width x height, which are swapped)'
    """
    swapped = " (width x height, which are swapped)" if size_px == other_px[::-1] else ""
    return "{} is {}x{} but {} {}x{}{}".format(what, *size_px, other, *other_px, swapped)
