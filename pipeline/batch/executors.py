"""Executors of chains of frames, and the number of workers: processes on this machine; `cluster` has Dask's.

The kernels' languages keep the interpreter to themselves while a kernel runs, and distribute its work over the cores
many times per frame. Processes of one kernel thread each do neither: two of them decode half as many frames again as
one process on two cores does.
"""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import suppress
from queue import Empty, SimpleQueue
from threading import Lock
from typing import Any, Protocol

from pipeline.batch.job import CHAIN_FRAMES, Job
from pipeline.batch.worker import Chain, Outcome, Worker
from pipeline.errors import ClusterError
from pipeline.processes import Child, ChildDied, serve
from tikernels import runtime

Report = Callable[[Outcome], None]

# Tasks a worker: more of them even out the time that each takes, fewer let footage be read in one go.
_TASKS_A_WORKER = 8
# Between two checks whether a worker is silent for too long, or none is left.
_LOOK_S = 1.0
# Time that a process may take to start, and then for one frame: kernels are compiled for the first.
_SILENT_S = 180.0
# As many processes may die over the same frames.
_MOST_DEATHS = 3
# A process starts in the time that it takes to decode about as many frames.
_FRAMES_A_START = 128


class Executor(Protocol):
    """Workers that decode tasks, some chains each, as those of `concurrent.futures` do."""

    n_workers: int

    def submit(self, task: list[Chain], report: Report) -> "Future[Sequence[Outcome]]":
        """Have a task decoded; its outcomes are reported one by one, from any thread, or returned at its end."""

    def look(self) -> None:
        """See, where nothing has been heard for a while, whether something still works."""


