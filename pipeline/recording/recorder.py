"""Lossless recordings: FFV1 in Matroska, or Zarr; `docs/footage.md` defines both."""

import os
import shutil
from contextlib import ExitStack, suppress
from fractions import Fraction
from pathlib import Path

from pipeline.errors import OutputError
from pipeline.files import explain, sync
from pipeline.footage.recording_tags import RecordingTags
from pipeline.locking import locked
from pipeline.models import ImageArray
from pipeline.recording.matroska import MatroskaWriter
from pipeline.recording.writing_threads import FrameWriter, WritingThreads
from pipeline.recording.zarr_writer import ZarrWriter
from tikernels.errors import ShapeError
from tikernels.raw.pixel_format import PixelFormat

#: What a recording's name has before its ending until it is finished.
PART = ".part"


class Recorder:
    """Write frames without loss, under their final name only when that holds nothing half-written.

    Threads compress and write, a few frames behind the caller, whose thread only copies them; what goes wrong there is
    raised by the next call. `commit` says that all frames up to now belong together: after an error, Ctrl-C or a full
    disk the recording ends with the last of them, and stands under its name; frames that were never committed leave
    nothing. To be used by one thread.

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
        writers: dict[str, type[FrameWriter]] = {".mkv": MatroskaWriter, ".zarr": ZarrWriter}
        suffix = self._path.suffix.lower()
        if suffix not in writers:
            raise OutputError(f"cannot record to {path}: the name must end in {' or '.join(writers)}")
        if self._path.exists():
            raise OutputError(f"cannot record to {path}: it exists, choose another name")
        self._format = format
        self._temporary = self._path.with_name(f"{self._path.stem}{PART}{suffix}")
        if self._temporary.exists():
            raise OutputError(
                f"cannot record to {path}: {self._temporary.name} is there, of a program that was killed: colorphase "
                f"verify {self._path.parent} finishes it; or choose another name"
            )
        self._new_writer = writers[suffix]
        self._tags = RecordingTags(
            Fraction(rate_hz), transfer, format.bayer if format.layout == "bayer" else None, format.bits
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
        """How many frames it holds: those added, and once it has ended those that were kept."""
        if self._threads is None:
            return 0
        return self._threads.n_committed if self._ended else self._threads.n_added

    @property
    def n_bytes(self) -> int:
        """How many bytes have been written."""
        return 0 if self._threads is None else self._threads.n_bytes

    def add(self, frame: ImageArray) -> None:
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
            The disk is full or has gone, the folder cannot be written, or somebody else records under this name: the
            recording has ended.
        """
        shape = self._format.plane_shapes(*frame.shape[:2])[0] if frame.ndim >= 2 else ()
        if frame.shape != (self._shape or shape) or frame.dtype != self._format.dtype:
            expected = self._shape or ("(H, W, 3)" if self._format.layout == "rgb" else "(H, W)")
            raise ShapeError(f"frame has shape {frame.shape} {frame.dtype}, expected {expected} {self._format.dtype}")
        if self._ended:
            raise OutputError(f"cannot record to {self._path}: the recording has ended")
        try:
            if self._threads is None:
                self._lock.enter_context(locked(self._path))
                place = (self._temporary, frame.shape[1::-1], self._format, self._tags)
                self._threads = WritingThreads(lambda: self._new_writer(*place), self._new_writer.most_threads, frame)
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
        if self._temporary.is_dir():
            shutil.rmtree(self._temporary, ignore_errors=True)
        else:
            with suppress(OSError):  # where the folder is unreachable nothing was left in it
                self._temporary.unlink(missing_ok=True)
