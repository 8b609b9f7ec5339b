"""A port that expects given bytes, one write after the other, and gives given bytes back."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

from hardware.link import Link


class AnsweringPort:
    """What `Link` uses of a pyserial port to read answers, which whoever writes adds to."""

    def __init__(self) -> None:
        self.is_open = True
        self.out_waiting = 0
        self._arrived = b""

    @property
    def in_waiting(self) -> int:
        """What a read would give at once."""
        return len(self._arrived)

    def read(self, size: int) -> bytes:
        """Give what has been answered up to now."""
        if not self._arrived:
            time.sleep(0.001)
        taken, self._arrived = self._arrived[:size], self._arrived[size:]
        return taken


class ScriptedPort(AnsweringPort):
    """A port that expects the exchanges of a script."""

    def __init__(self, exchanges: list[tuple[bytes, bytes]]) -> None:
        super().__init__()
        self.exchanges = exchanges

    def write(self, sent: bytes) -> int:
        """Take the next bytes of the script, and no others."""
        assert self.exchanges, f"{sent!r} was sent after the end of the script"
        expected, answer = self.exchanges.pop(0)
        assert sent == expected
        self._arrived += answer
        return len(sent)

    def reset_output_buffer(self) -> None:
        """Drop what was not sent: nothing."""

    def close(self) -> None:
        """Close it."""
        self.is_open = False


@contextmanager
def scripted(terminator: bytes, *exchanges: tuple[bytes, bytes], timeout_s: float = 0.05) -> Iterator[Link]:
    """Give a link over a script, which must be at its end at the end."""
    link = Link("loop://", terminator=terminator, timeout_s=timeout_s)
    link._port.close()
    port = ScriptedPort(list(exchanges))
    link._port = port
    link.settle = lambda _: Link.settle(link, 0.002)  # nothing comes late from a script
    yield link
    assert not port.exchanges, f"never sent: {port.exchanges}"
