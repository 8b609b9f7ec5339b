"""An instrument at the other end of a line: a pseudo-terminal or a TCP port, its clock, and what can go wrong."""

import os
import selectors
import socket
import termios
import threading
import time
import tty
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from types import TracebackType
from typing import Self


@dataclass
class Burst:
    """A burst as it was started: times of the instrument's clock, s."""

    start_s: float
    period_s: float
    count: float
    outputs: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Delay and width of every output that is on, by its letter."""
    stopped_s: float = float("inf")

    def pulses(self, output: str, now_s: float) -> int:
        """Return how many pulses of an output have begun."""
        if output not in self.outputs:
            return 0
        until = min(now_s, self.stopped_s) - self.start_s - self.outputs[output][0]
        return 0 if until < 0 else int(min(until // self.period_s + 1, self.count))


class Emulator(ABC):
    """An instrument that answers lines. Subclasses give `answer`, `restart` and, where they have one, `TERMINATORS`.

    Parameters
    ----------
    network
        Serve one TCP client at a time at ``socket://127.0.0.1:...`` instead of a pseudo-terminal.
    speed
        Seconds of the instrument's clock in a second.

    The switches may be set at any time, from any thread.
    """

    TERMINATORS = b"\n"
    """Bytes that each end a command."""

    def __init__(self, *, network: bool = False, speed: float = 1.0) -> None:
        self.received: list[str] = []
        """Every command that came, in order."""
        self.silent = False
        """Reads, and says nothing."""
        self.stuck = False
        """Does not even read."""
        self.lost_commands = 0
        """How many of the next commands are lost on their way here."""
        self.lost_answers = 0
        """How many of the next answers are lost on their way back."""
        self.delay_s = 0.0
        """By how much every answer comes later."""
        self.late_answers: list[float] = []
        """By how much each of the next answers comes later."""
        self.before_answer = b""
        """Comes right before the next answer."""
        self.in_pieces = False
        """Answers come in two parts, with a pause between them."""
        self.babbling = False
        """Sends noise without an end."""
        self.baud: int | None = None
        """The one baud rate at which it is understood, both ways; None: any."""

        self._speed = speed
        self._clock_s = 0.0
        self._clock_set = time.monotonic()
        self._lock = threading.RLock()
        self._input = bytearray()
        self._output: list[tuple[float, bytes]] = []
        self._gone = False
        self._wake, self._woken = socket.socketpair()
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._woken, selectors.EVENT_READ)
        self._descriptors: list[int] = []
        self._server: socket.socket | None = None
        self._client: socket.socket | None = None
        if network:
            self._server = socket.create_server(("127.0.0.1", 0))
            self._selector.register(self._server, selectors.EVENT_READ)
            self.url = f"socket://127.0.0.1:{self._server.getsockname()[1]}"
        else:
            # The other end is kept open here too: without it nobody could close the port and open it again.
            self._descriptors = list(os.openpty())
            tty.setraw(self._descriptors[1])
            os.set_blocking(self._descriptors[0], False)
            self._selector.register(self._descriptors[0], selectors.EVENT_READ)
            self.url = os.ttyname(self._descriptors[1])
        self.restart()
        self._thread = threading.Thread(target=self._serve, name=type(self).__name__, daemon=True)
        self._thread.start()

    @abstractmethod
    def answer(self, line: str) -> list[str]:
        """Obey a command; return the lines that are said to it."""

    @abstractmethod
    def restart(self) -> None:
        """Switch off and on again: what it knows is back to what it is then."""

    @property
    def now(self) -> float:
        """Its own clock, s."""
        with self._lock:
            return self._clock_s + (time.monotonic() - self._clock_set) * self._speed

    @property
    def speed(self) -> float:
        """Seconds of its clock in a second."""
        return self._speed

    @speed.setter
    def speed(self, speed: float) -> None:
        with self._lock:
            self._clock_s, self._clock_set, self._speed = self.now, time.monotonic(), speed

    def say(self, text: bytes) -> None:
        """Send something unasked."""
        with self._lock:
            self._output.append((time.monotonic(), text))
        self._wake.send(b"!")

    def unplug(self) -> None:
        """Pull the cable."""
        with self._lock:
            if self._gone:
                return
            self._gone = True
        self._wake.send(b"!")
        self._thread.join()
        self._selector.close()
        for descriptor in self._descriptors:
            os.close(descriptor)
        for one in (self._client, self._server, self._wake, self._woken):
            if one is not None:
                one.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.unplug()

    def _serve(self) -> None:
        while not self._gone:
            for key, _ in self._selector.select(0.002 if self._output or self.babbling or self.stuck else 0.1):
                if key.fileobj is self._woken:
                    self._woken.recv(100)
                elif key.fileobj is self._server:
                    self._take_client()
                elif self.stuck:
                    time.sleep(0.002)
                else:
                    self._take(key.fileobj)
            with self._lock:
                if self.babbling:
                    self._write(b"\xf3\x80~")
                while self._output and self._output[0][0] <= time.monotonic():
                    self._write(self._output.pop(0)[1])

    def _take_client(self) -> None:
        assert self._server is not None
        client, _ = self._server.accept()
        if self._client is not None:
            self._selector.unregister(self._client)
            self._client.close()
        client.setblocking(False)
        self._client = client
        self._selector.register(client, selectors.EVENT_READ)

    def _take(self, source: object) -> None:
        try:
            arrived = source.recv(4096) if isinstance(source, socket.socket) else os.read(self._descriptors[0], 4096)
        except BlockingIOError:
            return
        except OSError:
            arrived = b""
        if not arrived and self._client is not None:
            self._selector.unregister(self._client)
            self._client.close()
            self._client = None
        with self._lock:
            if self._at_another_baud():
                arrived = _garbled(arrived)
            for byte in arrived:
                if byte not in self.TERMINATORS:
                    self._input.append(byte)
                    continue
                line = self._input.decode("latin-1").strip("\r\n")
                self._input.clear()
                self._obey(line)

    def _obey(self, line: str) -> None:
        if self.lost_commands:
            self.lost_commands -= 1
            return
        self.received.append(line)
        for said in self.answer(line):
            if self.silent:
                continue
            if self.lost_answers:
                self.lost_answers -= 1
                continue
            due = time.monotonic() + self.delay_s + (self.late_answers.pop(0) if self.late_answers else 0.0)
            if self._output:
                due = max(due, self._output[-1][0])  # they stay in their order
            text = self.before_answer + said.encode("latin-1") + b"\r\n"
            self.before_answer = b""
            if self.in_pieces:
                half = len(text) // 2
                self._output += [(due, text[:half]), (due + 0.01, text[half:])]
            else:
                self._output.append((due, text))

    def _at_another_baud(self) -> bool:
        if self.baud is None or not self._descriptors:
            return False
        return bool(termios.tcgetattr(self._descriptors[1])[5] != getattr(termios, f"B{self.baud}"))

    def _write(self, text: bytes) -> None:
        if self._at_another_baud():
            text = _garbled(text)
        try:
            if self._client is not None:
                self._client.sendall(text)
            elif self._descriptors:
                os.write(self._descriptors[0], text)
        except OSError:  # nobody listens, or nobody reads
            pass


def _garbled(text: bytes) -> bytes:
    return bytes(byte ^ 0xC5 for byte in text)
