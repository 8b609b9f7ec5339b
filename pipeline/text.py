"""Text from outside (names of files and instruments, tags of footage, messages), before it is printed or written."""

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
