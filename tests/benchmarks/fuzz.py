"""Damaged files, hostile frames and instruments that answer nonsense: what becomes of each.

Usage: python tests/benchmarks/fuzz.py [CASES [SEED [KIND ...]]]

CASES (3000) are shared out over all kinds: a fourth are frames, one in forty is a burst with an instrument, the rest
are files, as many of each kind. A kind is a name of the table, as recording.mkv. Two processes read, with 2 GB more
than they begin with; one that takes longer than 10 s for a case is ended, and another one goes on. The same seed gives
the same cases. Exit code 1: something was found.
"""

import json
import os
import select
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import _tests_path
from support.file_samples import OTHERWISE, SAMPLES, make_samples
from support.fuzz_cases import FRAMES
from support.hostile_instruments import INSTRUMENTS

import tikernels

_TESTS = Path(_tests_path.__file__).resolve().parents[1]
_PROCESSES = 2
# Longer than any of them may take; the first ones wait until their kernels are compiled.
_HANG_S, _START_S = 10.0, 300.0
_SHARES = {FRAMES: 0.25, **dict.fromkeys(INSTRUMENTS, 0.025 / len(INSTRUMENTS))}
_FOUND = ("traceback", "memory", "hang", "crash")


class _Child:
    """A process that goes through cases; another one takes its place when it dies."""

    def __init__(self, kinds: Sequence[str], samples: Path) -> None:
        self._kinds, self._samples = kinds, samples
        self._process: subprocess.Popen[str] | None = None

    def run(self, kind: str, seed: int) -> dict[str, Any]:
        """Return what became of a case."""
        if self._process is None:
            command = [sys.executable, "-m", "support.fuzz_child", ",".join(self._kinds), str(self._samples)]
            self._process = subprocess.Popen(
                command,
                cwd=_TESTS,
                env=os.environ | {"PYTHONPATH": f"{_TESTS}:{_TESTS.parent}", "OPENBLAS_NUM_THREADS": "1"},
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
            )
            if self._line(_START_S) != "ready\n":
                raise SystemExit(f"the process for {', '.join(self._kinds)} did not start")
        with suppress(BrokenPipeError):
            self._process.stdin.write(json.dumps([kind, seed]) + "\n")
            self._process.stdin.flush()
        line = self._line(_HANG_S)
        if not line:
            outcome = "hang" if self._process.poll() is None else "crash"
            self.close()
            return {"outcome": outcome, "where": ""}
        return json.loads(line)

    def _line(self, timeout_s: float) -> str:
        """Return the next line; nothing where none comes in time, or the process has ended."""
        ready, _, _ = select.select([self._process.stdout], [], [], timeout_s)
        return self._process.stdout.readline() if ready else ""

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process.stdin.close()
            self._process.stdout.close()
            self._process = None


@contextmanager
def _child(kinds: Sequence[str], samples: Path) -> Iterator[_Child]:
    child = _Child(kinds, samples)
    try:
        yield child
    finally:
        child.close()


def _go_through(kinds: Sequence[str], counts: dict[str, int], first: int, samples: Path) -> dict[str, Counter[str]]:
    """Run cases of some kinds; print what is found at once."""
    table: dict[str, Counter[str]] = defaultdict(Counter)
    seen: Counter[str] = Counter()
    with _child(kinds, samples) as child:
        for kind in kinds:
            for seed in range(first, first + counts[kind]):
                begin_s = time.monotonic()
                result = child.run(kind, seed)
                table[kind][result["outcome"]] += 1
                table[kind]["unnoticed"] += bool(result.get("unnoticed"))
                table[kind]["ms"] += round(1000 * (time.monotonic() - begin_s))
                if result["outcome"] in _FOUND or result.get("unnoticed"):
                    where = result.get("where", "").strip()
                    seen[where[-300:]] += 1
                    if seen[where[-300:]] == 1:
                        print(f"{kind} {seed}: {result['outcome']}\n{where}", flush=True)
    return table


def main() -> None:
    """Go through the cases, and print a table."""
    n_cases = int(sys.argv[1]) if len(sys.argv) > 1 else 3000
    first = int(sys.argv[2]) if len(sys.argv) > 2 else 0
    kinds = sys.argv[3:] or [*SAMPLES, *INSTRUMENTS, FRAMES]
    shares = {kind: _SHARES.get(kind, (1 - sum(_SHARES.values())) / len(SAMPLES)) for kind in kinds}
    counts = {kind: max(1, round(n_cases * share / sum(shares.values()))) for kind, share in shares.items()}
    files = [kind for kind in kinds if kind in SAMPLES]
    others = [kind for kind in kinds if kind not in SAMPLES]
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(_PROCESSES) as threads:
        tikernels.init("cpu")
        make_samples(Path(folder))
        runs = [threads.submit(_go_through, part, counts, first, Path(folder)) for part in (files, others) if part]
        table = {kind: counter for run in runs for kind, counter in run.result().items()}
    columns = ["refused", "read in part", "read as before", OTHERWISE, "unnoticed", "went through", "decoded", *_FOUND]
    print("| kind | cases | " + " | ".join(columns) + " | ms a case |")
    print("|---|" + "---|" * (len(columns) + 2))
    for kind in kinds:
        cells = " | ".join(str(table[kind][column] or "") for column in columns)
        print(f"| {kind} | {counts[kind]} | {cells} | {table[kind]['ms'] / counts[kind]:.1f} |")
    found = sum(table[kind][column] for kind in kinds for column in (*_FOUND, "unnoticed"))
    print(f"{sum(counts.values())} cases from seed {first}; {found} of them nobody wants")
    sys.exit(found > 0)


if __name__ == "__main__":
    main()
