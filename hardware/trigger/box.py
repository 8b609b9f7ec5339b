"""Our own trigger box: an ATmega328P with the firmware in `hardware/firmware`; its protocol is in docs/trigger_box.md.

Every request carries a number, which its answer repeats, and both carry a CRC-8: an answer that comes too late, or is
damaged, is never mistaken for another one.
"""

import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from hardware.errors import TriggerError
from hardware.link import Link
from hardware.protocols import Identity, Strobe, TriggerStatus
from hardware.pulses import PulseTrain, TriggerLimits, fitted
from hardware.settings import TriggerSettings
from hardware.trigger.port_trigger import PortTrigger, open_port, refuse_outputs

NAME = "colorphase-trigger-box"
PROTOCOL = "1"
BAUD = 115200
#: An Arduino Uno restarts when its port is opened, and spends up to two seconds in its boot loader.
IDENTIFY_S = 3.0
#: The box's clock and this machine's differ by less than 1 %; what runs on for longer than that is stuck.
OVERDUE_S = 1.0
#: Damaged lines during a burst: a few were repeated, of more one may have passed, as one in 256 does.
FEW_DAMAGED = 3
#: Exposures that the box remembers at most.
MEMORY = 128
#: Number of unread ones at which `status` begins to read them out.
BACKLOG = MEMORY // 2
#: Answers, of six exposures and 16 ms each, that one `status` waits for.
LOG_ANSWERS = 4
#: An endless burst is not remembered for ever: the last hour at 30 Hz.
REMEMBERED = 108_000

#: Clocks are compared over this time at least: an answer's delay, unknown by a millisecond, is 100 ppm of it.
CLOCK_S = 10.0
CLOCK_SAMPLES = 100
#: Answers that took this many times as long as the fastest one were held up on their way, and show no time.
SLOW = 1.5

CAUSES = {
    1: "its power came on",
    2: "its reset was pressed, or another program opened its port",
    4: "its supply broke down: look at its cable, and at what else it feeds",
    8: "its program hung",
}
OUTCOMES = {
    "LATE": "the trigger box stopped the burst because it could not make an edge in time: make widths and gaps longer",
    "SHORTED": "the trigger box stopped the burst because an output did not follow: is its cable shorted, or driven?",
    "SILENT": "the trigger box stopped the burst because this program said nothing for too long",
}


def crc8(text: str) -> int:
    """Return the CRC-8 of a line: polynomial x^8 + x^2 + x + 1, from 0."""
    crc = 0
    for byte in text.encode("ascii"):
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x07) & 0xFF if crc & 0x80 else crc << 1
    return crc


class _Lost(TriggerError):
    """No answer came that belongs to the request, which may have been obeyed or not; what was heard instead."""

    def __init__(self, message: str, heard: str = "") -> None:
        super().__init__(message)
        self.heard = heard


class _Refused(TriggerError):
    """The box understood and refused."""


def _is_number(word: str) -> bool:
    """Return whether a word is a number of 32 bits, which are all that the box counts in."""
    return word.isdecimal() and len(word) <= 10 and int(word) < 2**32


@dataclass(frozen=True)
class _Answer:
    """The box's answer after OK."""

    words: tuple[str, ...]

    def text(self, name: str) -> str:
        """Return the value of a word ``name=value``."""
        for word in self.words:
            if word.startswith(f"{name}="):
                return word[len(name) + 1 :]
        raise self._nonsense(name)

    def number(self, name: str) -> int:
        """Return the value of a word ``name=value`` that is a number."""
        value = self.text(name)
        if not _is_number(value):
            raise self._nonsense(name)
        return int(value)

    def pairs(self) -> list[tuple[int, int]]:
        """Return the words ``number,number``."""
        pairs = [word.partition(",") for word in self.words if "=" not in word]
        if not all(_is_number(first) and _is_number(second) for first, _, second in pairs):
            raise self._nonsense("pairs of numbers")
        return [(int(first), int(second)) for first, _, second in pairs]

    def _nonsense(self, name: str) -> TriggerError:
        return TriggerError(
            f"the trigger box answers {' '.join(self.words)!r} instead of {name}: flash its firmware anew"
        )


