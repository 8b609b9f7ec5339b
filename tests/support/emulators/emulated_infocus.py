"""A projector with InFocus's RS-232 commands, from the manuals of LP840, IN42 and IN5533.

Commands are (AAA?) to read and (AAA1) to write; reading is answered with (range, value), what is not understood with ?,
and what comes too soon after the one before is lost. A number beyond the range sets the largest.

The manuals do not say, and this emulator assumes: what (PWR?) is answered with (`power_answer`), whether commands are
echoed, and that a write is otherwise not answered.
"""

import time

from support.emulators.emulated_line import Emulator

RANGES = {"PWR": (0, 1), "BLK": (0, 1), "SRC": (0, 5), "LMP": (0, 32766)}


class InFocusProjector(Emulator):
    """A projector on a pseudo-terminal."""

    TERMINATORS = b")"

    def __init__(self, *, echo: bool = False, pause_s: float = 0.0, power_answer: str = "(0-1, {})") -> None:
        self.echo = echo
        self.pause_s = pause_s
        self.power_answer = power_answer
        self.write_only: set[str] = set()
        self.obeys = True
        self.switching_s = 0.0
        """How long it goes on saying what it was, after it was switched."""
        self.too_soon = 0
        """Commands that were lost because they came too soon after the one before."""
        self._last_s = float("-inf")
        super().__init__()

    def restart(self) -> None:
        """Be in standby, at its first source."""
        self.settings = {"PWR": 0, "BLK": 0, "SRC": 0, "LMP": 42}
        self._switched_s = float("-inf")
        self._was = 0

    def answer(self, line: str) -> list[str]:
        """Obey a command; return what is said to it."""
        now_s = time.monotonic()
        soon = now_s - self._last_s < self.pause_s
        self._last_s = now_s
        if soon:
            self.too_soon += 1
            return []
        _, bracket, command = line.rpartition("(")
        name, what = command[:3], command[3:]
        echo = f"({command})" if self.echo else ""
        if not bracket or name not in RANGES or not (what == "?" or what.isdigit()):
            return ["?"]
        least, most = RANGES[name]
        if what == "?":
            if name in self.write_only or (name in ("BLK", "SRC") and not self.settings["PWR"]):
                return ["?"]
            if name == "PWR":
                late = now_s - self._switched_s < self.switching_s
                return [echo + self.power_answer.format(self._was if late else self.settings["PWR"])]
            return [f"{echo}({least}-{most}, {self.settings[name]})"]
        if self.obeys:
            if name == "PWR":
                self._was, self._switched_s = self.settings["PWR"], now_s
            self.settings[name] = min(int(what), most)
        return [echo] if echo else []
