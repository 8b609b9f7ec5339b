"""Pulse generators that speak the language of Quantum Composers: 9200, 9500 and BNC 505 to 577, over a serial line.

Every command is answered by one line: ``ok``, a value, or ``?n``. The burst is made by the system timer, T0, to which
both outputs are tied; switching T0 on starts it. Not every model reports how many pulses it made, so none is queried.
"""

import time

from hardware.errors import RigError, TriggerError
from hardware.link import Link
from hardware.protocols import TriggerStatus
from hardware.pulses import Pulse, PulseTrain, TriggerLimits, fitted
from hardware.settings import TriggerSettings
from hardware.trigger._dialogue import Dialogue
from hardware.trigger.port_trigger import PortTrigger, chosen_outputs, open_port, refuse_inputs

TERMINATOR = b"\r\n"
BAUDS = (38400, 115200, 9600, 19200, 57600, 4800)
"""As its USB port, its RS-232 port and then older ones are set when they are delivered."""

#: What every one of the models can do. Their ticks are 250 ps to 10 ns, their shortest periods 100 to 200 ns; here it
#: is longer than any width that they start with, so that no order of settings is refused.
LIMITS = TriggerLimits(
    tick_s=10e-9,
    min_period_s=10e-6,
    max_period_s=999.0,
    min_width_s=10e-9,
    min_gap_s=100e-9,
    max_count=1_000_000,
    counts_strobes=False,
    counts_vsyncs=False,
)
NAME = (
    r"(?P<maker>QC|BNC),(?P<model>(?<=QC,)9[25]\d\d[^,]*|(?<=BNC,)5[0-7]\d(?!\d)[^,]*)"
    r",(?P<serial>[^,]*),(?P<firmware>.*)"
)
ERRORS = {
    "1": "the command does not begin as one",
    "2": "a keyword is missing",
    "3": "it does not know a keyword",
    "4": "a value is missing",
    "5": "the value is not one of those it takes",
    "6": "it can only be asked",
    "7": "it cannot be asked",
    "8": "it cannot do that in its present state",
    "9": "the value is out of its bounds",
}
VALUE = r"[-+]?\d[\d.]*(?:[Ee][-+]?\d+)?|\w+"
REFUSAL = r"\?\d.*"
#: Its clock and this machine's differ by less.
CLOCKS = 1e-3


