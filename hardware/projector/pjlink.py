"""A projector that speaks PJLink, class 1, over the network.

References
----------
JBMIA, PJLink Specifications, version 1.04 (2013).
"""

import hashlib
import logging
import re
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from urllib.parse import urlsplit

from hardware.errors import ProjectorError
from hardware.projector.switching import port_of, switch_power
from hardware.protocols import Identity, PowerState, ProjectorStatus
from hardware.settings import ProjectorSettings

_log = logging.getLogger("colorphase.link")

#: The standard leaves a projector two seconds; some take longer while they warm up.
ANSWER_S = 5.0
#: Several times the longest line of the standard, 136 bytes; beyond it, it is something else.
_LONGEST = 1024
_POWER: dict[str, PowerState] = {"0": "off", "1": "on", "2": "cooling down", "3": "warming up"}
_PARTS = ("fan", "lamp", "temperature", "cover", "filter", "other")
_SEVERITY = {"1": "warning", "2": "error"}


class _RefusedError(ProjectorError):
    """The projector answered with one of the standard's errors, ERR1 to ERR4."""

    def __init__(self, code: str, command: str) -> None:
        why = {
            "1": "it does not have that function",
            "2": "it does not have that choice",
            "3": "not while it is off, warming up or cooling down: switch it on and wait",
            "4": "it has failed: look at its lamps and its manual",
        }
        super().__init__(f"the projector refuses {command}: {why[code]}")
        self.code = code


class PJLink:
    """A projector in the network.

    It is connected to for each call only: it hangs up after half a minute of silence, and many serve one at a time.

    Parameters
    ----------
    url : str
        Address, as ``socket://10.0.0.6:4352``.
    password : str, optional
        PJLink's password, where one is set.

    Raises
    ------
    ProjectorError
        It does not answer, is none, or does not accept the password.
    """

    def __init__(self, url: str, password: str | None = None) -> None:
        self._url = url
        self._password = password
        with self._session() as session:
            session.ask("POWR", "?")  # every projector answers it, and it reveals a wrong password
            self.identity = Identity(session.read("INF1") or "", session.read("INF2") or "")

    def power(self, on: bool, notify: Callable[[str], None] = lambda doing: None) -> bool:
        """Switch it on or off and wait until it is; see `Projector`."""

        def command() -> bool:
            with self._session() as session:
                try:
                    session.ask("POWR", "1" if on else "0")
                except _RefusedError as refused:
                    if refused.code != "3":
                        raise
                    return False
            return True

        switch_power(on, self._power, command, notify)
        return True

    def input(self, source: str) -> None:
        """Choose what it shows, as 31 for the first digital input; see `Projector`."""
        if not re.fullmatch("[1-6][1-9A-Z]", source):
            raise ProjectorError(
                f"PJLink has no input {source!r}: it is 1 RGB, 2 video, 3 digital, 4 storage or 5 network, then its "
                "number, as in 31"
            )
        with self._session() as session:
            try:
                session.ask("INPT", source)
            except _RefusedError as refused:
                inputs = session.read("INST") if refused.code == "2" else None
                if inputs is None:
                    raise
                raise ProjectorError(f"the projector has no input {source}: choose one of {inputs}") from None

    def blank(self, on: bool) -> None:
        """Show black, or the picture again; see `Projector`."""
        last = "1" if on else "0"
        with self._session() as session:
            try:
                session.ask("AVMT", "3" + last)  # with the sound: that is what closes a shutter
            except _RefusedError as refused:
                if refused.code != "2":
                    raise
                session.ask("AVMT", "1" + last)

    def status(self) -> ProjectorStatus:
        """Query its state; see `Projector`."""
        power = self._power()
        with self._session() as session:
            mute = session.read("AVMT")
            errors = session.read("ERST")
            lamps = session.read("LAMP", otherwise="")  # one without a lamp does not know the question
            shown = session.read("INPT")
        faults = None
        if errors is not None and re.fullmatch("[012]{6}", errors):
            digits = zip(_PARTS, errors, strict=True)
            faults = tuple(f"{part}: {_SEVERITY[digit]}" for part, digit in digits if digit != "0")
        hours = None
        if lamps is not None and re.fullmatch(r"(\d+ [01]( |$))*", lamps):
            hours = tuple(int(number) for number in lamps.split()[::2])
        return ProjectorStatus(power, shown, None if mute is None else mute in ("11", "31"), faults, hours)

    def close(self) -> None:
        """Do nothing: no connection is open between two calls."""

    def _power(self) -> PowerState:
        with self._session() as session:
            answer = session.ask("POWR", "?")
        if answer not in _POWER:
            raise ProjectorError(f"{self._url} answers {answer!r} when asked for its power: it does not speak PJLink")
        return _POWER[answer]

    @contextmanager
    def _session(self) -> Iterator["_Session"]:
        session = _Session(self._url)
        try:
            session.log_in(self._password)
            yield session
        finally:
            session.close()


