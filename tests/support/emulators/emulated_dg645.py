"""A Stanford Research Systems DG645, from the remote commands in its manual.

Commands end with LF or CR, several on a line are separated by semicolons; letters in either case, spaces at will.
Only queries are answered, CR LF behind; errors wait in a queue of twenty for ``LERR?``.

The manual's summary does not say, and this emulator assumes: a delay cycle takes 60 ns longer than its longest delay,
and a cycle that is due before that is left out (RATE); setting a delay breaks off the cycle that is under way (ABORT),
after which a burst, or internal triggering, goes on; setting the burst, or the trigger's source, lets them end with
that cycle; settings outlive a power cycle, unless `forgets` is set.
"""

import re

from support.emulators.emulated_line import Burst, Emulator

ILLEGAL_VALUE, ILLEGAL_MODE, ILLEGAL_DELAY, ILLEGAL_LINK = 10, 11, 12, 13
UNDEFINED, ILLEGAL_QUERY, ILLEGAL_SET, EXTRA, MISSING = 111, 112, 113, 115, 116
BAD_FLOAT, BAD_INTEGER, TOO_MANY = 118, 120, 254
TRIG, RATE, END_OF_DELAY, END_OF_BURST, INHIBIT, ABORT, PLL_UNLOCK = (1 << bit for bit in range(7))
EXECUTION_ERROR, COMMAND_ERROR, POWER_ON = 1 << 4, 1 << 5, 1 << 7
BUSY, BURST, EVENT_SUMMARY = 1 << 1, 1 << 2, 1 << 5
DEAD_TIME_S = 60e-9
MAX_DELAY_S = 2000.0

#: name -> (default, lowest, highest) of what has one value; a default of type int takes whole numbers.
SETTINGS: dict[str, tuple[float, float, float]] = {
    "TSRC": (5, 0, 6),
    "TRAT": (1000.0, 1e-4, 1e7),
    "TLVL": (1.0, -3.5, 3.5),
    "HOLD": (0.0, 0.0, 1000.0),
    "ADVT": (0, 0, 1),
    "INHB": (1, 0, 5),
    "BURM": (0, 0, 1),
    "BURC": (5, 1, 2**32 - 1),
    "BURP": (100e-6, 100e-9, MAX_DELAY_S),
    "BURD": (0.0, 0.0, MAX_DELAY_S),
    "BURT": (0, 0, 1),
}
#: The same for what each output has, 0 T0, 1 AB, 2 CD, 3 EF, 4 GH.
OUTPUTS: dict[str, tuple[float, float, float]] = {"LAMP": (2.5, 0.5, 5.0), "LOFF": (0.0, -2.0, 2.0), "LPOL": (1, 0, 1)}


