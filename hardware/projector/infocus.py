"""A projector with InFocus's RS-232 commands, as (PWR1).

The manuals show how settings are read, as (BRT?) with the answer (0-100, 50), a range and what it is; none shows the
answer to (PWR?), so it is taken however it comes. They require three seconds between commands, and promise no answer to
one that sets something.

References
----------
InFocus, manuals of LP720, LP840, W59, IN42, IN5533 and IN5555L, control commands.
"""

import re
import time
from collections.abc import Callable
from dataclasses import dataclass

from hardware.errors import ProjectorError
from hardware.link import Link
from hardware.projector.switching import port_of, switch_power
from hardware.protocols import Identity, PowerState, ProjectorStatus
from hardware.settings import ProjectorSettings

PAUSE_S = 3.0
ANSWER_S = 3.0
#: Most models, and those of the IN5500 series.
BAUDS = (19200, 38400, 115200)
_POWER: dict[int, PowerState] = {0: "off", 1: "on"}


@dataclass(frozen=True)
class _Setting:
    value: int
    least: int | None = None
    most: int | None = None


class InFocus:
    """A projector on a serial line.

    Parameters
    ----------
    url : str
        The serial device, or a URL.
    baud : int, optional
        Bits per second; None: the usual ones are tried.

    Raises
    ------
    ProjectorError
        It does not answer.
    """

    def __init__(self, url: str, baud: int | None = None) -> None:
        self.identity = Identity("InFocus", "")
        self._last_s = float("-inf")
        rates = (baud,) if baud is not None or "://" in url else BAUDS
        for rate in rates:
            self._link = Link(url, baud=rate or BAUDS[0], terminator=b")", timeout_s=ANSWER_S, error=ProjectorError)
            try:
                if (power := self._read("PWR")) is not None:
                    self._reports_power = power.value in _POWER
                    return
            except BaseException:
                self._link.close()
                raise
            self._link.close()
        tried = "" if rates == (None,) else f" at {', '.join(map(str, rates))} baud"
        raise ProjectorError(
            f"{url} does not answer (PWR?){tried} as an InFocus projector does: check its mains, the cable (some "
            "models need a null modem) and baud under [projector]"
        )

    def power(self, on: bool, notify: Callable[[str], None] = lambda doing: None) -> bool:
        """Switch it on or off and wait until it reports that; see `Projector`."""

        def command() -> bool:
            self._send(f"PWR{on:d}")
            return True

        if not self._reports_power:
            command()
            return False
        switch_power(on, self._power, command, notify)
        return True

    def input(self, source: str) -> None:
        """Choose what it shows, as its manual numbers sources; see `Projector`."""
        if not re.fullmatch(r"\d{1,4}", source):
            raise ProjectorError(f"InFocus projectors have no input {source!r}: give the number in its manual, as 0")
        self._set("SRC", int(source))

    def blank(self, on: bool) -> None:
        """Show black, or the picture again; see `Projector`."""
        self._set("BLK", int(on))

    def status(self) -> ProjectorStatus:
        """Ask it how it is; see `Projector`. Takes some seconds a question."""
        power = self._power()
        lamp = self._read("LMP")
        blank = source = None
        if power != "off":
            blank = self._read("BLK")
            source = self._read("SRC")
        return ProjectorStatus(
            power,
            None if source is None else str(source.value),
            None if blank is None else blank.value != 0,
            None,
            None if lamp is None else (lamp.value,),
        )

    def close(self) -> None:
        """Let go of the line; see `Projector`."""
        self._link.close()

    def _power(self) -> PowerState | None:
        setting = self._read("PWR")
        return None if setting is None else _POWER.get(setting.value)

    def _set(self, name: str, value: int) -> None:
        """Set something, and look whether it was, where the model lets one look."""
        before = self._read(name)
        if before is not None and before.least is not None and before.most is not None:
            # A number beyond the range would set the largest, without an error.
            if not before.least <= value <= before.most:
                raise ProjectorError(f"the projector takes ({name}) from {before.least} to {before.most}, not {value}")
        self._send(f"{name}{value}")
        after = self._read(name)
        if after is not None and after.value != value:
            raise ProjectorError(
                f"the projector did not take ({name}{value}) and stays at {after.value}: check that it is on"
            )

    def _read(self, name: str) -> _Setting | None:
        """Return a setting; None: it does not report it."""
        self._send(f"{name}?")
        deadline_s = time.monotonic() + ANSWER_S
        while (line := self._link.receive(max(0.0, deadline_s - time.monotonic()))) is not None:
            # A line ends before its bracket; an echo of the question, a prompt or a ? may precede it.
            if found := re.search(r"\(\s*(\d+)\s*-\s*(\d+)\s*,\s*(\d+)\s*$", line):
                return _Setting(int(found[3]), int(found[1]), int(found[2]))
            if found := re.search(rf"\(\s*{name}\W?(\d+)\s*$", line):
                return _Setting(int(found[1]))
        self._last_s = time.monotonic()  # time for an answer that comes late: it does not name its question
        return None

    def _send(self, command: str) -> None:
        time.sleep(max(0.0, self._last_s + PAUSE_S - time.monotonic()))
        self._link.settle(0.02)  # what came late is no answer to this
        self._link.send(f"({command}")
        self._last_s = time.monotonic()


def open_infocus(settings: ProjectorSettings) -> InFocus:
    """Connect to the projector that a rig's settings name."""
    return InFocus(port_of(settings, "/dev/ttyUSB0"), settings.baud)
