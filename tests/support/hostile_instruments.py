"""Instruments whose answers are damaged, or nonsense, at the other end of a driver's line."""

import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest import mock

import numpy as np
from support.byte_script import AnsweringPort
from support.damage import damaged
from support.file_samples import REFUSED

from hardware.link import Link
from hardware.projector import infocus, pjlink
from hardware.projector.infocus import InFocus
from hardware.projector.pjlink import PJLink
from hardware.pulses import Pulse, PulseTrain
from hardware.trigger import _dialogue, box, dg645, quantum_composers
from hardware.trigger.box import TriggerBox, crc8
from hardware.trigger.dg645 import DG645
from hardware.trigger.quantum_composers import QuantumComposers
from tikernels.errors import Error

ANSWERED = "went through"
_TRAIN = PulseTrain(0.005, 6, Pulse(0.0, 0.0001), Pulse(0.001, 0.00025))
#: What an answer, or a number in it, is replaced by.
_NONSENSE = (b"", b"\x1b[2J", b"-1", b"1e999", b"nan", b"9" * 400, b"9" * 5000, b"0", b"\xff", b"?" * 2000, b"1.5.1")

Answer = Callable[[bytes], bytes]


def _dg645() -> Answer:
    fixed = {"*IDN?": "Stanford Research Systems,DG645,s/n003458,ver1.16.116", "BURC?": "6", "BURP?": "0.005"}
    fixed |= {"TSRC?": "5", "BURM?": "1", "BURD?": "0", "LPOL? 1": "1", "LPOL? 2": "1", "INSR?": "8"}
    fixed |= {f"DLAY? {i}": f"{i // 2 * 2 if i % 2 else 0},0.0" for i in range(2, 10)}
    fixed |= {"DLAY? 3": "2,0.0001", "DLAY? 4": "0,0.001", "DLAY? 5": "4,0.00025", "DLAY? 7": "6,0", "DLAY? 9": "8,0"}

    def answer(sent: bytes) -> bytes:
        asked = sent.decode().strip()
        return (fixed.get(asked, "0") + "\r\n").encode() if "?" in asked else b""

    return answer


def _quantum_composers() -> Answer:
    told: dict[str, str] = {"*IDN?": "QC,9514,01234,2.2.1", ":PULS0:STATE?": "0"}

    def answer(sent: bytes) -> bytes:
        asked = sent.decode().strip()
        if asked.endswith("?"):
            return (told.get(asked, "0") + "\r\n").encode()
        name, _, value = asked.partition(" ")
        if name != ":PULS0:STATE":
            told[f"{name}?"] = value
        return b"ok\r\n"

    return answer


def _box() -> Answer:
    ticks = "boot=7 cause=2 period=10000 count=6 projector=0,200 camera=2000,500 strobe=1 vsync=1"
    said = {
        "ID": "colorphase-trigger-box firmware=1.0.0 board=atmega328p protocol=1",
        "LIMITS": "tick_ns=500 min_period=400 max_period=2000000000 min_width=100 min_gap=100 max_count=4294967295",
        "SET": ticks,
        "ARM": ticks,
        "STATUS": "state=DONE boot=7 cause=2 up=5 tick=9 pulses=6 strobes=6 vsyncs=6 noise=0 strays=0 garbled=0",
        "LOG": "from=0 strobes=6 0,9 1,9 2,9 3,9 4,9 5,9",
    }

    def answer(sent: bytes) -> bytes:
        number, command = sent.decode().partition("*")[0].split(" ")[:2]
        return f"{number} OK {said.get(command, '')}".rstrip().encode()

    return answer


def _infocus() -> Answer:
    said = {"PWR": "(0-1, 1)", "LMP": "(0-32766, 42)", "BLK": "(0-1, 0)", "SRC": "(0-5, 3)"}
    return lambda sent: said.get(sent[1:4].decode(), "?").encode() + b"\r\n"


def _pjlink() -> Answer:
    said = {"POWR": "1", "INF1": "Maker", "INF2": "Model", "AVMT": "30", "ERST": "000000", "LAMP": "1234 1"}
    said |= {"INPT": "31", "INST": "11 31 32"}

    def answer(sent: bytes) -> bytes:
        command = sent.decode().rpartition("%1")[2][:4]
        return f"%1{command}={said.get(command, 'OK')}\r".encode()

    return answer


