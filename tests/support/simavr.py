"""The trigger box's firmware, built by gcc-avr and run by libsimavr in a process of its own."""

import os
import select
import shutil
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from threading import Lock

import pytest
from support.missing import skip_but_fail_in_ci

from hardware.link import Link

FIRMWARE = Path(__file__).resolve().parents[2] / "hardware" / "firmware"
#: One cycle is 62.5 ns.
CYCLES = 16_000_000
PINS = {"projector": "P", "camera": "C", "strobe": "S", "vsync": "V"}


class Board:
    """A board that runs the firmware.

    Parameters
    ----------
    build
        Where `make simavr` put emulator and firmware.
    edges
        The file that its pins' edges are written to.
    speed
        How many times as fast as a true board, at most; 0: as fast as it goes, about six times.
    """

    def __init__(self, build: Path, edges: Path, speed: float) -> None:
        self._edges = edges
        command = [build / "simavr_host", build / "trigger_box.elf", edges, str(speed)]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._links: list[Link] = []
        self._talking = Lock()  # tests have threads
        assert self.process.stdout is not None
        for line in self.process.stdout:  # libelf's messages come first
            if line.startswith("PTY "):
                self.port = line.split()[1]
                return
        raise AssertionError(f"the emulator ended with {self.process.wait()}")

    def link(self, timeout_s: float = 1.0) -> Link:
        """Open its serial port."""
        link = Link(self.port, timeout_s=timeout_s)
        self._links.append(link)
        return link

    def tell(self, command: str) -> list[str]:
        """Have the emulator do something, as its source lists; return what it answers."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        with self._talking:
            self.process.stdin.write(f"{command}\n")
            self.process.stdin.flush()
            answered, _, _ = select.select([self.process.stdout], [], [], 10)
            assert answered, f"the emulator does not answer {command!r}"
            answer = self.process.stdout.readline().split()
        assert answer[:1] == ["OK"], answer
        return answer[1:]

    def cycle(self) -> int:
        """Return how far it is."""
        return int(self.tell("sync")[0])

    def outputs(self) -> tuple[bool, bool]:
        """Return whether projector and camera output are high."""
        _, projector, camera = self.tell("sync")
        return projector == "1", camera == "1"

    def edges(self, pin: str) -> tuple[list[int], list[int]]:
        """Return the cycles in which a pin rose and fell."""
        self.tell("sync")
        whole, _, _ = self._edges.read_text().rpartition("\n")
        rows = [line.split(",") for line in whole.splitlines()[1:]]
        rises, falls = ([int(cycle) for cycle, name, to in rows if (name, to) == (PINS[pin], level)] for level in "10")
        return rises, falls

    def stop(self) -> None:
        """Stop it in its tracks, as if it hung."""
        os.kill(self.process.pid, signal.SIGSTOP)

    def go_on(self) -> None:
        """Let it go on."""
        os.kill(self.process.pid, signal.SIGCONT)

    def close(self) -> None:
        """End it the way a test that dies does: by the end of its input."""
        for link in self._links:
            link.close()
        with suppress(ProcessLookupError):
            self.go_on()
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        with suppress(BrokenPipeError):
            self.process.stdin.close()
        try:
            self.process.wait(5)
        finally:
            self.process.kill()
            self.process.wait()
            self.process.stdout.close()


@pytest.fixture(scope="session")
def simavr_build(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build firmware and emulator. CI installs what that takes, so there a missing part is a failure."""
    missing = [tool for tool in ("make", "cc", "avr-gcc") if shutil.which(tool) is None]
    missing += [str(file) for file in [Path("/usr/include/simavr/sim_avr.h")] if not file.exists()]
    if missing:
        skip_but_fail_in_ci(
            f"the emulator needs {', '.join(missing)}: install make, gcc, gcc-avr, avr-libc, libsimavr-dev, libelf-dev"
        )
    build = tmp_path_factory.mktemp("firmware")
    made = subprocess.run(["make", "-C", FIRMWARE, "simavr", f"BUILD={build}"], capture_output=True, text=True)
    assert made.returncode == 0, made.stdout + made.stderr
    return build


@pytest.fixture
def simavr_board(simavr_build: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Board]]:
    """Return what starts a board. Each of them must end, and those that still run with both outputs low.

    On a busy machine an emulated board's clock is slow, and its bursts last longer.
    """
    monkeypatch.setattr("hardware.trigger.box.OVERDUE_S", 120.0)
    boards: list[Board] = []

    def start(speed: float = 2.0) -> Board:
        boards.append(Board(simavr_build, tmp_path / f"edges_{len(boards)}.csv", speed))
        return boards[-1]

    yield start
    left_high = []
    for board in boards:
        try:
            if board.process.poll() is None:
                left_high.append(any(board.outputs()))
        finally:
            board.close()
    assert not any(left_high), "an output was left high"
