"""The line to an instrument: a serial port of this machine, or one behind a network."""

import errno
import logging
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import serial
from serial.tools import list_ports

from hardware.errors import TriggerError

Failures: tuple[type[Exception], ...] = (OSError,)  # what an unplugged port raises; SerialException is one
try:
    import grp
    import termios

    Failures = (OSError, termios.error)
except ImportError:  # Windows has neither
    pass
Refusals: tuple[type[Exception], ...] = (*Failures, ValueError, OverflowError)  # what a port that does not open raises
_log = logging.getLogger("colorphase.link")

#: pyserial's other handlers write files, take any port that matches, or speak to something else.
SCHEMES = ("socket", "rfc2217", "loop")
#: Four times the longest line of the instruments that are supported; beyond it, it is noise or another device.
LONGEST_LINE = 1024
#: How long one read may wait: a deadline is kept to within it. Changing a port's timeout instead sets it up anew.
POLL_S = 0.02


@dataclass(frozen=True)
class SerialPort:
    """A serial port of this machine."""

    device: str
    description: str


def list_serial_ports() -> list[SerialPort]:
    """Return the serial ports that something is connected to, by name."""
    return [SerialPort(port.device, port.description) for port in sorted(list_ports.comports())]


class Link:
    """Lines of text to and from an instrument. Every method returns or raises within a deadline.

    Parameters
    ----------
    url
        A serial device, as /dev/ttyUSB0 or COM3, or ``socket://host:port``, ``rfc2217://host:port`` or ``loop://``.
    baud
        Bits per second; 8 bits, no parity, one stop bit, no flow control.
    terminator
        End of a line that is sent. A line that is received ends at its last byte; CR and LF around it are taken off.
    timeout_s
        Longest time for an answer, and for the port to refuse to take what is sent.
    error
        Raised on failure, a ConnectionError with one line that says what to do.
    """

    def __init__(
        self,
        url: str,
        *,
        baud: int = 115200,
        terminator: bytes = b"\n",
        timeout_s: float = 2.0,
        error: type[ConnectionError] = TriggerError,
    ) -> None:
        self.url = url
        self.timeout_s = timeout_s
        self.damaged = 0
        """Lines that were thrown away because they were too long or not printable ASCII."""
        self._error = error
        self._terminator = terminator
        self._arrived = bytearray()
        self._overlong = False  # the rest of a line that was too long is still to come
        self._port = self._opened(baud)

    def send(self, text: str) -> None:
        """Send a line; its terminator is added."""
        _log.debug("%s <- %s", self.url, text)
        with self._port_errors():
            self._port.write(text.encode("ascii") + self._terminator)

    def receive(self, timeout_s: float | None = None) -> str | None:
        """Return the next whole line without its end, or None where none came in time; a part of one is kept."""
        deadline = time.monotonic() + (self.timeout_s if timeout_s is None else timeout_s)
        while (line := self._next_line()) is None:
            late = time.monotonic() >= deadline
            self._read(wait=not late)
            if late:  # also where it never stops sending
                return self._next_line()
        return line

    def settle(self, quiet_s: float = 0.1) -> None:
        """Throw away what has come and what still comes, until nothing has come for `quiet_s`."""
        deadline = time.monotonic() + self.timeout_s + quiet_s
        quiet_until = time.monotonic() + quiet_s
        while (now := time.monotonic()) < quiet_until:
            if now >= deadline:
                raise self._error(f"{self.url} sends without a pause: check the port, and the instrument's baud rate")
            if self._read(wait=True):
                quiet_until = time.monotonic() + quiet_s
            self._arrived.clear()
        self._overlong = False

    def close(self) -> None:
        """Let go of the port; idempotent, and never raises."""
        if not self._port.is_open:
            return
        socket = getattr(self._port, "_socket", None)
        with suppress(*Failures, AttributeError):  # network ports have no out_waiting
            # The kernel waits for half a minute at the closing of a port that does not take its output.
            deadline = time.monotonic() + 0.5
            while self._port.out_waiting and time.monotonic() < deadline:
                time.sleep(0.005)
            self._port.reset_output_buffer()
        with suppress(*Failures):
            self._port.close()
        if socket is not None:  # pyserial leaves it open where the other side went first
            socket.close()

    def _next_line(self) -> str | None:
        """Take the next whole line from what arrived."""
        while True:
            line, end, rest = self._arrived.partition(self._terminator[-1:])
            text = line.strip(b"\r\n").decode("ascii", errors="replace")
            fits = not self._overlong and len(text) <= LONGEST_LINE
            if not end:
                if not fits:
                    self._arrived.clear()
                    self._overlong = True
                return None
            self._arrived = rest
            self._overlong = False
            if fits and text.isascii() and text.isprintable():
                _log.debug("%s -> %s", self.url, text)
                return text
            self.damaged += 1
            _log.debug("%s -> a damaged line", self.url)

    def _read(self, wait: bool) -> bool:
        """Take what arrived; where nothing did, wait a little if allowed. Return whether there was anything."""
        with self._port_errors():
            waiting = self._port.in_waiting
            if not waiting and not wait:
                return False
            arrived = self._port.read(waiting or 1)
        self._arrived += arrived
        return bool(arrived)

    @contextmanager
    def _port_errors(self) -> Iterator[None]:
        """Turn the several exceptions of a lost port into one."""
        if not self._port.is_open:
            raise self._error(f"{self.url} is closed: open it again")
        try:
            yield
        except serial.SerialTimeoutException as failure:
            raise self._error(
                f"{self.url} took nothing for {self.timeout_s:g} s: the instrument hangs; switch it off and on again"
            ) from failure
        except Failures as failure:
            raise self._error(
                f"{self.url} is gone: the cable is out, or the instrument lost its power; connect it and start again"
            ) from failure

    def _opened(self, baud: int) -> serial.SerialBase:
        """Open the port, or raise an error that explains why not."""
        scheme, separator, _ = self.url.lower().partition("://")
        if separator:
            self._check_address(scheme)
        if baud < 1:  # 0 hangs up
            raise self._error(f"{self.url} cannot be set to {baud} baud: use the instrument's own")
        try:
            port = serial.serial_for_url(
                self.url,
                do_not_open=True,
                baudrate=baud,
                timeout=POLL_S,
                write_timeout=None if scheme == "rfc2217" else self.timeout_s,  # that one keeps a deadline of its own
                exclusive=True,
            )
            port.dtr = False  # an edge of it restarts many boards
            port.open()
        except Refusals as failure:
            raise self._error(self._reason(failure, baud, separator != "")) from failure
        return port

    def _check_address(self, scheme: str) -> None:
        if scheme not in SCHEMES:
            raise self._error(
                f"{self.url}: {scheme}:// is not spoken; write a serial device, as /dev/ttyUSB0 or COM3, or "
                + ", ".join(f"{known}://" for known in SCHEMES)
            )
        try:
            parts = urlsplit(self.url)
            complete = scheme == "loop" or bool(parts.hostname and parts.port)
        except ValueError:
            complete = False
        if not complete:
            raise self._error(f"{self.url}: write host and port, as {scheme}://10.0.0.5:5025")

    def _reason(self, failure: Exception, baud: int, network: bool) -> str:
        """Return why a port did not open, and what to do."""
        code = getattr(failure, "errno", None)
        text = str(failure)  # on Windows the code stands only there
        if isinstance(failure, ValueError | OverflowError):
            return f"{self.url} cannot be set to {baud} baud: {text}"
        if network:
            return f"{self.url} does not answer ({text.rpartition('] ')[2]}): check its power and the address"
        if code == errno.ENOENT or "FileNotFoundError" in text:
            return f"there is no port {self.url}: `colorphase devices` lists this machine's"
        if code in (errno.EAGAIN, errno.EBUSY) or "PermissionError" in text:
            return f"{self.url} is in use: close the other program that has it open"
        if code in (errno.EACCES, errno.EPERM):
            return f"{self.url} may not be opened: {self._permission()}"
        detail = text.rpartition("] ")[2]
        return f"{self.url} is not a serial port that works ({detail}): `colorphase devices` lists this machine's"

    def _permission(self) -> str:
        """Return how to get the right to open the port."""
        try:
            group = grp.getgrgid(Path(self.url).stat().st_gid).gr_name
        except (OSError, KeyError):
            return "ask the machine's administrator for the right"
        if group in ("root", "wheel"):
            return f"it belongs to {group}; ask the machine's administrator for a udev rule"
        user = os.environ.get("USER", "$USER")
        return f"join its group with `sudo usermod -aG {group} {user}`, then log in again"
