"""A pulse generator with the command language of Quantum Composers, from the manuals of the 9500+ series and BNC 577.

Commands end with CR LF, and to every command comes one line, CR LF behind it: ``ok``, a value, or ``?n``. With echo on,
the command comes back before it. Keywords have a long and a short form, in either case, and nothing between them.

The manuals do not say, and this emulator assumes: a burst's state falls back to 0 one period after its last pulse
began; settings may be changed while it runs; ``*RST`` leaves the echo as it is.
"""

import re

from support.emulators.emulated_line import Burst, Emulator

BAD_PREFIX, NO_KEYWORD, BAD_KEYWORD, NO_PARAMETER, BAD_PARAMETER, QUERY_ONLY, NO_QUERY, UNAVAILABLE, OUT_OF_BOUNDS = (
    f"?{code}" for code in range(1, 10)
)


def _number(low: float, high: float, text: str) -> str | float:
    try:
        value = float(text)
    except ValueError:
        return BAD_PARAMETER
    return value if low <= value <= high else OUT_OF_BOUNDS


def _choice(names: dict[str, str], text: str) -> str:
    return names.get(text.upper(), BAD_PARAMETER)


def _forms(*words: str) -> dict[str, str]:
    """Return what each long and short form, as NORMal, stands for."""
    known = {}
    for word in words:
        short = "".join(letter for letter in word if not letter.islower())
        known.update({short: short, word.upper(): short})
    return known


BOOLEAN = {"0": "0", "OFF": "0", "1": "1", "ON": "1"}
SYSTEM_MODES = _forms("NORMal", "SINGle", "BURSt", "DCYCle")

#: keyword path -> (default, how a parameter is read). Times have nine decimals, as in the manual's examples.
SYSTEM = {
    ("STATE",): ("0", lambda text: _choice(BOOLEAN, text)),
    ("MODE",): ("NORM", lambda text: _choice(SYSTEM_MODES, text)),
    ("PER",): (1e-4, lambda text: _number(100e-9, 5000.0, text)),
    ("BCO",): (10, lambda text: _number(1, 1_000_000, text)),
    ("TRIG", "MODE"): ("DIS", lambda text: _choice(_forms("DISabled", "TRIGgered"), text)),
    ("TRIG", "LEV"): (2.5, lambda text: _number(0.2, 15.0, text)),
    ("TRIG", "EDGE"): ("RIS", lambda text: _choice(_forms("RISing", "FALLing"), text)),
}
CHANNEL = {
    ("STATE",): ("0", lambda text: _choice(BOOLEAN, text)),
    ("WIDT",): (1e-6, lambda text: _number(10e-9, 999.99999999975, text)),
    ("DEL",): (0.0, lambda text: _number(-999.99999999975, 999.99999999975, text)),
    ("SYNC",): ("T0", lambda text: _choice({"T0": "T0", **{f"CH{c}": f"CH{c}" for c in "ABCD"}}, text)),
    ("POL",): ("NORM", lambda text: _choice(_forms("NORMal", "COMPlement", "INVerted"), text)),
    ("CMOD",): ("NORM", lambda text: _choice(SYSTEM_MODES, text)),
    ("OUTP", "MODE"): ("TTL", lambda text: _choice(_forms("TTL", "ADJustable"), text)),
}
#: Long and short form of every keyword; STATE and MODE are also taken as STAT and MOD.
KEYWORDS = {
    **_forms("PERiod", "BCOunter", "TRIGger", "LEVel", "WIDTh", "DELay", "SYNC", "POLarity", "CMODe", "OUTPut"),
    **{"STATE": "STATE", "STAT": "STATE", "MODE": "MODE", "MOD": "MODE", "EDGE": "EDGE", "EDG": "EDGE"},
}


