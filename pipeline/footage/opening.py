"""Where frames come from, image folders, video files and recordings, and when they were taken.

A frame leaves its source in the form in which it was stored; `tikernels.develop` turns that into RGB.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pipeline.errors import FootageError
from pipeline.footage.heic_file import is_heic
from pipeline.footage.image_folder import IMAGE_SUFFIXES, ImageFolder
from pipeline.footage.source import Source, StoredAs
from pipeline.footage.tiff_file import RAW
from pipeline.footage.video_file import VideoFile
from pipeline.footage.zarr_recording import ZarrRecording
from pipeline.limits import open_plain
from tikernels.errors import ShapeError
from tikernels.raw.pixel_format import Bayer, Matrix, Siting

# Pictures that phones and browsers store as the brand of an ISO base media file says (ISO/IEC 23008-12, 10.2).
_UNREAD = {b"avif": "AVIF", b"avis": "AVIF"}
# How names of cameras' raw files end.
_RAW_SUFFIXES = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw")
#: The log that a capture keeps beside its recording.
LOG = "log.jsonl"
# Bytes; ours are a third of a kB.
_LONGEST_LINE = 2**16
# Seconds since 1970, the year 2242: no clock of a computer shows more.
_LATEST = 2.0**33

Times = npt.NDArray[np.float64]


def open_source(
    path: str | Path,
    *,
    bayer: Bayer | None = None,
    bits: int | None = None,
    siting: Siting | None = None,
    matrix: Matrix | None = None,
    full_range: bool | None = None,
    listed: Sequence[str] | None = None,
) -> Source:
    """Open footage: a folder of images, a single image, a video file, or a recording.

    Parameters
    ----------
    path : str or Path
        Which.
    bayer, bits, siting, matrix, full_range
        How the pixels are stored, see `PixelFormat`; each wins over what the footage says of itself. Grey footage
        needs `bayer`.
    listed : sequence of str, optional
        Names of a folder's pictures, in order: others that have come since are not looked at.

    Raises
    ------
    FootageError
        There is no such footage, or it cannot be read.
    """
    says = StoredAs(bayer, bits, siting, matrix, full_range)
    path = Path(path)
    try:
        if path.is_dir():
            # Any kind of Zarr group: those that are no recordings are refused there, by name.
            if path.suffix == ".zarr" or (path / "zarr.json").exists() or (path / ".zgroup").exists():
                return ZarrRecording(path, says)
            return ImageFolder.in_folder(path, says, listed)
        if not path.is_file():
            what = "it is neither a file nor a folder" if path.exists() else "there is no such file"
            raise FootageError(f"cannot read {path}: {what}")
        with open_plain(path) as file:
            head = file.read(12)
        if (kind := _unread_kind(head)) is not None:
            raise FootageError(f"cannot read {path}: it is a picture in {kind}: save it as PNG, TIFF or JPEG")
        if path.suffix.lower() in _RAW_SUFFIXES:
            raise FootageError(f"cannot read {path}: {RAW}")
        if path.suffix.lower() in IMAGE_SUFFIXES or is_heic(head):
            return ImageFolder.of_file(path, says)
        return VideoFile(path, says)
    except (FootageError, ShapeError) as error:
        if str(path) in str(error):
            raise
        raise FootageError(f"cannot read {path}: {error}") from None
    except OSError as error:
        raise FootageError(f"cannot read {path}: {error.strerror or error}") from None


def _unread_kind(head: bytes) -> str | None:
    """Return the name of a kind of picture that is not read, by how the file begins; None: it is another file."""
    if head[4:8] == b"ftyp":
        return _UNREAD.get(head[8:12])
    return "GIF" if head.startswith(b"GIF8") else None


@dataclass(frozen=True, eq=False)
class FrameTimes:
    """When each frame was taken."""

    seconds: Times  # (frames,), ascending
    since: str | None  # what they count from, UTC, as "2026-11-25T10:00:00Z"; None: the first frame

    @property
    def known(self) -> bool:
        """Whether there are any, and each is later than the one before."""
        return len(self.seconds) > 0 and _ascend(self.seconds) and self.seconds[-1] < _LATEST

    def of(self, number: int) -> float:
        """Return a frame's time, s, since 1970 where the day is known, else since the first frame."""
        start = 0.0 if self.since is None else datetime.fromisoformat(self.since).timestamp()
        return start + float(self.seconds[number])


def frame_times(source: Source) -> FrameTimes | None:
    """Return when the frames of footage were taken; None where nothing tells, as with a folder of pictures.

    A recording's capture log has the time of day at which each frame was exposed. Without one a recording's rate
    tells, and of other videos their time stamps do. The date in a video's head is not asked: programs that cut or copy
    videos write their own.
    """
    if not isinstance(source, VideoFile | ZarrRecording):
        return None
    if source.is_recording:
        logged = _logged_times(Path(source.name).parent / LOG, len(source))
        if logged is not None:
            start = np.floor(logged[0])
            return FrameTimes(logged - start, f"{datetime.fromtimestamp(start, UTC):%Y-%m-%dT%H:%M:%SZ}")
    seconds = np.asarray(source.times_s, np.float64)
    return FrameTimes(seconds, None) if len(seconds) == len(source) and _ascend(seconds) else None


def _logged_times(log: Path, n_frames: int) -> Times | None:
    """Return when each frame was exposed, s since 1970, by a capture's log; None where it does not tell of them all."""
    times = np.full(n_frames, np.nan)
    try:
        with open_plain(log) as lines:
            while line := lines.readline(_LONGEST_LINE):
                event = json.loads(line)
                if event["event"] == "frame":
                    times[event["frame"]] = event["time"]
    except (OSError, ValueError, KeyError, TypeError, IndexError, OverflowError, RecursionError):
        return None
    return times if FrameTimes(times, None).known and times[0] > 0 else None


def _ascend(times: Times) -> bool:
    """Whether times are known and each is later than the one before."""
    return bool(np.isfinite(times).all() and (np.diff(times) > 0).all())
