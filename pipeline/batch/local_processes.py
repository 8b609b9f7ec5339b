"""Decode in several processes on this machine, each with a decoder of its own.

The kernels' languages keep the interpreter to themselves while a kernel runs, and share its work out over the cores
many times a frame. Processes of one kernel thread each do neither: two of them decode half as many frames again as
one process on two cores does.
"""

import os
import pickle
import queue
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from threading import Lock, Thread
from typing import IO, Any, cast

from pipeline.batch.job import Job
from pipeline.batch.sharing import usable_cores
from pipeline.batch.worker import Chain, Outcome
from pipeline.batch.worker_process import Done, Failure
from pipeline.errors import ClusterError
from pipeline.processes import block_interrupts
from tikernels import runtime

# Tasks a process: more of them even out the time that each takes, fewer let footage be read in one go.
_TASKS_A_PROCESS = 8
# Time that a process may take to start, and then for one frame: kernels are compiled for the first.
_SILENT_S = 180.0
# Between two looks at whether one is silent for too long.
_LOOK_S = 1.0
# Time that it takes to end.
_END_S = 20.0
# As many processes may die over the same frames.
_MOST_DEATHS = 3


def shares(cores: Sequence[int], count: int) -> list[list[int]]:
    """Share out cores among processes, as many to each; more processes than cores have one each, some the same.

    >>> shares([0, 1, 2, 3, 4], 2), shares([0, 1], 3)
    ([[0, 1], [2, 3]], [[0], [1], [0]])
    """
    size = max(1, len(cores) // count)
    return [[cores[(k * size + i) % len(cores)] for i in range(size)] for k in range(count)]


def decode_in_processes(job: Job, todo: Sequence[Chain], count: int, tell: Callable[[Outcome], None]) -> None:
    """Decode chains of frames in processes that are started here; see `Worker.decode`.

    Parameters
    ----------
    job : Job
        What to decode and how; its store must be there.
    todo : sequence of (range, frozenset)
        The chains: frames of which each is decoded with the one before, and which of them are to be stored.
    count : int
        How many processes; each has its share of the cores to itself.
    tell : callable
        Told of every stored and every bad frame, not in order. What it raises ends the run.

    Raises
    ------
    ClusterError
        Processes die over the same frames again and again, or do not answer.
    """
    size = -(-len(todo) // (_TASKS_A_PROCESS * count))
    tasks = deque(list(todo[first : first + size]) for first in range(0, len(todo), size))
    count = min(count, len(tasks))
    heard: queue.Queue[Any] = queue.Queue()
    # Neither these nor the threads that talk to them get Ctrl-C: the caller does.
    with block_interrupts():
        processes = [_Decoding(job, tasks, cores, heard) for cores in shares(usable_cores(), count)]
    try:
        running = count
        while running:
            try:
                message = heard.get(timeout=_LOOK_S)
            except queue.Empty:
                for process in processes:
                    process.end_if_silent()
                continue
            if isinstance(message, Done):
                running -= 1
            elif isinstance(message, Failure):
                raise message.error from RuntimeError(message.trace)  # whose words come before it
            else:
                tell(message)
    finally:
        tasks.clear()
        for process in processes:
            process.end()


class _Raised(Exception):
    """What a process has raised."""

    def __init__(self, failure: Failure) -> None:
        self.failure = failure


class _Decoding:
    """A thread that has one task after another decoded by a process, and by another one when that dies.

    What is reported of frames is put into `heard`, at last `Done`, or a `Failure`.
    """

    def __init__(self, job: Job, tasks: deque[list[Chain]], cores: list[int], heard: "queue.Queue[Any]") -> None:
        self._job, self._tasks, self._heard, self._cores = job, tasks, heard, cores
        self._lock, self._ended = Lock(), False
        self._process: _Process | None = None
        self._thread = Thread(target=self._run, name="process", daemon=True)
        self._thread.start()

    def end(self) -> None:
        """End the process, whatever it is at: what it has stored is whole."""
        with self._lock:
            self._ended = True
            if self._process is not None:
                self._process.kill()
        self._thread.join()

    def end_if_silent(self) -> None:
        """End the process if it has said nothing for too long; then its frames are done again."""
        with self._lock:
            if self._process is not None and self._process.silent_for_s() > _SILENT_S:
                self._process.kill()

    def _run(self) -> None:
        try:
            while (task := self._next_task()) is not None:
                self._decode(task)
            self._let_go(in_peace=True)
            self._heard.put(Done())
        except _Raised as raised:
            self._heard.put(raised.failure)
        except Exception as error:
            self._heard.put(Failure(error, ""))
        finally:
            self._let_go(in_peace=False)

    def _next_task(self) -> list[Chain] | None:
        with suppress(IndexError):
            return self._tasks.popleft()
        return None

    def _decode(self, task: list[Chain]) -> None:
        """Have a task decoded, what is left of it by another process if one dies."""
        reported: set[int] = set()
        for _ in range(_MOST_DEATHS):
            try:
                process = self._running()
                process.send([(numbers, missing - reported) for numbers, missing in task if missing - reported])
                while not isinstance(message := process.receive(), Done):
                    self._heard.put(message)
                    reported.add(message.number)
                return
            except (EOFError, OSError, pickle.UnpicklingError):
                self._let_go(in_peace=False)
                if self._ended:
                    return
        raise ClusterError(
            f"{_MOST_DEATHS} processes died over the same frames: look for memory, or decode with --workers 1"
        )

    def _running(self) -> "_Process":
        """Return the process, started and ready."""
        with self._lock:
            if self._process is not None:
                return self._process
            if self._ended:
                raise EOFError
            self._process = process = _Process(self._cores)
        process.send(self._job)
        process.receive()
        return process

    def _let_go(self, *, in_peace: bool) -> None:
        with self._lock:
            process, self._process = self._process, None
        if process is not None:
            process.close(in_peace=in_peace)


class _Process:
    """A process that runs `worker_process.serve` on some cores, with a kernel thread for each."""

    def __init__(self, cores: list[int]) -> None:
        threads = len(cores)
        environment = {
            **dict.fromkeys(runtime.THREAD_VARIABLES, str(threads)),
            **os.environ,  # in which a user's own numbers win
            "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
        }
        self._process = subprocess.Popen(
            [sys.executable, "-c", "from pipeline.batch.worker_process import serve; serve()"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environment,
        )
        if hasattr(os, "sched_setaffinity"):  # before it has threads, which inherit it
            with suppress(OSError):
                os.sched_setaffinity(self._process.pid, cores)
        self._tasks, self._reports = cast(IO[bytes], self._process.stdin), cast(IO[bytes], self._process.stdout)
        self._asked_at_s: float | None = None

    def send(self, message: Any) -> None:
        pickle.dump(message, self._tasks)
        self._tasks.flush()

    def receive(self) -> Any:
        """Return what it reports next; raise what it has raised."""
        self._asked_at_s = time.monotonic()
        message = pickle.load(self._reports)
        self._asked_at_s = None
        if isinstance(message, Failure):
            raise _Raised(message)
        return message

    def silent_for_s(self) -> float:
        """Return for how long something has been waited for."""
        asked_at_s = self._asked_at_s
        return 0.0 if asked_at_s is None else time.monotonic() - asked_at_s

    def kill(self) -> None:
        self._process.kill()

    def close(self, *, in_peace: bool) -> None:
        """Wait until it has ended: in peace it keeps the kernels that it has compiled on the disk."""
        if not in_peace:
            self.kill()
        with suppress(OSError):
            self._tasks.close()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self.kill()
            self._process.wait()
        self._reports.close()
