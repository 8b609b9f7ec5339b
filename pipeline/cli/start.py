"""Start of the program `colorphase`: Ctrl-C ends it at once, also while its modules are imported."""

import os
import signal
import sys
from contextlib import suppress

from pipeline import __version__


def main() -> None:
    """Import the command line, and run it.

    Meanwhile nothing is open and nothing is written, and Ctrl-C ends the program without a word: raised as an exception
    it would be lost in some of the libraries that are imported, or end in a traceback.
    """
    _fill_closed_streams()
    if sys.argv[1:] == ["--version"]:
        try:
            print(__version__, flush=True)
        except OSError as error:
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # what is left would be written at the end
            with suppress(OSError):  # past Python's buffer, which would be written at the end, too
                os.write(2, f"error: cannot write to standard output: {error.strerror}\n".encode())
            sys.exit(1)
        return
    before = signal.signal(signal.SIGINT, signal.SIG_DFL)
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"):
        os.environ.setdefault(name, "1")  # before NumPy comes: a second thread of its BLAS spins while it waits
    from pipeline.cli.main import main as command_line

    signal.signal(signal.SIGINT, before)
    command_line()


def _fill_closed_streams() -> None:
    """Open nothing in place of a standard stream that is closed: else the next file that is opened would be it.

    It can be read, and is at its end; writing fails, as it does where a disk is full.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.dup2(os.open(os.devnull, os.O_RDONLY), number)
            os.set_inheritable(number, True)
            stream = open(number, "w" if number else "r", closefd=False)
            for place in (name, f"__{name}__"):
                setattr(sys, place, stream)