class TriggerBox(PortTrigger):
    """The trigger box.

    It remembers 128 exposures; of longer bursts `status` reads them out while they run. The box stops a burst when it
    has heard nothing for 5 s, as it would be triggering for nobody: query the status more often.

    Parameters
    ----------
    link
        Opened with this module's `BAUD`. `close` closes it.
    strobe, vsync
        Whether the camera's exposure output and the projector's sync output are wired to the box.

    Raises
    ------
    TriggerError
        Nothing answers within `IDENTIFY_S`, or something else than a box with this protocol.
    """

    def __init__(self, link: Link, *, strobe: bool = False, vsync: bool = False) -> None:
        self._link = link
        self._strobe = strobe
        self._vsync = vsync
        self._number = 0  # of the last request
        self._damaged = 0  # answers with a wrong CRC
        self._damaged_before = 0  # lines, when it was armed
        self._set: _Answer | None = None  # the last configuration that it took, in its own words; None: none
        self._count = 0  # pulses of the burst; 0: endless
        self._period = 0  # ticks
        self._deadline_s: float | None = None  # when the burst must be over
        self._overdue = False
        self._log: deque[Strobe] = deque(maxlen=REMEMBERED)
        self._logged = 0  # exposures that were read from the box, or lost there
        self._clock: deque[tuple[float, float, int]] = deque(maxlen=CLOCK_SAMPLES)  # queried and answered at, s; tick
        self._identity = self._identified()
        self._limits = self._asked_limits()

    def configure(self, train: PulseTrain) -> PulseTrain:
        """Set the burst up, outputs low; return it as it will be, rounded to the tick of 0.5 us."""
        train = fitted(train, self._limits)
        self._set = None
        self.abort()
        period, *pulses = (
            round(time_s / self._limits.tick_s)
            for time_s in (
                train.period_s,
                train.projector.delay_s,
                train.projector.width_s,
                train.camera.delay_s,
                train.camera.width_s,
            )
        )
        count = train.count or 0
        inputs = self._strobe + 2 * self._vsync
        answer = self._ask(f"SET {period} {count} {' '.join(map(str, pulses))} {inputs}")
        expected = (
            f"period={period} count={count} projector={pulses[0]},{pulses[1]} camera={pulses[2]},{pulses[3]} "
            f"strobe={self._strobe:d} vsync={self._vsync:d}"
        )
        if not set(expected.split()) <= set(answer.words):  # later firmware may report more
            raise TriggerError(f"{self._link.url}: the trigger box makes {' '.join(answer.words)!r} of {expected!r}")
        self._set, self._count, self._period = answer, count, period
        return train

    def arm(self) -> None:
        """Get ready: counters at zero, and what was configured still there."""
        if self._set is None:
            raise TriggerError(f"{self._link.url}: the trigger box has no burst to make: configure it first")
        try:
            answer = self._ask("ARM")
        except _Refused:
            self._check_same_life(self._ask("STATUS"))
            raise
        self._check_same_life(answer)
        if answer != self._set:
            raise TriggerError(f"{self._link.url}: somebody else has set the trigger box: configure it again")
        self._damaged_before = self._damaged + self._link.damaged
        self._deadline_s = None
        self._overdue = False
        self._log.clear()
        self._logged = 0

    def fire(self) -> None:
        """Start the burst. It is sent once; where the answer is lost, the status shows whether it was received."""
        if self._set is None:
            raise TriggerError(f"{self._link.url}: the trigger box has no burst to make: configure and arm it first")
        try:
            self._ask("FIRE", tries=1)
        except _Refused:
            self._check_same_life(self._ask("STATUS"))
            raise
        except _Lost:
            status = self._ask("STATUS")
            self._check_same_life(status)
            if status.text("state") in ("READY", "ARMED"):
                self.abort()
                raise TriggerError(
                    f"{self._link.url}: FIRE did not reach the trigger box, and nothing was fired: look at its cable, "
                    "then arm and fire again"
                ) from None
        if self._count:
            burst_s = self._count * self._period * self._limits.tick_s
            self._deadline_s = time.monotonic() + 1.01 * burst_s + OVERDUE_S

    def status(self) -> TriggerStatus:
        """Return what became of the burst, and read out exposures that the box would soon forget."""
        asked_s = time.monotonic()
        said = self._ask("STATUS")
        if not self._is_same_life(said):
            self._clock.clear()
        self._clock.append((asked_s, time.monotonic(), said.number("tick")))
        running = said.text("state") == "RUNNING"
        if running and self._deadline_s is not None and time.monotonic() > self._deadline_s:
            self._overdue = True
            self.abort()
            running = False
        strobes = said.number("strobes")
        if self._strobe and self._is_same_life(said) and strobes - self._logged > BACKLOG:
            self._read_log(strobes, LOG_ANSWERS)
        return TriggerStatus(
            running=running,
            pulses=said.number("pulses"),
            strobes=strobes if self._strobe else None,
            vsyncs=said.number("vsyncs") if self._vsync else None,
            boot=said.number("boot"),
            complaints=tuple(self._complaints(said)),
            clock_ppm=clock_ppm(self._clock, self._limits.tick_s),
        )

    def strobes(self) -> tuple[Strobe, ...]:
        """Return the exposures that it did not return yet; those that were overwritten before are missing."""
        if self._strobe and self._is_same_life(said := self._ask("STATUS")):
            self._read_log(said.number("strobes"), MEMORY)
        found = tuple(self._log)
        self._log.clear()
        return found

    def abort(self) -> None:
        """Stop, outputs low."""
        self._deadline_s = None
        self._ask("STOP")

    def _complaints(self, said: _Answer) -> list[str]:
        """Return the faults in a status."""
        complaints = []
        state = said.text("state")
        if self._set is not None and not self._is_same_life(said):
            complaints.append(f"the trigger box has restarted since it was configured: {_cause(said)}")
        if self._overdue:
            complaints.append("the trigger box ran on after its burst should have ended, and was stopped: restart it")
        if state in OUTCOMES:
            complaints.append(OUTCOMES[state])
        if noise := said.number("noise"):
            complaints.append(
                f"{noise} edges at the strobe input came too fast for exposures: look at its cable and its ground"
            )
        if strays := said.number("strays"):
            complaints.append(f"the camera exposed {strays} times before the first pulse: switch its trigger mode on")
        damaged = self._damaged + self._link.damaged - self._damaged_before + said.number("garbled")
        if damaged > FEW_DAMAGED:
            complaints.append(f"{damaged} lines to and from the trigger box were damaged: look at its cable")
        if state == "DONE" and self._vsync and not said.number("vsyncs"):
            complaints.append("the projector reported no picture: look at its sync cable, and whether it is on")
        return complaints

    def _is_same_life(self, said: _Answer) -> bool:
        return self._set is not None and said.text("boot") == self._set.text("boot")

    def _check_same_life(self, said: _Answer) -> None:
        if not self._is_same_life(said):
            raise TriggerError(
                f"{self._link.url}: the trigger box has restarted since it was configured ({_cause(said)}): "
                "configure it again"
            )

    def _read_log(self, strobes: int, answers: int) -> None:
        """Read exposures that were not read yet, in at most `answers` answers; more exposures may come meanwhile."""
        while self._logged < strobes and answers > 0:
            said = self._ask(f"LOG {self._logged}")
            entries = said.pairs()
            for pulse, offset in entries:
                self._log.append(Strobe(pulse, (pulse * self._period + offset) * self._limits.tick_s))
            self._logged = said.number("from") + len(entries)
            strobes = min(strobes, said.number("strobes"))  # it may have restarted
            answers -= 1

    def _identified(self) -> Identity:
        """Wait until it reports its identity."""
        deadline_s = time.monotonic() + IDENTIFY_S
        while True:
            try:
                said = self._exchange("ID", 0.3)
                break
            except _Lost as failure:
                if time.monotonic() > deadline_s:
                    raise TriggerError(
                        f"{self._link.url}: no trigger box answers{failure.heard}: check its cable, its firmware "
                        "and the port"
                    ) from None
        if said.words[:1] != (NAME,):
            raise TriggerError(f"{self._link.url}: this is {' '.join(said.words)!r}, not a {NAME}: correct the port")
        if said.text("protocol") != PROTOCOL:
            raise TriggerError(
                f"{self._link.url}: the trigger box speaks protocol {said.text('protocol')}, and this program "
                f"{PROTOCOL}: flash the firmware that came with it, with `make flash` in hardware/firmware"
            )
        return Identity("colorphase", "trigger box", firmware=f"{said.text('firmware')} {said.text('board')}")

    def _asked_limits(self) -> TriggerLimits:
        said = self._ask("LIMITS")
        tick_ns = said.number("tick_ns")
        if tick_ns == 0:
            raise TriggerError(f"{self._link.url}: the trigger box says its tick is nothing: flash its firmware anew")

        def seconds(name: str) -> float:
            return said.number(name) * tick_ns / 1e9

        return TriggerLimits(
            tick_s=tick_ns / 1e9,
            min_period_s=seconds("min_period"),
            max_period_s=seconds("max_period"),
            min_width_s=seconds("min_width"),
            min_gap_s=seconds("min_gap"),
            max_count=said.number("max_count"),
            counts_strobes=self._strobe,
            counts_vsyncs=self._vsync,
        )

    def _ask(self, command: str, tries: int = 2) -> _Answer:
        """Return the answer to a command, which is sent again where that is lost."""
        for _ in range(tries - 1):
            with suppress(_Lost):
                return self._exchange(command, self._link.timeout_s)
        return self._exchange(command, self._link.timeout_s)

    def _exchange(self, command: str, timeout_s: float) -> _Answer:
        """Send a request and return its answer; everything else that comes is old, or for people."""
        self._number = (self._number + 1) % 1000
        request = f"{self._number:03d} {command}"
        self._link.send(f"{request}*{crc8(request):02X}")
        deadline_s = time.monotonic() + timeout_s
        heard = ""
        while (line := self._link.receive(max(0.0, deadline_s - time.monotonic()))) is not None:
            text, _, crc = line.rpartition("*")
            if crc != f"{crc8(text):02X}":
                self._damaged += 1
                heard = f", but hears {line[:40]!r}"
                continue
            number, *words = text.split(" ")
            if number == request[:3] and words[:1] == ["OK"]:
                return _Answer(tuple(words[1:]))
            if number == request[:3] and words[:1] == ["ERR"]:
                raise _Refused(f"{self._link.url}: the trigger box refuses {command!r}: {' '.join(words[1:])}")
            if number == "?":
                raise _Lost(f"{self._link.url}: the trigger box could not read {command!r}: look at its cable")
        raise _Lost(
            f"{self._link.url}: the trigger box does not answer {command!r}{heard}: check its power and cable", heard
        )