class QuantumComposers(PortTrigger):
    """A pulse generator of Quantum Composers or Berkeley Nucleonics.

    Parameters
    ----------
    link
        Opened with this module's `TERMINATOR`. `close` closes it.
    projector_output, camera_output
        The outputs' letters.

    Raises
    ------
    TriggerError
        Nothing answers, or something else does.
    """

    def __init__(self, link: Link, *, projector_output: str = "A", camera_output: str = "B") -> None:
        if projector_output == camera_output:
            raise RigError(f"projector and camera are both at output {camera_output}: give each its own")
        self._outputs = ("ABCD".index(projector_output) + 1, "ABCD".index(camera_output) + 1)
        self._link = link
        self._dialogue = Dialogue(link, NAME, "Quantum Composers or BNC pulse generator")
        self._identity, self._limits = self._dialogue.identity, LIMITS
        self._train: PulseTrain | None = None
        self._fired_s: float | None = None  # None: nothing was fired, or its end was seen
        self._complaints: list[str] = []

    def configure(self, train: PulseTrain) -> PulseTrain:
        """Reset it and set the burst up; return it as it will be."""
        train = fitted(train, LIMITS)
        self.abort()
        self._train = None
        self._send("*RST")  # gates, external triggers and the other outputs off, levels as TTL
        if self._dialogue.ask(":PULS0:TRIG:MOD DIS", f"ok|{REFUSAL}") != "ok":
            self._send(":PULS0:EXT:MOD DIS")  # as older ones spell it
        self._set(train)
        self._train = train
        return train

    def arm(self) -> None:
        """Get ready; where it was restarted or set by hand, set it up again."""
        if self._train is None:
            raise TriggerError("the pulse generator has no burst to make: configure it before it is armed")
        self.abort()
        self._set(self._train)
        self._complaints.clear()

    def fire(self) -> None:
        """Start the burst."""
        self._fired_s = time.monotonic()
        try:
            said = self._dialogue.ask(":PULS0:STATE 1", f"ok|{REFUSAL}", once=True)
        except TriggerError:  # it may run or not: its state shows it
            self._complaints.append("the pulse generator did not confirm that it started")
            return
        self._check(":PULS0:STATE 1", said)

    def status(self) -> TriggerStatus:
        """Return whether it runs."""
        running = self._dialogue.ask(":PULS0:STATE?", "[01]") == "1"
        if not running and self._fired_s is not None and self._train is not None:
            took_s = time.monotonic() - self._fired_s
            self._fired_s = None
            count, period_s = self._train.count, self._train.period_s
            if count is None or took_s < (count - 1) * period_s * (1 - CLOCKS):
                self._complaints.append(
                    f"the pulse generator is at rest {took_s:.2f} s after it was fired, before its burst can be over: "
                    "it did not start, was stopped at its panel, or restarted"
                )
        return TriggerStatus(running, complaints=tuple(self._complaints))

    def abort(self) -> None:
        """Stop, outputs low."""
        self._fired_s = None
        self._send(":PULS0:STATE 0")

    def _set(self, train: PulseTrain) -> None:
        """Set whatever is not as the train needs it."""
        settings = {
            ":PULS0:MOD": "NORM" if train.count is None else "BURS",
            ":PULS0:PER": _written(train.period_s),
            ":PULS0:BCO": str(train.count or 1),
        }
        for channel, pulse in zip(self._outputs, (train.projector, train.camera), strict=True):
            settings |= _channel_settings(channel, pulse)
        for keyword, value in settings.items():
            if _means(self._asked(keyword), value):
                continue
            self._send(f"{keyword} {value}")
            if not _means(kept := self._asked(keyword), value):
                raise TriggerError(
                    f"{self._link.url}: the pulse generator took {keyword} {value} as {kept}: is the output "
                    "there, and does the model have that range?"
                )

    def _asked(self, keyword: str) -> str:
        said = self._dialogue.ask(f"{keyword}?", f"{VALUE}|{REFUSAL}")
        self._check(f"{keyword}?", said)
        return said

    def _send(self, command: str) -> None:
        self._check(command, self._dialogue.ask(command, f"ok|{REFUSAL}"))

    def _check(self, command: str, said: str) -> None:
        if said.startswith("?"):
            reason = ERRORS.get(said[1:], "an error that its manual does not list")
            raise TriggerError(f"{self._link.url}: the {self.identity.model} refuses {command!r}: {reason} ({said})")


def open_quantum_composers(settings: TriggerSettings) -> QuantumComposers:
    """Open the one that a rig's settings name."""
    refuse_inputs(settings)
    return open_port(settings, BAUDS, TERMINATOR, lambda link: QuantumComposers(link, **chosen_outputs(settings)))


def _channel_settings(channel: int, pulse: Pulse) -> dict[str, str]:
    return {
        f":PULS{channel}:SYNC": "T0",
        f":PULS{channel}:CMOD": "NORM",
        f":PULS{channel}:POL": "NORM",
        f":PULS{channel}:WIDT": _written(pulse.width_s),
        f":PULS{channel}:DEL": _written(pulse.delay_s),
        f":PULS{channel}:STATE": "1",
    }


def _written(time_s: float) -> str:
    return f"{time_s:.9f}"


def _means(said: str, value: str) -> bool:
    """Return whether an answer states a value, in the instrument's own spelling, as BURST for BURS."""
    try:
        return abs(float(said) - float(value)) < LIMITS.tick_s / 2
    except ValueError:
        return said.upper().startswith(value)
