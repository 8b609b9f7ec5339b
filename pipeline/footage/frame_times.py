"""When the frames of footage were taken, as far as it tells."""

import json
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pipeline.footage.source import Source
from pipeline.footage.video_file import VideoFile
from pipeline.footage.zarr_recording import ZarrRecording

#: The log that a capture keeps beside its recording.
LOG = "log.jsonl"
# Bytes; ours are a third of a kB.
_LONGEST_LINE = 2**16
# Seconds since 1970, the year 2242: no clock of a computer shows more.
_LATEST = 2.0**33

Times = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class FrameTimes:
    """When each frame was taken."""

    seconds: Times  # (frames,), ascending
    since: str | None  # what they count from, UTC, as "2026-11-25T10:00:00Z"; None: the first frame

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
        with log.open("rb") as lines:
            while line := lines.readline(_LONGEST_LINE):
                event = json.loads(line)
                if event["event"] == "frame":
                    times[event["frame"]] = event["time"]
    except (OSError, ValueError, KeyError, TypeError, IndexError, OverflowError, RecursionError):
        return None
    return times if 0 < times[0] and times[-1] < _LATEST and _ascend(times) else None


def _ascend(times: Times) -> bool:
    """Whether times are known and each is later than the one before."""
    return bool(np.isfinite(times).all() and (np.diff(times) > 0).all())
