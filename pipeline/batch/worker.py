"""One process's share of the work: reading, decoding and writing overlap, and memory stays flat."""

import time
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import closing, contextmanager
from dataclasses import dataclass
from queue import Empty, Queue
from threading import Event, Thread
from typing import Any

from pipeline.batch.job import Job, join_ranges
from pipeline.decoding.frame import DecodedFrame, read_back
from pipeline.errors import DecodeWarning, FootageError
from pipeline.footage.footage import BadFrame, Footage, Frames, StoredFrame
from pipeline.output.store import ResultStore, WrittenFrame
from tikernels import runtime

# Frames read ahead; more of them only take memory.
_AHEAD = 4
# Threads that write results. They mostly wait for the interpreter, which kernels keep to themselves while they run:
# with four, storing all fields was 5 % faster than with two.
_WRITERS = 4
# Frames are marked together once in this time, because their folders' names are written to the disk first: a power cut
# loses what was decoded since.
_COMMIT_S = 0.5
# Results in hand: the one being decoded, the one before, and one for each thread that writes.
_RESULTS = 2 + _WRITERS


@dataclass(frozen=True)
class GoodFrame:
    """A frame that is stored and marked."""

    number: int
    warnings: tuple[str, ...]
    n_bytes: int  # that it takes in the store


Outcome = GoodFrame | BadFrame
Chain = tuple[range, frozenset[int]]


class Worker:
    """Decode frames of a job into its store, which must be there; all kernels run in the thread that calls.

    Parameters
    ----------
    job : Job
        The job.

    Raises
    ------
    DeviceNotReady, FootageError, OutputError
        The device, the footage or the store is not there.
    """

    def __init__(self, job: Job) -> None:
        self._job = job
        self._source = job.open()
        self._files = self._source.files()
        self._store = job.open_store(self._source)
        self._decoder = job.decoder()
        self._decoder.state = self._store.says.state
        self._times = None if job.settings.fields is None else self._source.times
        self._decoded = 0  # the number of the frame that was decoded last
        width, height = job.size_px(self._source)
        self._image = runtime.empty((height, width, 3), self._source.format.rgb_dtype)
        self._results = [_Result() for _ in range(_RESULTS)]

    def decode(self, todo: Sequence[Chain], notify: Callable[[Outcome], None]) -> None:
        """Decode ranges of frames, each by itself, and store those that are missing.

        Parameters
        ----------
        todo : sequence of (range, frozenset)
            The chains: frames of which each is decoded with the one before, and which of them are to be stored; see
            `chains`.
        notify : callable
            Called with every stored and every bad frame, with a bad one sooner than with those that are still being
            written.

        Raises
        ------
        OutputError
            The store cannot be written; reported frames stay.
        """
        starts = {numbers.start for numbers, _ in todo}
        missing = frozenset().union(*(lacking for _, lacking in todo))
        previous: DecodedFrame | None = None
        turn = 0
        with (
            _read_ahead(self._source, list(join_ranges([numbers for numbers, _ in todo]))) as frames,
            ThreadPoolExecutor(_WRITERS, "write") as writers,
            warnings.catch_warnings(),
        ):
            warnings.simplefilter("ignore", DecodeWarning)  # they are stored, and reported
            marks = _Marks(self._store, writers, notify)
            try:
                for stored in frames:
                    for earlier in self._results:
                        earlier.finish_if_written(marks)
                    marks.look()
                    if stored.number in starts:
                        previous = None
                    result = self._results[turn % _RESULTS]
                    result.finish(marks)
                    try:
                        frame = self._decode(stored, previous, result.frame)
                    except FootageError as error:
                        if stored.number in missing:
                            notify(BadFrame(stored.number, str(error)))
                        continue
                    previous = result.frame = frame
                    turn += 1
                    if stored.number in missing:
                        read_back(frame, self._job.fields)
                        result.written = writers.submit(
                            self._store.write, stored.number, frame, self._job.made_of(stored.number)
                        )
                for k in range(_RESULTS):
                    self._results[(turn + k) % _RESULTS].finish(marks)
                marks.finish()
            finally:
                # What has been decoded is stored, whatever has happened to the rest.
                in_hand = [result.written for result in self._results if result.written is not None]
                wait(in_hand)
                marks.save(future.result() for future in in_hand if future.exception() is None)
                for result in self._results:
                    result.written = None

    def _decode(
        self, stored: StoredFrame | BadFrame, previous: DecodedFrame | None, out: DecodedFrame | None
    ) -> DecodedFrame:
        is_pinned = self._job.pins(stored.number, self._files)
        if not is_pinned:
            self._job = self._job.without(stored.number)
        if isinstance(stored, BadFrame):
            raise FootageError(stored.reason)
        if not is_pinned:
            raise FootageError("its file has changed since this run began: run again")
        image = self._job.develop(stored, self._image)
        elapsed, self._decoded = self._elapsed(stored.number), stored.number
        return self._decoder.decode(image, previous, out, elapsed)

    def _elapsed(self, number: int) -> int:
        """Return how many times from frame to frame a frame is later than the one that was decoded last."""
        frame_s = self._job.settings.frame_s
        if self._times is not None and frame_s is not None:
            return self._times.elapsed(self._decoded, number, frame_s)
        return max(1, number - self._decoded)


