"""What FFmpeg says while it works: often the only trace of damage that a decoder conceals."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager

# How messages begin that FFmpeg calls errors, in streams that decode well.
_HARMLESS = ("mmco:", "co located POCs")
# Messages that nobody catches are not printed.
_SILENT = logging.NullHandler()


@contextmanager
def caught_messages() -> Iterator[list[str]]:
    """Catch the errors that FFmpeg reports in this thread; the list is filled when the block ends."""
    import av  # slow to import, and only needed here

    logging.getLogger("libav").addHandler(_SILENT)
    av.logging.set_level(av.logging.ERROR)
    av.logging.set_skip_repeated(False)
    caught: list[str] = []
    with av.logging.Capture() as messages:
        yield caught
    caught.extend(text.strip() for _, _, text in messages if not text.startswith(_HARMLESS))
