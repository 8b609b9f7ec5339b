"""A projector that speaks PJLink, class 1, over the network.

References
----------
JBMIA, PJLink Specifications, version 1.04 (2013).
"""

import hashlib
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from hardware.errors import ProjectorError
from hardware.link import Link
from hardware.projector.switching import switch_power
from hardware.protocols import Identity, PowerState, ProjectorStatus

#: The standard leaves a projector two seconds; some take longer while they warm up.
ANSWER_S = 5.0
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
        Where, as ``socket://10.0.0.6:4352``.
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
            session.ask("POWR", "?")  # what every projector answers, and what tells of a wrong password
            self.identity = Identity(session.told("INF1") or "", session.told("INF2") or "")

    def power(self, on: bool, tell: Callable[[str], None] = lambda doing: None) -> None:
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

        switch_power(on, self._power, command, tell)

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
                inputs = session.told("INST") if refused.code == "2" else None
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
        """Ask it how it is; see `Projector`."""
        power = self._power()
        with self._session() as session:
            mute = session.told("AVMT")
            errors = session.told("ERST")
            lamps = session.told("LAMP", otherwise="")  # one without a lamp does not know the question
            shown = session.told("INPT")
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
        link = Link(self._url, terminator=b"\r", timeout_s=ANSWER_S, error=ProjectorError)
        try:
            yield _Session(link, self._login(link))
        finally:
            link.close()

    def _login(self, link: Link) -> str:
        """Return what goes before the first command."""
        greeting = link.receive()
        if greeting is None:
            raise ProjectorError(
                f"{self._url} does not greet as PJLink does: switch PJLink on in the projector's network menu, close "
                "other programs that control it, and check the port (4352 as a rule)"
            )
        if greeting.upper() == "PJLINK 0":
            return ""
        salt = re.fullmatch("PJLINK 1 ([0-9a-f]+)", greeting, re.IGNORECASE)
        if salt is None:
            _refuse_login(greeting, self._url)
            raise ProjectorError(
                f"{self._url} is no PJLink projector, it greets with {greeting[:40]!r}: check the port"
            )
        if not self._password:
            raise ProjectorError("the projector asks for its PJLink password: write password under [projector]")
        return hashlib.md5((salt[1] + self._password).encode(), usedforsecurity=False).hexdigest()


class _Session:
    """One connection. What is sent first may hold a digest of the password, so no message shows what was sent."""

    def __init__(self, link: Link, prefix: str) -> None:
        self._link = link
        self._prefix = prefix

    def ask(self, command: str, parameter: str) -> str:
        """Return the answer to a command."""
        self._link.send(f"{self._prefix}%1{command} {parameter}")
        self._prefix = ""
        header = f"%1{command}="
        while (line := self._link.receive()) is not None:
            _refuse_login(line, self._link.url)
            if not line.upper().startswith(header):
                continue  # an answer that comes too late
            answer = line[len(header) :]
            if re.fullmatch("ERR[1-4]", answer.upper()):
                raise _RefusedError(answer[-1], f"{command} {parameter}")
            return answer
        raise ProjectorError(
            f"{self._link.url} does not answer {command} {parameter} within {ANSWER_S:g} s: is it a PJLink projector? "
            "Switch its standby to the one that leaves the network on"
        )

    def told(self, query: str, otherwise: str | None = None) -> str | None:
        """Return the answer to a question; None where it cannot be told now, `otherwise` where it never is."""
        try:
            return self.ask(query, "?")
        except _RefusedError as refused:
            return otherwise if refused.code == "1" else None


def _refuse_login(line: str, url: str) -> None:
    if line.upper() == "PJLINK ERRA":
        raise ProjectorError(f"{url} does not accept the PJLink password: correct password under [projector]")
