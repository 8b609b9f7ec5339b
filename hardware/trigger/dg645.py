"""The digital delay generator DG645 of Stanford Research Systems, over RS-232 or TCP.

Projector on AB, camera on CD. Commands that set something are not answered: each is read back, and its errors wait in a
queue. The burst is started by a single shot; its end, and what went wrong in it, is in the instrument's registers.
"""

import time

from hardware.errors import TriggerError
from hardware.link import Link
from hardware.protocols import TriggerStatus
from hardware.pulses import PulseTrain, TriggerLimits, fitted
from hardware.settings import TriggerSettings
from hardware.trigger._dialogue import Dialogue
from hardware.trigger.port_trigger import PortTrigger, open_port, refuse_inputs, refuse_outputs

TERMINATOR = b"\n"
BAUDS = (9600, 115200, 57600, 38400, 19200, 4800)
"""As it is delivered, and what else it can be set to."""

ENDLESS = 2**31 - 1
"""The most pulses per burst, by the maker's own driver; a train that continues until it is aborted is one of these."""
LIMITS = TriggerLimits(
    tick_s=10e-9,  # of the burst's period; delays are finer
    min_period_s=100e-9,
    max_period_s=1999.0,
    min_width_s=10e-9,
    min_gap_s=100e-9,  # it is not ready for the next cycle at once; were it longer, RATE would show it
    max_count=ENDLESS,
    counts_strobes=False,
    counts_vsyncs=False,
)
NAME = r"(?P<maker>Stanford Research Systems),(?P<model>DG645),s/n(?P<serial>[^,]*),ver(?P<firmware>.*)"
ERRORS = {
    10: "the value is not one it takes",
    11: "not in its present mode",
    12: "the delay is out of its range",
    13: "the delays would depend on each other in a circle",
    15: "it is not allowed",
    30: "data were lost",
    110: "the command is illegal",
    111: "it does not know the command",
    112: "it cannot be asked",
    113: "it cannot be set",
    114: "a value is empty",
    115: "there is a value too many",
    116: "a value is missing",
    117: "a value is too long",
    118: "the value is not a number",
    120: "the value is not a whole number",
    121: "the number is too large",
    126: "the command is misspelled",
    170: "the line garbles characters: check the baud rate",
    171: "characters came too fast",
    254: "more errors than it can remember",
}
# Bits of its registers.
RATE, END_OF_BURST, INHIBIT, ABORT, PLL_UNLOCKED, RUBIDIUM_UNLOCKED = 1 << 1, 1 << 3, 1 << 4, 1 << 5, 1 << 6, 1 << 7
POWER_ON = 1 << 7
BUSY, BURST = 1 << 1, 1 << 2
COMPLAINTS = {
    RATE: "a trigger came while the DG645 was busy, and was lost: make the period longer",
    INHIBIT: "the DG645's inhibit input held a trigger back",
    ABORT: "the DG645 broke a cycle off",
    PLL_UNLOCKED: "the DG645's clock is not locked to its reference",
    RUBIDIUM_UNLOCKED: "the DG645's rubidium clock is not locked",
}
STOPPED_S = 1.0  # how long it may take to stop