def decode_by(executor: Executor, todo: Sequence[Chain], notify: Report) -> None:
    """Decode chains of frames by an executor; see `Worker.decode`.

    Parameters
    ----------
    executor : Executor
        Its workers have the job.
    todo : sequence of (range, frozenset)
        The chains: frames of which each is decoded with the one before, and which of them are to be stored.
    notify : callable
        Called with every stored and every bad frame, in this thread, not in order.
    """
    size = -(-len(todo) // (_TASKS_A_WORKER * executor.n_workers))
    tasks = [list(todo[first : first + size]) for first in range(0, len(todo), size)]
    heard: SimpleQueue[Any] = SimpleQueue()
    for task in tasks:
        executor.submit(task, heard.put).add_done_callback(heard.put)
    running = len(tasks)
    while running:
        try:
            message = heard.get(timeout=_LOOK_S)
        except Empty:
            executor.look()
            continue
        if isinstance(message, Future):
            running -= 1
        for outcome in message.result() if isinstance(message, Future) else (message,):
            notify(outcome)


class ProcessExecutor:
    """Processes on this machine, each with a decoder of its own and its share of the cores to itself.

    If one dies, another one takes its place, and its frames are done again.

    Parameters
    ----------
    job : Job
        The job; its store must exist.
    count : int
        Their number.
    """

    def __init__(self, job: Job, count: int) -> None:
        self.n_workers = count
        self._threads = ThreadPoolExecutor(count, "process")
        self._places = [_Place(job, cores) for cores in shares(usable_cores(), count)]
        self._free: SimpleQueue[_Place] = SimpleQueue()
        for place in self._places:
            self._free.put(place)

    def __enter__(self) -> "ProcessExecutor":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """End the processes, after an error whatever they are at: what they have stored is complete."""
        try:
            if kind is None:  # each keeps the kernels that it has compiled on the disk
                list(self._threads.map(_Place.end, self._places))
        finally:
            self._threads.shutdown(wait=False, cancel_futures=True)
            for place in self._places:
                place.kill()
            self._threads.shutdown()
            for place in self._places:  # those that had nothing to do
                place.end()

    def submit(self, task: list[Chain], report: Report) -> "Future[Sequence[Outcome]]":
        """Have a task decoded; see `Executor`."""
        return self._threads.submit(self._decode, task, report)

    def look(self) -> None:
        """End processes that have been silent for too long; then their frames are done again."""
        for place in self._places:
            place.end_if_silent()

    def _decode(self, task: list[Chain], report: Report) -> Sequence[Outcome]:
        place = self._free.get()
        try:
            place.decode(task, report)
        finally:
            self._free.put(place)
        return ()


class _Place:
    """A share of the cores, and the process that has it."""

    def __init__(self, job: Job, cores: list[int]) -> None:
        self._job, self._cores = job, cores
        self._lock, self._ended = Lock(), False
        self._child: Child | None = None

    def decode(self, task: list[Chain], report: Report) -> None:
        """Have a task decoded, what is left of it by another process if one dies."""
        reported: set[int] = set()
        try:
            for _ in range(_MOST_DEATHS):
                try:
                    child = self._running()
                    child.send([(numbers, missing - reported) for numbers, missing in task if missing - reported])
                    while (outcome := child.receive()) is not None:
                        report(outcome)
                        reported.add(outcome.number)
                    return
                except ChildDied:
                    self._let_go(in_peace=False)
            raise ClusterError(
                f"{_MOST_DEATHS} processes died over the same frames: see the system's log, or decode with --workers 1"
            )
        except BaseException:
            self._let_go(in_peace=False)
            raise

    def end(self) -> None:
        """Let the process end, now that nothing is left to decode."""
        self._let_go(in_peace=True)

    def kill(self) -> None:
        """End the process, and start no other one; whoever speaks to it notices."""
        with self._lock:
            self._ended = True
            if self._child is not None:
                self._child.kill()

    def end_if_silent(self) -> None:
        with self._lock:
            if self._child is not None and self._child.silent_for_s() > _SILENT_S:
                self._child.kill()

    def _running(self) -> Child:
        """Return the process, started and ready."""
        with self._lock:
            if self._ended:
                raise CancelledError
            if self._child is not None:
                return self._child
            threads = dict.fromkeys(runtime.THREAD_VARIABLES, str(len(self._cores)))
            program = "from pipeline.batch.executors import decode_what_comes; decode_what_comes()"
            child = self._child = Child(program, {**threads, **os.environ})  # a user's own numbers win
            if hasattr(os, "sched_setaffinity"):  # before it has threads, which inherit it
                with suppress(OSError):
                    os.sched_setaffinity(child.pid, self._cores)
        child.send(self._job)
        child.receive()
        return child

    def _let_go(self, *, in_peace: bool) -> None:
        with self._lock:
            child, self._child = self._child, None
        if child is not None:
            child.close(in_peace=in_peace)


def decode_what_comes() -> None:
    """Decode tasks of a job, in a process of its own; report every frame, and None when it is ready for a task."""

    def work(receive: Callable[[], Any], report: Callable[[Any], None]) -> None:
        worker = Worker(receive())
        while True:
            report(None)
            worker.decode(receive(), report)

    serve(work)


def usable_cores() -> list[int]:
    """Return the cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def shares(cores: Sequence[int], count: int) -> list[list[int]]:
    """Share out cores among processes, as many to each; more processes than cores have one each, some the same.

    >>> shares([0, 1, 2, 3, 4], 2), shares([0, 1], 3)
    ([[0, 1], [2, 3]], [[0], [1], [0]])
    """
    size = max(1, len(cores) // count)
    return [[cores[(k * size + i) % len(cores)] for i in range(size)] for k in range(count)]


def worthwhile_processes(job: Job, todo: Sequence[Chain]) -> int:
    """Return in how many processes frames are decoded the soonest."""
    if _on_gpu(job):
        return 1  # one GPU does all the work
    n_frames = sum(len(missing) for _, missing in todo)
    return max(1, min(len(usable_cores()), len(todo), n_frames // _FRAMES_A_START))


def idle_processes(job: Job, todo: Sequence[Chain], count: int) -> str | None:
    """Warn about more processes than help, and state how many do; None: each of them helps."""
    n_cores = len(usable_cores())
    if count > 1 and _on_gpu(job):
        return f"note: --workers {count}: one GPU does all the work, and --workers 1 is as fast"
    if count <= min(n_cores, len(todo)):
        return None
    if len(todo) < n_cores:
        chains = "one chain" if len(todo) == 1 else f"{len(todo)} chains"
        why = f"frames lean on the one before in chains of {CHAIN_FRAMES}, and what is left to decode is {chains}"
    else:
        why = "this machine has one core" if n_cores == 1 else f"this machine has {n_cores} cores for it"
    return f"note: --workers {count}: {why}: --workers {min(n_cores, len(todo))} is as fast"


def _on_gpu(job: Job) -> bool:
    return job.arch != "cpu" and (job.arch != "auto" or runtime.init("auto") != "cpu")
