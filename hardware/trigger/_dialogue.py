"""Questions to an instrument that answers each of them with one line, in their order."""

import re
import time
from collections.abc import Iterator

from hardware.errors import TriggerError
from hardware.link import Link
from hardware.protocols import Identity

#: An instrument that is busy, or whose name was queried by noise, may swallow the first questions.
TRIES = 3
#: How long a name may take: at 4800 baud, the longest takes 0.15 s on its way.
NAME_S = 0.6
#: Lines over USB or a network come with pauses of some hundredths of a second in them.
QUIET_S = 0.1


def names(link: Link) -> Iterator[str]:
    """Ask for the name; yield what comes and can be one, not an echo or what was meant for somebody before."""
    link.settle(QUIET_S)
    link.send("*IDN?")
    while (line := link.receive(NAME_S)) is not None:
        if line.count(",") >= 2:
            yield line


class Dialogue:
    """Questions and answers that stay in step: after an answer that is missing, or makes no sense, the name is queried.

    Parameters
    ----------
    link
        The open line.
    name
        A pattern of the whole answer to ``*IDN?``, with the groups maker, model, serial and firmware.
    instrument
        The expected instrument, in words.

    Raises
    ------
    TriggerError
        Nothing answers, or something else does.
    """

    def __init__(self, link: Link, name: str, instrument: str) -> None:
        self.link = link
        self._instrument = instrument
        self._in_step = False
        for _ in range(TRIES):
            for line in names(link):
                if match := re.fullmatch(name, line):
                    self._name = line
                    self.identity = Identity(**match.groupdict())
                    self._in_step = True
                    return
                raise TriggerError(
                    f"{link.url}: this is {line!r}, not a {instrument}: correct the trigger's port or driver"
                )
        raise TriggerError(
            f"{link.url}: no {instrument} answers: check its power, cable, remote interface and baud rate"
        )

    def ask(self, question: str, answer: str, *, once: bool = False) -> str:
        """Return the answer, which must match a pattern; what fails is sent again, unless only once."""
        for _ in range(1 if once else 2):
            if not self._in_step:
                self._catch_up()
            while self.link.receive(0) is not None:  # left over
                pass
            self.link.send(question)
            said = self._next(question, time.monotonic() + self.link.timeout_s)
            if said is not None and re.fullmatch(answer, said):
                return said
            self._in_step = False
        if said is None:
            silent = f"the {self._instrument} does not answer {question!r}"
            raise TriggerError(f"{self.link.url}: {silent}: check its power and cable")
        raise TriggerError(
            f"{self.link.url}: the {self._instrument} answers {question!r} with {said!r}, which makes no sense: check "
            "its cable, and that no other program has the port"
        )

    def _next(self, question: str, deadline: float) -> str | None:
        """Return the next line that is not the question itself, as an instrument with echo on sends it back."""
        while (line := self.link.receive(max(0.0, deadline - time.monotonic()))) is not None:
            if line not in (question, ""):
                return line
        return None

    def _catch_up(self) -> None:
        """Wait until the instrument reports its name: every answer before that is to an older question."""
        for _ in range(2):  # noise in front of the first one may spoil it
            self.link.settle(QUIET_S)
            self.link.send("*IDN?")
            deadline = time.monotonic() + self.link.timeout_s
            while (line := self._next("*IDN?", deadline)) is not None:
                if line == self._name:
                    self._in_step = True
                    return
        raise TriggerError(
            f"{self.link.url}: the {self._instrument} does not answer any more: check its power and cable"
        )