def open_pjlink(settings: ProjectorSettings) -> PJLink:
    """Connect to the projector that a rig's settings name."""
    return PJLink(port_of(settings, "socket://10.0.0.6:4352"), settings.password)


class _Session:
    """One connection. What is sent first may hold a digest of the password, so no message shows what was sent.

    It is a socket of its own and no `Link`: opening one of those throws away what came before, and so the greeting.
    """

    def __init__(self, url: str) -> None:
        self._url = url
        self._prefix = ""
        self._arrived = b""
        try:
            parts = urlsplit(url)
            host, port = parts.hostname, parts.port
        except ValueError:
            host = port = None
        if not url.startswith("socket://") or not host or not port:
            raise ProjectorError(f'{url}: PJLink is spoken over the network: write port = "socket://10.0.0.6:4352"')
        try:
            self._socket = socket.create_connection((host, port), timeout=ANSWER_S)
        except UnicodeError:
            raise ProjectorError(f"{url}: {host} can be no host's name: correct port under [projector]") from None
        except OSError as fault:
            raise ProjectorError(
                f"{url} cannot be reached ({fault.strerror or fault}): check the address, the network cable, and that "
                "the projector's standby leaves the network on"
            ) from None

    def log_in(self, password: str | None) -> None:
        """Take the greeting, and get ready to prove that the password is known."""
        greeting = self._line(time.monotonic() + ANSWER_S)
        if greeting is None:
            raise ProjectorError(
                f"{self._url} does not greet as PJLink does: switch PJLink on in the projector's network menu, close "
                "other programs that control it, and check the port (4352 as a rule)"
            )
        if greeting.upper() == "PJLINK 0":
            return
        salt = re.fullmatch("PJLINK 1 ([0-9a-f]+)", greeting, re.IGNORECASE)
        if salt is None:
            self._check_login(greeting)
            raise ProjectorError(
                f"{self._url} is no PJLink projector, it greets with {greeting[:40]!r}: check the port"
            )
        if not password:
            raise ProjectorError("the projector asks for its PJLink password: write password under [projector]")
        self._prefix = hashlib.md5((salt[1] + password).encode(), usedforsecurity=False).hexdigest()

    def ask(self, command: str, parameter: str) -> str:
        """Return the answer to a command."""
        try:
            self._socket.sendall(f"{self._prefix}%1{command} {parameter}\r".encode("ascii"))
        except OSError:
            raise self._gone() from None
        _log.debug("%s <- %s %s", self._url, command, parameter)  # without the prefix, a digest of the password
        self._prefix = ""
        header = f"%1{command}="
        deadline_s = time.monotonic() + ANSWER_S
        while (line := self._line(deadline_s)) is not None:
            self._check_login(line)
            if not line.upper().startswith(header):
                continue  # an answer that comes too late
            answer = line[len(header) :]
            _log.debug("%s -> %s", self._url, answer)
            if re.fullmatch("ERR[1-4]", answer.upper()):
                raise _RefusedError(answer[-1], f"{command} {parameter}")
            return answer
        raise ProjectorError(
            f"{self._url} does not answer {command} {parameter} within {ANSWER_S:g} s: "
            "switch it off at the mains and on again"
        )

    def read(self, query: str, otherwise: str | None = None) -> str | None:
        """Return the answer to a question; None where there is none now, `otherwise` where there never is."""
        try:
            return self.ask(query, "?")
        except _RefusedError as refused:
            return otherwise if refused.code == "1" else None

    def close(self) -> None:
        """Hang up."""
        self._socket.close()

    def _line(self, deadline_s: float) -> str | None:
        """Return the next line, or None where none comes in time."""
        while b"\r" not in self._arrived:
            left_s = deadline_s - time.monotonic()
            if left_s <= 0 or len(self._arrived) > _LONGEST:
                return None
            self._socket.settimeout(left_s)
            try:
                more = self._socket.recv(4096)
            except TimeoutError:
                return None
            except OSError:
                more = b""
            if not more:
                raise self._gone()
            self._arrived += more
        line, _, self._arrived = self._arrived.partition(b"\r")
        return line.strip().decode("utf-8", errors="replace")

    def _check_login(self, line: str) -> None:
        if line.upper() == "PJLINK ERRA":
            raise ProjectorError(f"{self._url} does not accept the PJLink password: correct password under [projector]")

    def _gone(self) -> ProjectorError:
        return ProjectorError(
            f"{self._url} hung up: another program may have it, as many serve one at a time; try again"
        )