@dataclass(eq=False)
class _Result:
    """A frame's buffers, which are used again once what they hold is written."""

    frame: DecodedFrame | None = None
    written: "Future[WrittenFrame] | None" = None

    def finish(self, marks: "_Marks") -> None:
        if self.written is not None and self.frame is not None:
            frame = self.written.result()
            self.written = None
            marks.add(frame, self.frame.warnings)

    def finish_if_written(self, marks: "_Marks") -> None:
        if self.written is not None and self.written.done():
            self.finish(marks)


class _Marks:
    """Mark the frames that are written, some at a time, then report them; from one thread."""

    def __init__(self, store: ResultStore, writers: ThreadPoolExecutor, notify: Callable[[Outcome], None]) -> None:
        self._store, self._writers, self._notify = store, writers, notify
        self._written: list[WrittenFrame] = []
        self._unreported: list[GoodFrame] = []  # of those that are written, in their order
        self._at_s = time.monotonic()
        self._in_hand: deque[tuple[Future[None], list[GoodFrame]]] = deque()

    def add(self, frame: WrittenFrame, warnings: tuple[str, ...]) -> None:
        """Have a frame marked, soon."""
        self._written.append(frame)
        self._unreported.append(GoodFrame(frame.number, warnings, frame.n_bytes))

    def look(self) -> None:
        """Mark what is written, if it is time for that, and report it."""
        if time.monotonic() - self._at_s >= _COMMIT_S:
            self._commit()
        while self._in_hand and self._in_hand[0][0].done():
            self._report_first()

    def finish(self) -> None:
        """Return when all are marked and reported."""
        self._commit()
        while self._in_hand:
            self._report_first()

    def save(self, more: Iterable[WrittenFrame]) -> None:
        """Mark all that is written, and what is added, without reporting it."""
        wait([future for future, _ in self._in_hand])
        if remaining := [*self._written, *more]:
            self._store.commit(remaining)
            self._written = []

    def _commit(self) -> None:
        if self._written:
            self._in_hand.append((self._writers.submit(self._store.commit, self._written), self._unreported))
        self._written, self._unreported = [], []
        self._at_s = time.monotonic()

    def _report_first(self) -> None:
        committed, frames = self._in_hand.popleft()
        committed.result()
        for frame in frames:
            self._notify(frame)


@contextmanager
def _read_ahead(source: Footage, ranges: Sequence[range]) -> Iterator[Iterator[StoredFrame | BadFrame]]:
    """Read frames in a thread of their own, a few ahead."""
    read: Queue[Any] = Queue(_AHEAD)
    stopped = Event()

    def run() -> None:
        try:
            with closing(_frames_of(source, ranges)) as frames:
                for frame in frames:
                    read.put(frame)
                    if stopped.is_set():
                        return
            read.put(None)
        except BaseException as error:
            read.put(error)  # raised where the frames are waited for

    def come() -> Iterator[StoredFrame | BadFrame]:
        while (item := read.get()) is not None:
            if isinstance(item, BaseException):
                raise item
            yield item

    thread = Thread(target=run, name="read", daemon=True)
    thread.start()
    try:
        yield come()
    finally:
        stopped.set()
        while thread.is_alive():
            try:
                read.get(timeout=0.02)  # it may be waiting for room
            except Empty:
                pass
        thread.join()


def _frames_of(source: Footage, ranges: Sequence[range]) -> Frames:
    """Yield the frames of one range of numbers after another."""
    for numbers in ranges:
        with closing(source.frames(numbers.start, numbers.stop, numbers.step)) as frames:
            yield from frames
