"""Threads that compress and write frames, a few frames behind the one that hands them over."""

import _thread
import errno
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from typing import Protocol

import numpy as np

from pipeline.footage.recording_tags import RecordingTags
from pipeline.models import ImageArray
from tikernels.raw.pixel_format import PixelFormat

# Frames in hand at most, waiting and being written: 0.3 s at 200 frames a second, for which a busy disk may stall.
_MOST_IN_HAND = 64
# Bytes that frames in hand may take: fewer frames are kept of large ones.
_IN_HAND_BYTES = 128_000_000
# A disk that has not taken a single frame for this time is gone.
_PATIENCE_S = 30.0
# Time that the frame which is just being written may take when a recording is to end.
_END_S = 10.0
# Between two looks at what the caller's thread waits for: a tenth of a frame's time at 100 frames a second.
_POLL_S = 0.001


class FrameWriter(Protocol):
    """What stores frames; made and called by `WritingThreads`."""

    most_threads: int
    """How many of them may call `write`."""
    n_frames: int
    """How many frames are committed."""

    def __init__(self, path: Path, size_px: tuple[int, int], format: PixelFormat, tags: RecordingTags, /) -> None: ...

    def write(self, number: int, frame: ImageArray) -> int:
        """Write a frame by its number, and return how many bytes that took."""

    def commit(self, n_frames: int) -> None:
        """Keep the first frames, whatever comes."""

    def close(self) -> None:
        """Drop frames that were not committed, and let go of the file."""


@dataclass
class _Commit:
    done: bool = False


class WritingThreads:
    """Threads that write frames, of which a bounded number is in hand.

    Ctrl-C comes to the caller's thread only, at any moment: so that thread never holds a lock, and what must not be
    interrupted is done, and counted, by these.

    Parameters
    ----------
    open : callable
        Makes the writer, in the first of the threads.
    n_threads : int
        How many of them write.
    like : (H, W, 3) or (H, W)
        A frame, for its shape and type.
    """

    def __init__(self, open: Callable[[], FrameWriter], n_threads: int, like: ImageArray) -> None:
        self.n_added = 0  # frames
        self.n_bytes = 0
        self._open = open
        self._writer: FrameWriter | None = None
        n_slots = min(_MOST_IN_HAND, max(n_threads + 1, _IN_HAND_BYTES // like.nbytes))
        # The last one that came back is taken first: memory that is not needed is never touched.
        self._free = [np.empty(like.shape, like.dtype) for _ in range(n_slots)]
        self._waiting: SimpleQueue[ImageArray | _Commit | None] = SimpleQueue()  # None: wake up
        self._taking, self._done = threading.Lock(), threading.Condition()
        self._n_taken = 0  # frames, whose numbers this gives
        self._n_in_work = 0
        self._n_done = 0
        self._running = self._stopping = False
        self._error: Exception | None = None
        self._n_threads = n_threads

    @property
    def n_committed(self) -> int:
        """How many frames are kept whatever comes."""
        return 0 if self._writer is None else self._writer.n_frames

    def start(self) -> None:
        """Return when there is a writer; raise what keeps it from being there."""
        # Not by `Thread.start`, which holds a lock while it waits, where Ctrl-C may come. Either way a disk that never
        # answers keeps no program from ending.
        _thread.start_new_thread(self._run, ())
        self._wait(lambda: self._writer is not None)

    def add(self, frame: ImageArray) -> None:
        """Copy a frame to be written; wait while too many are in hand."""
        self._wait(lambda: bool(self._free))
        slot = self._free.pop()
        np.copyto(slot, frame)
        self._waiting.put(slot)
        self.n_added += 1

    def commit(self) -> None:
        """Return when what was added is written and committed."""
        commit = _Commit()
        self._waiting.put(commit)
        self._wait(lambda: commit.done)

    def stop(self) -> None:
        """Drop what waits, and return when the writer is closed."""
        self._stopping = True
        self._waiting.put(None)
        end = time.monotonic() + _END_S
        while self._running:
            if time.monotonic() > end:
                raise OSError(errno.ETIMEDOUT, "the disk does not answer")
            time.sleep(_POLL_S)

    def _wait(self, done: Callable[[], bool]) -> None:
        """Wait until it is done; raise what went wrong, or that nothing has been done for too long."""
        n_done, end = self._n_done, time.monotonic() + _PATIENCE_S
        while self._error is None and not done():
            if self._n_done != n_done:
                n_done, end = self._n_done, time.monotonic() + _PATIENCE_S
            if time.monotonic() > end:
                raise OSError(errno.ETIMEDOUT, f"the disk has taken no frame for {_PATIENCE_S:.0f} s")
            time.sleep(_POLL_S)
        if self._error is not None:
            raise self._error

    def _run(self) -> None:
        self._running = True
        try:
            if not self._stopping:
                self._writer = writer = self._open()
                others = [
                    threading.Thread(target=self._work, args=(writer,), daemon=True) for _ in range(1, self._n_threads)
                ]
                for thread in others:
                    thread.start()
                self._work(writer)
                for thread in others:
                    thread.join()
                writer.close()
        except Exception as error:
            self._error = self._error or error
        finally:
            self._running = False

    def _work(self, writer: FrameWriter) -> None:
        while True:
            with self._taking:
                job = self._waiting.get()
                if self._stopping or self._error is not None:
                    self._waiting.put(None)  # for the others
                    return
                number = self._n_taken
                if isinstance(job, np.ndarray):
                    self._n_taken += 1
                    self._n_in_work += 1
                elif job is not None:
                    self._commit(writer, job)
            if isinstance(job, np.ndarray):
                self._write(writer, number, job)

    def _write(self, writer: FrameWriter, number: int, slot: ImageArray) -> None:
        n_bytes, failure = 0, None
        try:
            n_bytes = writer.write(number, slot)
        except Exception as error:
            failure = error
        self._free.append(slot)
        with self._done:
            self._error = self._error or failure
            self.n_bytes += n_bytes
            self._n_done += 1
            self._n_in_work -= 1
            self._done.notify()

    def _commit(self, writer: FrameWriter, commit: _Commit) -> None:
        """Commit what has been taken, once it is written; nothing is taken meanwhile."""
        with self._done:
            self._done.wait_for(lambda: not self._n_in_work)
        try:
            if self._error is None:
                writer.commit(self._n_taken)
                commit.done = True
        except Exception as error:
            self._error = error