class _Port(AnsweringPort):
    """A port, and a socket, behind which somebody answers, now and then nonsense."""

    def __init__(self, answer: Answer, rng: np.random.Generator, greeting: bytes = b"", seal: bool = False) -> None:
        super().__init__()
        self._answer, self._rng, self._seal = answer, rng, seal
        self._share = float(rng.choice([0.05, 0.3]))
        self._arrived = self._spoilt(greeting)

    def _spoilt(self, said: bytes) -> bytes:
        if self._rng.random() < self._share:
            if self._rng.random() < 0.5:
                said = damaged(said, self._rng, text=bool(self._rng.integers(2)))
            else:
                nonsense = _NONSENSE[self._rng.integers(len(_NONSENSE))]
                numbers = list(re.finditer(rb"\d+", said))
                if numbers and self._rng.random() < 0.7:
                    number = numbers[self._rng.integers(len(numbers))]
                    said = said[: number.start()] + nonsense + said[number.end() :]
                else:
                    said = nonsense + said[-1:]
        return _sealed(said) if self._seal else said

    def write(self, sent: bytes) -> int:
        self._arrived += self._spoilt(self._answer(bytes(sent)))
        return len(sent)

    def recv(self, size: int) -> bytes:
        if not self._arrived:
            raise TimeoutError
        return self.read(size)

    def sendall(self, sent: bytes) -> None:
        self.write(sent)

    def settimeout(self, timeout_s: float) -> None:
        pass

    def reset_output_buffer(self) -> None:
        pass

    def close(self) -> None:
        self.is_open = False


def _sealed(said: bytes) -> bytes:
    """Return a line of the box with its checksum, as only a fault of its program can say it."""
    text = said.strip().decode("ascii", "replace").replace("\N{REPLACEMENT CHARACTER}", "?")
    return f"{text}*{crc8(text):02X}\n".encode()


def _use_trigger(open_it: Callable[[Link], Any], link: Link) -> None:
    trigger = open_it(link)
    trigger.configure(_TRAIN)
    trigger.arm()
    trigger.fire()
    trigger.status()
    trigger.status()
    trigger.strobes()
    trigger.abort()


def _use_projector(projector: Any) -> None:
    projector.status()
    projector.blank(True)
    projector.input("31" if isinstance(projector, PJLink) else "3")


#: Whose answers, and what a driver does with them.
INSTRUMENTS: dict[str, tuple[Callable[[], Answer], Callable[[Link], None]]] = {
    "dg645": (_dg645, lambda link: _use_trigger(DG645, link)),
    "quantum-composers": (_quantum_composers, lambda link: _use_trigger(QuantumComposers, link)),
    "box": (_box, lambda link: _use_trigger(lambda line: TriggerBox(line, strobe=True, vsync=True), link)),
    "infocus": (_infocus, lambda link: _use_projector(InFocus("loop://"))),
    "pjlink": (_pjlink, lambda link: _use_projector(PJLink("socket://10.0.0.6:4352"))),
}


@contextmanager
def _impatient(port: Callable[[], _Port]) -> Iterator[None]:
    """Shorten all deadlines, and put such a port in the place of every other."""
    changes: list[tuple[Any, str, Any]] = [
        (_dialogue, "NAME_S", 0.01),
        (_dialogue, "QUIET_S", 0.002),
        (box, "IDENTIFY_S", 0.02),
        (dg645, "STOPPED_S", 0.02),
        (infocus, "PAUSE_S", 0.0),
        (infocus, "ANSWER_S", 0.02),
        (pjlink, "ANSWER_S", 0.02),
    ]
    with ExitStack() as stack:
        for module, name, value in changes:
            stack.enter_context(mock.patch.object(module, name, value))
        stack.enter_context(mock.patch.object(Link, "_opened", lambda self, baud: port()))
        stack.enter_context(mock.patch("socket.create_connection", lambda *_, **__: port()))
        yield


def talk(kind: str, rng: np.random.Generator) -> str:
    """Use an instrument from its opening to its end; return what became of it.

    Raises
    ------
    Exception
        Anything but the project's own errors.
    """
    make_answer, use = INSTRUMENTS[kind]
    terminator = {"dg645": dg645.TERMINATOR, "quantum-composers": quantum_composers.TERMINATOR}.get(kind, b"\n")
    greeting = b"PJLINK 0\r" if kind == "pjlink" else b""
    answer, seal = make_answer(), kind == "box" and rng.random() < 0.8
    with _impatient(lambda: _Port(answer, rng, greeting, seal)):
        link = Link("loop://", terminator=terminator, timeout_s=0.02)
        try:
            use(link)
        except Error as error:
            if "\n" in str(error):
                raise AssertionError(f"{error!r} is not one line") from error
            return REFUSED
    return ANSWERED
