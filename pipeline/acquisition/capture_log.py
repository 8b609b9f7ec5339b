"""``log.jsonl``: a line of JSON for everything that happened; see `docs/rig.md`."""

import json
import os
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from hardware.rig import Burst, Rejected
from pipeline.errors import OutputError
from pipeline.files import explain, write_atomically


def end_log(path: Path, n_frames: int) -> None:
    """End the log of a capture that was killed with the last frame that its recording holds.

    Parameters
    ----------
    path : Path
        The log.
    n_frames : int
        How many frames there are.

    Raises
    ------
    OutputError
        It cannot be read or written.
    """
    kept = []
    try:
        for line in path.read_bytes().splitlines():
            try:
                event = json.loads(line)
                ahead = event["event"] == "frame" and event["frame"] >= n_frames
                ahead |= event["event"] == "burst" and event["first_frame"] >= n_frames
            except (ValueError, KeyError, TypeError):
                ahead = True  # the last line, cut off
            if not ahead:
                kept.append(line)
    except OSError as error:
        raise OutputError(f"cannot read {path}: {error.strerror or error}") from None
    end = {"event": "end", "time": time.time(), "frames": n_frames, "error": "the program was killed"}
    write_atomically(path, b"\n".join([*kept, json.dumps(end).encode()]) + b"\n")


class CaptureLog:
    """The log of one capture. What it says of the last burst can be taken back.

    Parameters
    ----------
    path : Path
        The file to make.

    Raises
    ------
    OutputError
        It cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        # Monotonic times become those of the day, which other programs' logs have.
        self._epoch_s = time.time() - time.monotonic()
        self._whole = 0  # bytes that are to stay
        try:
            self._file = path.open("xb", buffering=0)
        except OSError as error:
            raise OutputError(f"cannot write {path}: {explain(error)}") from None

    def say(self, event: str, **details: Any) -> None:
        """Write one line."""
        self._write([{"event": event, "time": self._epoch_s + time.monotonic(), **details}])

    def reject(self, rejected: Rejected) -> None:
        """Say that a burst was thrown away, and why."""
        self.say(
            "rejected",
            burst=rejected.number,
            attempt=rejected.attempt,
            faults=[str(fault) for fault in rejected.faults],
        )

    def keep(self, burst: Burst, first_frame: int) -> None:
        """Say which pulse each frame of a burst belongs to.

        Parameters
        ----------
        burst : Burst
            The burst.
        first_frame : int
            The number of its first frame in the recording.
        """
        frames = (
            {
                "event": "frame",
                "frame": number,
                "burst": burst.number,
                "pulse": paired.pulse,
                "pulse_s": paired.pulse_s,
                "strobe_s": paired.strobe_s,
                "frame_id": paired.frame.frame_id,
                "device_time_s": paired.frame.device_time_s,
                "time": self._epoch_s + paired.exposed_at_s,
                "arrived": self._epoch_s + paired.frame.host_time_s,
                "temperature_c": paired.frame.temperature_c,
            }
            for number, paired in enumerate(burst.frames, first_frame)
        )
        status = burst.status
        end = {
            "event": "burst",
            "burst": burst.number,
            "first_frame": first_frame,
            "frames": len(burst.frames),
            "pulses": status.pulses,
            "strobes": status.strobes,
            "vsyncs": status.vsyncs,
            "delivered_twice": burst.n_repeated,
            "camera_clock_ppm": burst.camera_ppm,
            "trigger_clock_ppm": status.clock_ppm,
        }
        self._write([*frames, end])

    def take_back(self) -> None:
        """Remove what was written last: that burst is not in the recording."""
        os.ftruncate(self._file.fileno(), self._whole)
        self._file.seek(self._whole)

    def save(self) -> None:
        """Return when it is on the disk.

        Raises
        ------
        OutputError
            The disk refuses.
        """
        try:
            os.fsync(self._file.fileno())
        except OSError as error:
            raise OutputError(f"cannot write {self._path}: {explain(error)}") from None

    def close(self) -> None:
        """Let go of the file."""
        self._file.close()

    def _write(self, events: Iterable[dict[str, Any]]) -> None:
        self._whole = self._file.tell()
        text = "".join(json.dumps(event) + "\n" for event in events).encode()
        try:
            written = 0
            while written < len(text):
                written += self._file.write(text[written:]) or 0
        except OSError as error:
            self.take_back()
            raise OutputError(f"cannot write {self._path}: {explain(error)}") from None