def open_box(settings: TriggerSettings) -> TriggerBox:
    """Open the one that a rig's settings name."""
    refuse_outputs(settings)
    wired_back = {"strobe": settings.strobe, "vsync": settings.vsync is not None}
    return open_port(settings, (BAUD,), b"\n", lambda link: TriggerBox(link, **wired_back))


def clock_ppm(samples: Sequence[tuple[float, float, int]], tick_s: float) -> float | None:
    """Return by how much the box's clock is faster than this machine's.

    Parameters
    ----------
    samples : (s, s, ticks)
        Times of the query and of the answer, by this machine's clock, and its tick then, modulo 2^32.
    tick_s : float
        Length of a tick by its own clock.

    Returns
    -------
    float or None
        By the straight line through the ticks over the middles of question and answer; None: too little is known.
    """
    fastest_s = min((answered_s - asked_s for asked_s, answered_s, _ in samples), default=0.0)
    prompt = [sample for sample in samples if sample[1] - sample[0] <= SLOW * fastest_s]
    if len(prompt) < 3 or prompt[-1][0] - prompt[0][0] < CLOCK_S:
        return None
    middle_s = np.array([(asked_s + answered_s) / 2 for asked_s, answered_s, _ in prompt])
    steps = np.diff([tick for _, _, tick in prompt]) % 2**32  # it is queried more often than once in 35 minutes
    its_s = tick_s * np.concatenate([[0], np.cumsum(steps)])
    return float(1e6 * (np.polyfit(middle_s - middle_s[0], its_s, 1)[0] - 1))


def _cause(said: _Answer) -> str:
    """Return why it restarted."""
    bits = said.number("cause")
    causes = [text for bit, text in CAUSES.items() if bits & bit]
    return ", ".join(causes) or "its boot loader does not report why"
