"""Lossless recordings in Zarr, which `docs/footage.md` defines; threads compress and write them."""

import _thread
import errno
import os
import shutil
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from queue import SimpleQueue

import numpy as np

from pipeline.errors import OutputError
from pipeline.files import explain, sync
from pipeline.footage.zarr_recording import RecordingTags
from pipeline.locking import locked
from pipeline.models import ImageArray, SensorPart
from pipeline.recording.zarr_writer import MOST_THREADS, PART, ZarrWriter
from pipeline.text import sizes_differ
from tikernels.errors import ShapeError
from tikernels.raw.pixel_format import PixelFormat

# Frames in hand at most, waiting and being written: 0.3 s at 200 frames per second, for which a busy disk may stall.
_MOST_IN_HAND = 64
# Bytes that frames in hand may take: fewer frames are kept of large ones.
_IN_HAND_BYTES = 128_000_000
# A disk that has not taken a single frame for this time is gone.
_PATIENCE_S = 30.0
# Time that the frame which is just being written may take when a recording is to end.
_END_S = 10.0
# Between two looks at what the caller's thread waits for: a tenth of a frame's time at 100 frames per second.
_POLL_S = 0.001


class Recorder:
    """Write frames without loss, under their final name only when that holds nothing half-written.

    Threads compress and write, a few frames behind the caller, whose thread only copies them; what goes wrong there is
    raised by the next call. `commit` marks that all frames up to now belong together: after an error, Ctrl-C or a full
    disk the recording ends with the last of them, and is found under its name; frames that were never committed leave
    nothing. To be used by one thread.

    Parameters
    ----------
    path : str or Path
        ``NAME.zarr``; it must not exist.
    format : PixelFormat
        Format of frames: RGB in one (H, W, 3) plane, or a Bayer mosaic.
    transfer : {"linear", "srgb", "bt709"}, optional
        Encoding of light, if that is known.
    rate_hz : int or Fraction
        Frames a second, up to 500: for players; frames are known by their numbers.
    sensor : SensorPart, optional
        The part of the camera's sensor that frames are, where it is known.

    Raises
    ------
    OutputError
        The name has another ending, or is taken.
    ShapeError
        Such frames, this transfer or this rate cannot be recorded.

    Examples
    --------
    >>> rig = colorphase.simulated_rig((160, 120), period_px=64)
    >>> with colorphase.Recorder("film.zarr", colorphase.PixelFormat("rgb"), rate_hz=30) as film:
    ...     for seed in range(2):
    ...         film.add(colorphase.simulate_frame(rig, colorphase.SimulationSettings(scene="plane", seed=seed)).image)
    >>> len(colorphase.open_footage("film.zarr"))
    2
    """

    def __init__(
        self,
        path: str | Path,
        format: PixelFormat,
        *,
        transfer: str | None = None,
        rate_hz: int | Fraction = 30,
        sensor: SensorPart | None = None,
    ) -> None:
        self._path = Path(path)
        if (format.layout, format.channels, format.shift) not in (("rgb", "rgb", 0), ("bayer", "rgb", 0)):
            raise ShapeError("recordings hold RGB in one plane, or a Bayer mosaic: develop other frames first")
        if self._path.suffix.lower() != ".zarr":
            raise OutputError(f"cannot record to {path}: the name must end in .zarr")
        if self._path.exists():
            raise OutputError(f"cannot record to {path}: it exists, choose another name")
        self._format = format
        self._temporary = self._path.with_name(f"{self._path.stem}{PART}.zarr")
        if self._temporary.exists():
            raise OutputError(
                f"cannot record to {path}: {self._temporary.name} is there, of a program that was killed: colorphase "
                f"verify {self._path.parent} finishes it; or choose another name"
            )
        self._tags = RecordingTags(
            Fraction(rate_hz), transfer, format.bayer if format.layout == "bayer" else None, format.bits, sensor
        )
        self._shape: tuple[int, ...] = ()
        self._threads: WritingThreads | None = None
        self._ended = False
        self._lock = ExitStack()

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(self, error: object, *_: object) -> None:
        """Finish the recording; after an error with what was committed."""
        if error is None:
            self.close()
        else:
            self.stop()

    @property
    def n_frames(self) -> int:
        """Number of frames it holds: those added, and once it has ended those that were kept."""
        if self._threads is None:
            return 0
        return self._threads.n_committed if self._ended else self._threads.n_added

    @property
    def n_bytes(self) -> int:
        """Number of bytes written."""
        return 0 if self._threads is None else self._threads.n_bytes

    def add(self, frame: ImageArray) -> None:
        """Pass a frame, which is copied; waits where the disk falls behind.

        Parameters
        ----------
        frame : (H, W, 3) RGB or (H, W) mosaic
            Levels, of the format's type.

        Raises
        ------
        ShapeError
            It has another shape or type than the format specifies, or than the first frame.
        OutputError
            The disk is full or has gone, the folder cannot be written, or somebody else records under this name: the
            recording has ended.
        """
        shape = self._format.plane_shapes(*frame.shape[:2])[0] if frame.ndim >= 2 else ()
        if self._shape and frame.ndim == len(self._shape) and frame.shape[:2] != self._shape[:2]:
            raise ShapeError(sizes_differ("frame", frame.shape[1::-1], "the first one is", self._shape[1::-1]))
        if frame.shape != (self._shape or shape) or frame.dtype != self._format.dtype:
            expected = self._shape or ("(H, W, 3)" if self._format.layout == "rgb" else "(H, W)")
            raise ShapeError(f"frame has shape {frame.shape} {frame.dtype}, expected {expected} {self._format.dtype}")
        if self._ended:
            raise OutputError(f"cannot record to {self._path}: the recording has ended")
        try:
            if self._threads is None:
                self._lock.enter_context(locked(self._path))
                place = (self._temporary, frame.shape[1::-1], self._format, self._tags)
                self._threads = WritingThreads(lambda: ZarrWriter(*place), MOST_THREADS, frame)
                self._threads.start()
                self._shape = frame.shape
            self._threads.add(frame)
        except OutputError:
            self.stop()
            raise
        except OSError as error:
            raise self._ended_by(error) from error

    def commit(self) -> None:
        """Keep the frames added up to now, whatever comes; returns when they are written.

        Raises
        ------
        OutputError
            They cannot be: the recording has ended with those that were committed before.
        """
        if self._ended:
            raise OutputError(f"cannot record to {self._path}: the recording has ended")
        if self._threads is not None:
            try:
                self._threads.commit()
            except OSError as error:
                raise self._ended_by(error) from error

    def close(self) -> None:
        """Keep all frames, and finish: now the recording is found under its name. Without frames there is none.

        Raises
        ------
        OutputError
            The disk is full, or the folder cannot be written: it holds what was committed.
        """
        if not self._ended:
            try:
                self.commit()
            finally:
                self.stop()

    def stop(self) -> None:
        """Finish with what was committed, or leave nothing; a second call does nothing.

        Raises
        ------
        OutputError
            The recording cannot get its name, or the disk does not answer: what is there stays under a temporary one.
        """
        if self._ended:
            return
        try:
            self._finish()
        except KeyboardInterrupt:  # the first one may come only now
            self._finish()
            raise
        except OSError as error:
            raise OutputError(f"cannot finish {self._path}, see {self._temporary}: {explain(error)}") from error
        finally:
            self._ended = True
            self._lock.close()

    def _ended_by(self, error: OSError) -> OutputError:
        """Finish with what was committed, and return what to raise."""
        self.stop()
        kept = f"; its first {self.n_frames} frames are kept" if self.n_frames else ""
        return OutputError(f"cannot record to {self._path}: {explain(error)}{kept}")

    def _finish(self) -> None:
        if self._threads is not None:
            self._threads.stop()
            if self._threads.n_committed:
                if self._temporary.exists():
                    os.replace(self._temporary, self._path)
                    sync(self._path.parent)
                return
        shutil.rmtree(self._temporary, ignore_errors=True)


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
        Number of them that write.
    like : (H, W, 3) or (H, W)
        A frame, for its shape and type.
    """

    def __init__(self, open: Callable[[], ZarrWriter], n_threads: int, like: ImageArray) -> None:
        self.n_added = 0  # frames
        self.n_bytes = 0
        self._open = open
        self._writer: ZarrWriter | None = None
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
        """Number of frames that are kept whatever comes."""
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

    def _work(self, writer: ZarrWriter) -> None:
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

    def _write(self, writer: ZarrWriter, number: int, slot: ImageArray) -> None:
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

    def _commit(self, writer: ZarrWriter, commit: _Commit) -> None:
        """Commit what has been taken, once it is written; nothing is taken meanwhile."""
        with self._done:
            self._done.wait_for(lambda: not self._n_in_work)
        try:
            if self._error is None:
                writer.commit(self._n_taken)
                commit.done = True
        except Exception as error:
            self._error = error
