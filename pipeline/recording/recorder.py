"""Our own lossless recordings: FFV1 in Matroska, or Zarr; `docs/footage.md` defines both."""

import errno
import os
import secrets
import shutil
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from pipeline.errors import OutputError
from pipeline.files import explain
from pipeline.footage.recording_tags import RecordingTags
from pipeline.recording.matroska import MatroskaWriter
from pipeline.recording.zarr_writer import ZarrWriter
from tikernels.errors import ShapeError
from tikernels.raw.pixel_format import PixelFormat

# Frames in hand, waiting and being written: 0.3 s at 200 frames a second, for which a busy disk may stall; of large
# frames what fits into this many bytes.
_MOST_IN_HAND, _IN_HAND_BYTES = 64, 128_000_000
# A disk that has not taken a single frame for so long is gone.
_PATIENCE_S = 30.0
# So long the frame that is just being written may take when a recording is to end.
_END_S = 10.0
# The caller's thread looks so often for what it waits for.
_POLL_S = 0.001


class Recorder:
    """Write frames without loss, under their final name only when that holds nothing half-written.

    Threads compress and write, a few frames behind the caller, whose thread only copies them; what goes wrong there is
    raised by the next call. `commit` says that all frames so far belong together: after an error, Ctrl-C or a full disk
    the recording ends with the last of them, and stands under its name; frames that were never committed leave nothing.
    To be used by one thread.

    Parameters
    ----------
    path : str or Path
        ``.mkv`` for FFV1 in Matroska (8 to 16 bits), ``.zarr`` for Zarr; it must not exist.
    format : PixelFormat
        How frames come: RGB in one (H, W, 3) plane, or a Bayer mosaic.
    transfer : {"linear", "srgb", "bt709"}, optional
        How light is encoded, if that is known.
    rate_hz : int or Fraction
        Frames a second, up to 500: for players; frames are known by their numbers.

    Raises
    ------
    OutputError
        The name has another ending, or is taken.
    ShapeError
        Such frames, this transfer or this rate cannot be recorded.
    """

    def __init__(
        self,
        path: str | Path,
        format: PixelFormat,
        *,
        transfer: str | None = None,
        rate_hz: int | Fraction = 30,
    ) -> None:
        self._path = Path(path)
        if (format.layout, format.channels, format.shift) not in (("rgb", "rgb", 0), ("bayer", "rgb", 0)):
            raise ShapeError("recordings hold RGB in one plane, or a Bayer mosaic: develop other frames first")
        writers: dict[str, type[_Writer]] = {".mkv": MatroskaWriter, ".zarr": ZarrWriter}
        suffix = self._path.suffix.lower()
        if suffix not in writers:
            raise OutputError(f"cannot record to {path}: the name must end in {' or '.join(writers)}")
        if self._path.exists():
            raise OutputError(f"cannot record to {path}: it exists, choose another name")
        self._format = format
        self._temporary = self._path.with_name(f".{secrets.token_hex(8)}.part{suffix}")
        self._new_writer = writers[suffix]
        self._tags = RecordingTags(
            Fraction(rate_hz), transfer, format.bayer if format.layout == "bayer" else None, format.bits
        )
        self._shape: tuple[int, ...] = ()
        self._crew: _Crew | None = None
        self._ended = False

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
        """How many frames it holds: those added, and once it has ended those that were kept."""
        if self._crew is None:
            return 0
        return self._crew.n_committed if self._ended else self._crew.n_added

    @property
    def n_bytes(self) -> int:
        """How many bytes have been written."""
        return 0 if self._crew is None else self._crew.n_bytes

    def add(self, frame: npt.NDArray[Any]) -> None:
        """Hand over a frame, which is copied; waits where the disk falls behind.

        Parameters
        ----------
        frame : (H, W, 3) RGB or (H, W) mosaic
            Levels, of the format's type.

        Raises
        ------
        ShapeError
            It has another shape or type than the format says, or than the first frame.
        OutputError
            The disk is full or has gone, or the folder cannot be written: the recording has ended.
        """
        shape = self._format.plane_shapes(*frame.shape[:2])[0] if frame.ndim >= 2 else ()
        if frame.shape != (self._shape or shape) or frame.dtype != self._format.dtype:
            expected = self._shape or ("(H, W, 3)" if self._format.layout == "rgb" else "(H, W)")
            raise ShapeError(f"frame is {frame.shape} {frame.dtype}, expected {expected} {self._format.dtype}")
        if self._ended:
            raise OutputError(f"cannot record to {self._path}: the recording has ended")
        try:
            if self._crew is None:
                place = (self._temporary, frame.shape[1::-1], self._format, self._tags)
                self._crew = _Crew(lambda: self._new_writer(*place), self._new_writer.most_threads, frame)
                self._crew.start()
                self._shape = frame.shape
            self._crew.add(frame)
        except OSError as error:
            raise self._ended_by(error) from error

    def commit(self) -> None:
        """Keep the frames so far, whatever comes; returns when they are written.

        Raises
        ------
        OutputError
            They cannot be: the recording has ended with those that were committed before.
        """
        if self._ended:
            raise OutputError(f"cannot record to {self._path}: the recording has ended")
        if self._crew is not None:
            try:
                self._crew.commit()
            except OSError as error:
                raise self._ended_by(error) from error

    def close(self) -> None:
        """Keep all frames, and finish: now the recording stands under its name. Without frames there is none.

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
        """Finish with what was committed, or leave nothing; harmless twice.

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

    def _ended_by(self, error: OSError) -> OutputError:
        """Finish with what was committed, and return what to raise."""
        self.stop()
        kept = f"; its first {self.n_frames} frames are kept" if self.n_frames else ""
        return OutputError(f"cannot record to {self._path}: {explain(error)}{kept}")

    def _finish(self) -> None:
        if self._crew is not None:
            self._crew.stop()
            if self._crew.n_committed:
                if self._temporary.exists():
                    os.replace(self._temporary, self._path)
                return
        if self._temporary.is_dir():
            shutil.rmtree(self._temporary, ignore_errors=True)
        else:
            with suppress(OSError):  # where the folder is unreachable nothing was left in it
                self._temporary.unlink(missing_ok=True)


