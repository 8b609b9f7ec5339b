"""Ctrl-C at any moment, but never in the middle of what belongs together."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class Stopping:
    """Turn the first request to stop into a KeyboardInterrupt, and ignore others: everything is being closed by then.

    Ctrl-C, a request to terminate and a terminal that is closed are all the same to it.
    """

    def __init__(self) -> None:
        self.asked = False
        self._raised = self._shielded = self._closing = False

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Take the requests that come in here."""
        names = ["SIGINT", "SIGTERM"]
        # Windows has none; and nohup asks to go on when the terminal is closed.
        if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
            names.append("SIGHUP")
        before = {name: signal.signal(getattr(signal, name), self._take) for name in names}
        try:
            yield
        finally:
            for name, handler in before.items():
                signal.signal(getattr(signal, name), handler)

    @contextmanager
    def shield(self) -> Iterator[None]:
        """Let a request wait until what is in here is done."""
        self._shielded = True
        try:
            yield
        finally:
            self._shielded = False
        self.check()

    def check(self) -> None:
        """Stop if that was asked for, and nothing has come of it: libraries have lost a KeyboardInterrupt before.

        Raises
        ------
        KeyboardInterrupt
            It was asked for.
        """
        if self.asked and not self._closing:
            self._raised = True
            raise KeyboardInterrupt

    def ignore(self) -> None:
        """Ignore requests from now on: everything is being closed."""
        self._closing = True

    def _take(self, number: int, frame: FrameType | None) -> None:
        self.asked = True
        if not self._shielded and not self._raised:
            self.check()