class DG645Emulator(Emulator):
    """The instrument; `network` is its port 5025."""

    TERMINATORS = b"\r\n"

    def __init__(
        self,
        *,
        identity: str = "Stanford Research Systems,DG645,s/n003458,ver1.19.118",
        network: bool = False,
        speed: float = 1.0,
    ) -> None:
        self.identity = identity
        self.forgets = False
        """Whether settings are lost when it is switched off."""
        self.inhibited = False
        """Whether its inhibit input is driven."""
        self.bursts: list[Burst] = []
        """Every burst that was triggered."""
        self._settings: dict[str, float] = {}
        self._bursting = False  # what runs is a burst, not single cycles
        super().__init__(network=network, speed=speed)

    def restart(self) -> None:
        """Switch off and on again."""
        with self._lock:
            if self.running:
                self.bursts[-1].stopped_s = self.now
            self._input.clear()
            if self.forgets or not self._settings:
                self._reset()
            self._events = POWER_ON
            self._instrument = 0
            self._errors: list[int] = []
            self._followed: Burst | None = None  # the burst whose end is still to be noted

    @property
    def running(self) -> bool:
        """Whether a burst, or a single delay cycle, is under way."""
        with self._lock:
            burst = self.bursts[-1] if self.bursts else None
            return burst is not None and self.now < min(self._end_s(burst), burst.stopped_s)

    def answer(self, line: str) -> list[str]:
        """Obey the commands of a line; return the answers to its queries."""
        answers = []
        for command in line.split(";"):
            self._note()
            match = re.fullmatch(r"\s*(\*?[A-Za-z]+)\s*(\??)\s*(.*?)\s*", command)
            if not command.strip():
                continue
            if match is None:
                self._fail(UNDEFINED)
                continue
            arguments = [argument.strip() for argument in match[3].split(",")] if match[3] else []
            said = self._obeyed(match[1].upper(), bool(match[2]), arguments)
            if said is not None:
                answers.append(said)
        return answers

    def _reset(self) -> None:
        self._settings = {name: default for name, (default, _, _) in SETTINGS.items()}
        self._outputs = {name: [default] * 5 for name, (default, _, _) in OUTPUTS.items()}
        # Channels 2 to 9 are A to H: from which one, and how much later.
        self._delays: dict[int, tuple[int, float]] = dict.fromkeys(range(2, 10), (0, 0.0))

    def _fail(self, code: int) -> None:
        self._events |= EXECUTION_ERROR if code < 100 else COMMAND_ERROR
        self._errors.append(code if len(self._errors) < 19 else TOO_MANY)
        del self._errors[20:]

    def _obeyed(self, name: str, query: bool, arguments: list[str]) -> str | None:
        if name.startswith("*") or name in ("LERR", "INSR"):
            return self._common(name, query, arguments)
        if not query and name == "DLAY":
            self._break_off()
        elif not query and name.startswith("BUR") and self._bursting:
            self._end_with_this_cycle()
        elif not query and name == "TSRC" and not self._bursting:
            self._end_with_this_cycle()
        if name in SETTINGS:
            return self._one(self._settings, name, name, SETTINGS[name], query, arguments)
        if name in OUTPUTS:
            output = self._whole(arguments[:1], 0, 4)
            if output is None:
                return None
            return self._one(self._outputs[name], output, name, OUTPUTS[name], query, arguments[1:])
        if name == "DLAY":
            return self._delay(query, arguments)
        self._fail(UNDEFINED)
        return None

    def _one(
        self, store: object, key: object, name: str, kind: tuple[float, float, float], query: bool, arguments: list[str]
    ) -> str | None:
        default, low, high = kind
        if query:
            value = store[key]
            return str(value) if isinstance(default, int) else f"{value:.12f}"
        if len(arguments) != 1:
            self._fail(EXTRA if arguments else MISSING)
            return None
        try:
            value = int(arguments[0]) if isinstance(default, int) else float(arguments[0])
        except ValueError:
            self._fail(BAD_INTEGER if isinstance(default, int) else BAD_FLOAT)
            return None
        if not low <= value <= high:
            self._fail(ILLEGAL_VALUE)
            return None
        store[key] = value
        if name == "TSRC" and value == 0:
            self._bursting = False
            self.bursts.append(Burst(self.now, 1 / self._settings["TRAT"], float("inf"), self._pulses()))
            self._leave_out(self.bursts[-1])
        return None

    def _whole(self, arguments: list[str], low: int, high: int) -> int | None:
        if not arguments:
            self._fail(MISSING)
        elif not re.fullmatch(r"\d+", arguments[0]):
            self._fail(BAD_INTEGER)
        elif not low <= int(arguments[0]) <= high:
            self._fail(ILLEGAL_VALUE)
        else:
            return int(arguments[0])
        return None

    def _delay(self, query: bool, arguments: list[str]) -> str | None:
        channel = self._whole(arguments[:1], 2, 9)
        if channel is None:
            return None
        if query:
            return f"{self._delays[channel][0]},{self._delays[channel][1]:+.12f}"
        if len(arguments) != 3:
            self._fail(MISSING if len(arguments) < 3 else EXTRA)
            return None
        origin = self._whole(arguments[1:2], 0, 9)
        if origin is None:
            return None
        try:
            delay_s = float(arguments[2])
        except ValueError:
            self._fail(BAD_FLOAT)
            return None
        step: int | None = origin
        while step is not None and step >= 2:
            if step == channel:
                self._fail(ILLEGAL_LINK)
                return None
            step = self._delays[step][0]
        before = self._delays[channel]
        self._delays[channel] = (origin, delay_s)
        if not all(0 <= self._from_start(each) <= MAX_DELAY_S for each in self._delays):
            self._delays[channel] = before
            self._fail(ILLEGAL_DELAY)
        return None

    def _from_start(self, channel: int) -> float:
        origin, delay_s = self._delays[channel]
        return delay_s + (self._from_start(origin) if origin >= 2 else 0.0)

    def _common(self, name: str, query: bool, arguments: list[str]) -> str | None:
        if arguments:
            self._fail(EXTRA)
            return None
        if query:
            if name == "*IDN":
                return self.identity
            if name == "*OPC":
                return "1"
            if name == "LERR":
                return str(self._errors.pop(0) if self._errors else 0)
            if name == "INSR":
                said, self._instrument = self._instrument, 0
                return str(said)
            if name == "*ESR":
                said, self._events = self._events, 0
                return str(said)
            if name == "*STB":
                return str(self._status())
            self._fail(ILLEGAL_QUERY if name in ("*RST", "*CLS", "*TRG") else UNDEFINED)
        elif name == "*CLS":
            self._events = self._instrument = 0
            self._errors.clear()
        elif name == "*RST":
            self._stop()
            self._reset()
        elif name == "*TRG":
            self._trigger()
        else:
            self._fail(ILLEGAL_SET if name in ("*IDN", "*STB", "*ESR", "LERR", "INSR") else UNDEFINED)
        return None

    def _status(self) -> int:
        status = EVENT_SUMMARY if self._events else 0
        if self.running:
            burst = self.bursts[-1]
            since = self.now - burst.start_s
            if since >= 0 and since % burst.period_s < self._cycle_s(burst):
                status |= BUSY
            if self._bursting:
                status |= BURST
        return status

    def _cycle_s(self, burst: Burst) -> float:
        return max(delay + width for delay, width in burst.outputs.values()) + DEAD_TIME_S

    def _end_s(self, burst: Burst) -> float:
        return burst.start_s + (burst.count - 1) * burst.period_s + self._cycle_s(burst)

    def _trigger(self) -> None:
        if self._settings["TSRC"] != 5:
            self._fail(ILLEGAL_MODE)
        elif self.running:
            self._instrument |= RATE
        elif self.inhibited and self._settings["INHB"]:
            self._instrument |= INHIBIT
        else:
            burst_mode = self._bursting = bool(self._settings["BURM"])
            period_s = self._settings["BURP"] if burst_mode else MAX_DELAY_S
            burst = Burst(
                self.now + (self._settings["BURD"] if burst_mode else 0.0),
                period_s,
                self._settings["BURC"] if burst_mode else 1,
                self._pulses(),
            )
            self.bursts.append(burst)
            self._followed = burst
            self._instrument |= TRIG
            self._leave_out(burst)

    def _leave_out(self, burst: Burst) -> None:
        """Leave every second cycle out, or two of three, where one is due while another is under way."""
        if burst.count > 1 and self._cycle_s(burst) > burst.period_s:
            self._instrument |= RATE
            burst.period_s *= -(-self._cycle_s(burst) // burst.period_s)

    def _pulses(self) -> dict[str, tuple[float, float]]:
        pulses = {}
        for name, first in (("AB", 2), ("CD", 4), ("EF", 6), ("GH", 8)):
            start, end = sorted((self._from_start(first), self._from_start(first + 1)))
            pulses[name] = (start, end - start)
        return pulses

    def _stop(self) -> None:
        if self.running:
            self.bursts[-1].stopped_s = self.now
            self._instrument |= ABORT
        self._followed = None

    def _break_off(self) -> None:
        if not self._status() & BUSY:
            return
        self._instrument |= ABORT
        if self._settings["TSRC"] != 0 and not self._bursting:
            self.bursts[-1].stopped_s = self.now
            self._followed = None

    def _end_with_this_cycle(self) -> None:
        if self.running:
            burst = self.bursts[-1]
            burst.count = max(0, (self.now - burst.start_s) // burst.period_s + 1)
            self._bursting = False
            self._followed = None

    def _note(self) -> None:
        """Note in the register what happened since."""
        burst = self._followed
        if burst is not None and self.now >= self._end_s(burst):
            self._instrument |= END_OF_DELAY | (END_OF_BURST if self._settings["BURM"] else 0)
            self._followed = None