class _Writer(Protocol):
    """What stores frames; made and called by the threads of a crew."""

    most_threads: int
    """How many of them may call `write`."""
    n_frames: int
    """How many frames are committed."""

    def __init__(self, path: Path, size_px: tuple[int, int], format: PixelFormat, tags: RecordingTags, /) -> None: ...

    def write(self, number: int, frame: npt.NDArray[Any]) -> int: ...

    def commit(self, n_frames: int) -> None: ...

    def close(self) -> None: ...


@dataclass
class _Commit:
    done: bool = False


class _Crew:
    """Threads that write frames, of which a bounded number is in hand.

    Ctrl-C comes to the caller's thread only, at any moment: so that thread never holds a lock, and what must not be
    torn apart is done, and counted, by these.
    """

    def __init__(self, open: Callable[[], _Writer], n_threads: int, like: npt.NDArray[Any]) -> None:
        self.n_added = 0  # frames
        self.n_bytes = 0
        self._open = open
        self._writer: _Writer | None = None
        n_slots = min(_MOST_IN_HAND, max(n_threads + 1, _IN_HAND_BYTES // like.nbytes))
        # The last one that came back is taken first: memory that is not needed is never touched.
        self._free = [np.empty(like.shape, like.dtype) for _ in range(n_slots)]
        self._waiting: SimpleQueue[npt.NDArray[Any] | _Commit | None] = SimpleQueue()  # None: wake up
        self._taking, self._done = threading.Lock(), threading.Condition()
        self._n_taken = 0  # frames, whose numbers this gives
        self._n_in_work = 0
        self._n_done = 0
        self._running = self._stopping = False
        self._error: Exception | None = None
        self._n_threads = n_threads

    @property
    def n_committed(self) -> int:
        return 0 if self._writer is None else self._writer.n_frames

    def start(self) -> None:
        """Return when there is a writer; raise what keeps it from being there."""
        # Daemons: a disk that never answers keeps no program from ending.
        threading.Thread(target=self._run, daemon=True).start()
        self._wait(lambda: self._writer is not None)

    def add(self, frame: npt.NDArray[Any]) -> None:
        self._wait(lambda: bool(self._free))
        slot = self._free.pop()
        np.copyto(slot, frame)
        self._waiting.put(slot)
        self.n_added += 1

    def commit(self) -> None:
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

    def _wait(self, so: Callable[[], bool]) -> None:
        """Wait until that is so; raise what went wrong, or that nothing has been done for too long."""
        n_done, end = self._n_done, time.monotonic() + _PATIENCE_S
        while self._error is None and not so():
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

    def _work(self, writer: _Writer) -> None:
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

    def _write(self, writer: _Writer, number: int, slot: npt.NDArray[Any]) -> None:
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

    def _commit(self, writer: _Writer, commit: _Commit) -> None:
        """Commit what has been taken, once it is written; nothing is taken meanwhile."""
        with self._done:
            self._done.wait_for(lambda: not self._n_in_work)
        try:
            if self._error is None:
                writer.commit(self._n_taken)
                commit.done = True
        except Exception as error:
            self._error = error