class QuantumComposersEmulator(Emulator):
    """The instrument.

    Parameters
    ----------
    identity
        What ``*IDN?`` is answered.
    echo
        Whether commands come back before their answer.
    channels
        How many outputs it has.
    trigger_keyword
        "TRIG", or "EXT" as older models call the group of the external trigger.
    """

    def __init__(
        self,
        *,
        identity: str = "QC,9524,06312,2.4.3-2.0.11",
        echo: bool = False,
        channels: int = 4,
        trigger_keyword: str = "TRIG",
        network: bool = False,
        speed: float = 1.0,
    ) -> None:
        self.identity = identity
        self.echo = echo
        self.busy = False
        """Every command but a query is answered ``?8``."""
        self.bursts: list[Burst] = []
        """Every burst that was started."""
        self._count = channels
        self._trigger_keyword = trigger_keyword
        super().__init__(network=network, speed=speed)

    def restart(self) -> None:
        """Switch off and on again: everything at its default, outputs off."""
        with self._lock:
            self._stop()
            self._input.clear()
            self._system = {path: default for path, (default, _) in SYSTEM.items()}
            self._channels = [{path: default for path, (default, _) in CHANNEL.items()} for _ in range(self._count)]
            self._armed = False

    @property
    def running(self) -> bool:
        """Whether pulses are being made."""
        with self._lock:
            burst = self.bursts[-1] if self.bursts else None
            return burst is not None and self.now < min(burst.start_s + burst.count * burst.period_s, burst.stopped_s)

    def press_stop(self) -> None:
        """Press the STOP button at the front."""
        with self._lock:
            self._stop()

    def answer(self, line: str) -> list[str]:
        """Return the echo, where it is on, and the answer."""
        return [*([line] if self.echo else []), self._answer(line.strip())]

    def _stop(self) -> None:
        if self.running:
            self.bursts[-1].stopped_s = self.now
        self._armed = False

    def _answer(self, line: str) -> str:
        header, _, parameter = line.partition(" ")
        query = header.endswith("?")
        header = header.removesuffix("?")
        parameter = parameter.strip()
        if self.busy and not query:
            return UNAVAILABLE
        if header.startswith("*"):
            return self._common(header.upper(), query)
        if not header.startswith(":"):
            return BAD_PREFIX
        words = header[1:].split(":")
        group = re.fullmatch(r"(PULSE|PULS|SPULSE|SPULS)(\d*)", words[0].upper())
        if group is None:
            return BAD_KEYWORD if words[0] else NO_KEYWORD
        if len(words) == 1:
            return NO_KEYWORD
        number = 0 if group[1].startswith("S") else int(group[2] or "1")
        if number > len(self._channels):
            return BAD_KEYWORD
        path = tuple(self._keyword(word) for word in words[1:])
        table, values = (SYSTEM, self._system) if number == 0 else (CHANNEL, self._channels[number - 1])
        if path not in table:
            return NO_KEYWORD if any(known[: len(path)] == path for known in table) else BAD_KEYWORD
        if query:
            return self._spelled(path, number, values[path])
        if not parameter:
            return NO_PARAMETER
        value = table[path][1](parameter)
        if isinstance(value, str) and value.startswith("?"):
            return value
        if path == ("BCO",):
            value = int(value)
        values[path] = value
        if number == 0 and path == ("STATE",):
            self._switch(value == "1")
        return "ok"

    def _keyword(self, word: str) -> str:
        word = word.upper()
        if word in ("TRIG", "TRIGGER", "EXT", "EXTERNAL"):
            return "TRIG" if word.startswith(self._trigger_keyword) else word + "?"
        return KEYWORDS.get(word, word + "?")

    def _spelled(self, path: tuple[str, ...], number: int, value: str | float) -> str:
        if number == 0 and path == ("STATE",):
            return "1" if self.running or self._armed else "0"
        if isinstance(value, float):
            return f"{value:.9f}" if path[-1] in ("PER", "WIDT", "DEL") else f"{value:.2f}"
        return str(value)

    def _common(self, name: str, query: bool) -> str:
        if name == "*IDN":
            return self.identity if query else QUERY_ONLY
        if query:
            return NO_QUERY if name in ("*RST", "*TRG") else BAD_KEYWORD
        if name == "*RST":
            self.restart()
            return "ok"
        if name == "*TRG":
            if not self._armed:
                return UNAVAILABLE
            self._begin()
            return "ok"
        return BAD_KEYWORD

    def _switch(self, on: bool) -> None:
        self._stop()
        if not on:
            return
        if self._system["TRIG", "MODE"] == "TRIG":
            self._armed = True
        else:
            self._begin()

    def _begin(self) -> None:
        count = {"SING": 1, "BURS": self._system["BCO",]}.get(str(self._system["MODE",]), float("inf"))
        outputs = {
            letter: (float(channel["DEL",]), float(channel["WIDT",]))
            for letter, channel in zip("ABCDEFGH", self._channels, strict=False)
            if channel["STATE",] == "1"
        }
        self.bursts.append(Burst(self.now, float(self._system["PER",]), float(count), outputs))