class DG645(PortTrigger):
    """A Stanford DG645.

    Parameters
    ----------
    link
        Opened with this module's `TERMINATOR`. `close` closes it.

    Raises
    ------
    TriggerError
        Nothing answers, or something else does.
    """

    def __init__(self, link: Link) -> None:
        self._link = link
        self._dialogue = Dialogue(link, NAME, "Stanford DG645")
        self._identity, self._limits = self._dialogue.identity, LIMITS
        self._train: PulseTrain | None = None
        self._fired = False
        self._boot = 1
        self._events = 0  # of the instrument's register since it was armed
        self._complaints: list[str] = []
        link.send("*CLS")
        self._errors()

    def configure(self, train: PulseTrain) -> PulseTrain:
        """Set the burst up; return it as it will be. The levels of the outputs stay as they are."""
        train = fitted(train, LIMITS)
        self._train = None
        self.abort()
        self._set(train)
        self._train = train
        return train

    def arm(self) -> None:
        """Get ready; where it was restarted or set by hand, set it up again."""
        if self._train is None:
            raise TriggerError("the DG645 has no burst to make: configure it before it is armed")
        self.abort()
        self._set(self._train)
        self._read_registers()
        self._events = 0
        self._complaints.clear()

    def fire(self) -> None:
        """Start the burst."""
        self._fired = True
        self._link.send("*TRG")
        try:
            refused = self._errors()
        except TriggerError:  # it may run or not: its registers show it
            self._complaints.append("the DG645 did not confirm that it started")
            return
        if refused:
            raise TriggerError(f"{self._link.url}: the DG645 refuses to start: {refused}")

    def status(self) -> TriggerStatus:
        """Return what its registers show."""
        running = self._read_registers()
        complaints = [*self._complaints, *(words for bit, words in COMPLAINTS.items() if self._events & bit)]
        if self._fired and not running and not self._events & END_OF_BURST:
            complaints.append("the DG645 did not come to the end of a burst: it did not start, or was stopped")
        return TriggerStatus(running, boot=self._boot, complaints=tuple(complaints))

    def abort(self) -> None:
        """Stop, outputs low."""
        self._fired = False
        if not self._read_registers():
            return
        for command in ("TSRC 5", "BURM 0", "DLAY 2,0,0"):  # another delay ends the cycle that is under way
            self._link.send(command)
        deadline = time.monotonic() + STOPPED_S
        while self._read_registers():
            if time.monotonic() >= deadline:
                raise TriggerError(f"{self._link.url}: the DG645 does not stop: switch it off")

    def _set(self, train: PulseTrain) -> None:
        """Set whatever is not as the train needs it."""
        projector, camera = train.projector, train.camera
        settings = {
            "TSRC": (5,),  # single shots
            "ADVT": (0,),  # no hold-off, no prescaling
            "BURM": (1,),
            "BURT": (0,),
            "BURD": (0.0,),
            "BURC": (ENDLESS if train.count is None else train.count,),
            "BURP": (train.period_s,),
            # A, C, E and G from T0, then B, D, F and H from those; nothing may outlast the outputs in use.
            "DLAY 2": (0, projector.delay_s),
            "DLAY 4": (0, camera.delay_s),
            "DLAY 6": (0, 0.0),
            "DLAY 8": (0, 0.0),
            "DLAY 3": (2, projector.width_s),
            "DLAY 5": (4, camera.width_s),
            "DLAY 7": (6, 0.0),
            "DLAY 9": (8, 0.0),
            "LPOL 1": (1,),
            "LPOL 2": (1,),
        }
        for setting, values in settings.items():
            if self._holds(setting, values):
                continue
            name, _, index = setting.partition(" ")
            command = f"{name} " + ",".join([*index.split(), *map(_written, values)])
            self._link.send(command)
            if not self._holds(setting, values):
                reason = self._errors() or "it does not say why"
                raise TriggerError(f"{self._link.url}: the DG645 does not take {command!r}: {reason}")

    def _holds(self, setting: str, values: tuple[float, ...]) -> bool:
        """Return whether the instrument answers the values that it should."""
        name, _, index = setting.partition(" ")
        number = r"[-+]?\d+(?:\.\d*)?(?:[Ee][-+]?\d+)?"
        said = self._dialogue.ask(f"{name}? {index}".strip(), ",".join([number] * len(values)))
        return all(
            abs(float(kept) - value) < LIMITS.tick_s / 2 for kept, value in zip(said.split(","), values, strict=True)
        )

    def _read_registers(self) -> bool:
        """Note what the registers show, and return whether a burst is under way.

        Reading clears them: what was in an answer that is lost is lost too, and a burst then counts as unfinished.
        """
        running = int(self._dialogue.ask("*STB?", r"\d+")) & (BUSY | BURST) != 0
        self._events |= int(self._dialogue.ask("INSR?", r"\d+"))
        if int(self._dialogue.ask("*ESR?", r"\d+")) & POWER_ON:
            self._boot += 1
            self._complaints.append("the DG645 was switched off and on")
        return running

    def _errors(self) -> str:
        """Empty the queue of errors; return them in words."""
        codes: list[int] = []
        while len(codes) < 20 and (code := int(self._dialogue.ask("LERR?", r"\d+"))):
            codes.append(code)
        return ", ".join(f"{ERRORS.get(code, 'an error that its manual does not list')} ({code})" for code in codes)


def _written(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:.9f}"


def open_dg645(settings: TriggerSettings) -> DG645:
    """Open the one that a rig's settings name."""
    refuse_outputs(settings)
    refuse_inputs(settings)
    return open_port(settings, BAUDS, TERMINATOR, DG645)
