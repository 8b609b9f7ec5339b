"""Times at which the frames of footage were taken."""

import json
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pipeline.limits import open_plain

#: The log that a capture keeps next to its recording.
LOG = "log.jsonl"
# Bytes; ours are a third of a kB.
_LONGEST_LINE = 2**16
# Seconds since 1970, the year 2242: no clock of a computer shows more.
_LATEST = 2.0**33

Times = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class FrameTimes:
    """Times at which frames were taken."""

    seconds: Times  # (frames,), ascending
    since: str | None  # what they count from, UTC, as "2026-11-25T10:00:00Z"; None: the first frame

    @classmethod
    def logged(cls, log: Path, n_frames: int) -> "FrameTimes | None":
        """Return when frames were exposed, by a capture's log; None: it does not have them all."""
        seconds = _logged_times(log, n_frames)
        if seconds is None:
            return None
        start = np.floor(seconds[0])
        return cls(seconds - start, f"{datetime.fromtimestamp(start, UTC):%Y-%m-%dT%H:%M:%SZ}")

    @property
    def known(self) -> bool:
        """True if there are any, and each is later than the one before."""
        return len(self.seconds) > 0 and self.ascend and self.seconds[-1] < _LATEST

    @property
    def ascend(self) -> bool:
        """True if all are numbers, and each is later than the one before."""
        return bool(np.isfinite(self.seconds).all() and (np.diff(self.seconds) > 0).all())

    def of(self, number: int) -> float:
        """Return a frame's time, s, since 1970 where the day is known, else since the first frame."""
        start = 0.0 if self.since is None else datetime.fromisoformat(self.since).timestamp()
        return start + float(self.seconds[number])

    def elapsed(self, before: int, number: int, frame_s: float) -> int:
        """Return how many times from frame to frame, each of `frame_s`, lie between two frames; at least 1."""
        return max(1, round(float(self.seconds[number] - self.seconds[before]) / frame_s))


def _logged_times(log: Path, n_frames: int) -> Times | None:
    """Return when each frame was exposed, s since 1970; None where the log does not have them all."""
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
