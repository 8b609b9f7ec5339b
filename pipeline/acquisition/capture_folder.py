"""A capture's folder: whole bursts go in, with their log, and the newest frame is decoded meanwhile."""

import json
import os
import shutil
import time
from collections import deque
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass
from fractions import Fraction
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from hardware.errors import CameraError
from hardware.protocols import FrameFormat
from hardware.rig import Burst, Rejected, Rig
from hardware.settings import RigSettings
from pipeline.acquisition.live import LiveDecoder, WatchedFrame
from pipeline.calibration import Calibration
from pipeline.errors import OutputError, SettingsError
from pipeline.files import explain, write_atomically
from pipeline.footage.frame_times import LOG
from pipeline.footage.zarr_recording import MOST_FRAMES_A_SECOND
from pipeline.limits import read_plain
from pipeline.models import SensorPart
from pipeline.recording.recorder import Recorder
from pipeline.settings import DecodeSettings
from tikernels.raw.pixel_format import PixelFormat

#: What a capture's folder holds.
RECORDING, CALIBRATION = "recording.zarr", "calibration.json"
SETTINGS = "settings.toml"
# Bytes of a log; three million frames take as much.
_MOST_LOG = 2**30
# Rates are averages over this many bursts.
_RATE_BURSTS = 10
#: How long kernels of live decoding may be compiled before the first burst is fired all the same, s.
LIVE_READY_S = 60.0


@dataclass(frozen=True)
class CapturePlan:
    """Number and kind of bursts to capture, and the way to keep them."""

    n_bursts: int | None = 1  # None: until it is stopped
    endless: bool = False  # pulses run on without a gap
    keep_last_s: float | None = None  # keep frames in memory, and record those of the last seconds before it is stopped
    live: bool = False  # decode the newest frame meanwhile
    arch: str = "auto"


@dataclass(frozen=True)
class CaptureProgress:
    """Progress of a capture."""

    n_bursts: int
    n_frames: int
    n_rejected: int  # bursts that were thrown away
    rate_hz: float  # whole frames per second, of late
    note: str | None  # what went wrong last
    watched: WatchedFrame | None  # None: none is decoded

    @property
    def latency_s(self) -> float | None:
        """Time from the exposure of the frame that was decoded last to its range image; None: none was."""
        return None if self.watched is None else self.watched.decoder.latency_s


def pixel_format(format: FrameFormat) -> PixelFormat:
    """Return a camera's format as kernels and recordings know it.

    Raises
    ------
    CameraError
        It is a Bayer mosaic, and the camera does not report which.
    """
    if format.layout == "rgb":
        return PixelFormat("rgb", format.bits)
    if format.bayer is None:
        raise CameraError(
            "the camera sends a Bayer mosaic but not which: set a pixel format that names it, as BayerRG8"
        )
    return PixelFormat("bayer", format.bits, bayer=format.bayer)


def taken(folder: Path) -> OutputError:
    """Return what to raise where a folder is there already."""
    return OutputError(f"{folder} exists: choose another folder")


def _check_memory(n_bytes: int) -> None:
    """Refuse what would be killed for its size, where the system reports its memory."""
    try:
        there = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError):
        return
    if n_bytes > there / 2:
        raise SettingsError(
            f"the frames that are kept in memory take {n_bytes / 1e9:.1f} GB, and this machine has {there / 1e9:.1f}: "
            "make timing.frames or --keep-last smaller"
        )


class CaptureFolder:
    """The folder of one capture; only whole bursts stay in it, and it is removed if there is none.

    Parameters
    ----------
    folder : Path
        A folder that must not exist.
    rig : Rig
        Set up, for its camera and pulses.
    plan : CapturePlan
        The way bursts are kept.
    calibration : Calibration or None
        The rig's, which is copied there.
    decoding : DecodeSettings
        Settings for live decoding.

    Raises
    ------
    CalibrationError, SettingsError, OutputError, CameraError
        See `capture_bursts`.
    """

    def __init__(
        self, folder: Path, rig: Rig, plan: CapturePlan, calibration: Calibration | None, decoding: DecodeSettings
    ) -> None:
        self.n_bursts = self.n_frames = self.n_rejected = 0
        self.recording = folder / RECORDING
        self._folder = folder
        self._plan = plan
        self._ring: deque[Burst] = deque()
        self._ended_s: deque[float] = deque([time.monotonic()], maxlen=_RATE_BURSTS + 1)
        self._frames_a_burst = rig.settings.timing.frames
        self._period_s = rig.train.period_s
        self._note: str | None = None
        limits = rig.camera.limits
        format = pixel_format(limits.format)
        if calibration is not None:
            calibration = calibration.as_read_out(limits.size_px, SensorPart.of(limits), "the camera's frame")
        (shape,) = format.plane_shapes(*limits.size_px[::-1])
        n_kept = max(self._frames_a_burst, round((plan.keep_last_s or 0.0) / self._period_s))
        _check_memory(n_kept * int(np.prod(shape)) * np.dtype(format.dtype).itemsize)
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            raise taken(folder) from None
        except OSError as error:
            raise OutputError(f"cannot write {folder}: {explain(error)}") from None
        try:
            if calibration is not None:
                calibration.write(folder / CALIBRATION)
            if known := _decode_settings(rig.settings, self._period_s).model_dump(mode="json", exclude_unset=True):
                write_atomically(folder / SETTINGS, tomlkit.dumps(known).encode())
            self._log = CaptureLog(folder / LOG)
            self._log.say(
                "start",
                colorphase_version=version("colorphase"),
                rig=rig.settings.model_dump(mode="json", exclude={"projector": {"password"}}),
                trigger=str(rig.trigger.identity),
                camera=str(rig.camera.identity),
                pulses=asdict(rig.train),
                exposure_s=rig.camera.exposure_s,
                not_locked=list(rig.camera.unlocked),
                calibration_sha256=None if calibration is None else calibration.digest(),
            )
            # A camera triggered by software encodes frames as it likes; the calibration may have measured how.
            transfer = "linear" if limits.triggered else None
            if calibration is not None and calibration.capture is not None and calibration.capture.transfer is not None:
                measured = calibration.capture.transfer
                transfer = measured if isinstance(measured, str) else None
            rate_hz = min(Fraction(1 / rig.train.period_s).limit_denominator(10**6), Fraction(MOST_FRAMES_A_SECOND))
            self._recorder = Recorder(
                self.recording, format, transfer=transfer, rate_hz=rate_hz, sensor=SensorPart.of(limits)
            )
            self._watched = None
            if plan.live:
                live = LiveDecoder(limits.size_px, decoding, calibration, format, plan.arch)
                self._watched = WatchedFrame(live, format)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise

    def __enter__(self) -> "CaptureFolder":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, *_: object) -> None:
        """Finish; without any whole burst there is nothing."""
        try:
            if self._watched is not None:
                self._watched.decoder.close()
            while self._ring:
                self._write(self._ring.popleft())
            self._recorder.close()
        except BaseException as failure:
            error = failure
            raise
        finally:
            with suppress(OutputError):  # the disk may be full
                self._log.say("end", frames=self.n_frames, error=None if error is None else str(error))
            self._log.close()
            if self.n_frames == 0:
                shutil.rmtree(self._folder, ignore_errors=True)

    def wait_for_live(self) -> None:
        """Wait until live decoding is ready for a frame, or has finished the last one; at most for a minute."""
        if self._watched is not None:
            self._watched.decoder.wait(LIVE_READY_S)

    def keep(self, burst: Burst) -> None:
        """Record a burst, or remember it."""
        if self._watched is not None:
            self._watched = self._watched.offered(burst.frames[-1], self.n_frames + len(burst.frames) - 1)
        if self._plan.keep_last_s is None:
            self._write(burst)
        else:
            self._ring.append(burst)
            while (len(self._ring) - 1) * self._frames_a_burst * self._period_s >= self._plan.keep_last_s:
                self._ring.popleft()
        self._ended_s.append(time.monotonic())

    def reject(self, rejected: Rejected) -> None:
        """Remember why a burst was thrown away."""
        self.n_rejected += 1
        self._note = str(rejected.faults[0])
        self._log.reject(rejected)

    @property
    def notes(self) -> tuple[str, ...]:
        """Failures apart from the bursts, one sentence each."""
        if self._watched is None:
            return ()
        if self._watched.decoder.ended is not None:
            return (self._watched.decoder.ended,)
        if self._watched.decoder.latency_s is None:
            return ("the capture was over before live decoding was ready, which takes some seconds at its first start",)
        return ()

    def progress(self) -> CaptureProgress:
        """Return the progress."""
        seconds = self._ended_s[-1] - self._ended_s[0]
        rate_hz = (len(self._ended_s) - 1) * self._frames_a_burst / seconds if seconds > 0 else 0.0
        n_bursts = self.n_bursts + len(self._ring)
        return CaptureProgress(
            n_bursts=n_bursts,
            n_frames=n_bursts * self._frames_a_burst,
            n_rejected=self.n_rejected,
            rate_hz=rate_hz,
            note=self._note,
            watched=self._watched,
        )

    def _write(self, burst: Burst) -> None:
        self._log.keep(burst, self.n_frames)
        try:
            for paired in burst.frames:
                self._recorder.add(paired.image)
            self._log.save()  # first: no frame is without its line
            self._recorder.commit()
        except BaseException:
            self._log.take_back()
            raise
        self.n_frames += len(burst.frames)
        self.n_bursts += 1


class CaptureLog:
    """``log.jsonl``: a line of JSON for everything that happened; see `docs/rig.md`.

    Its entries on the last burst can be taken back.

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


def _decode_settings(rig: RigSettings, period_s: float) -> DecodeSettings:
    """Return the settings for the times at which the rig shows its colours and exposes its rows."""
    cycle_s, fields = rig.projector.colour_cycle_s, rig.projector.fields
    values: dict[str, Any] = {"row_s": rig.camera.row_s} if rig.camera.row_s else {}
    if values or cycle_s is not None:
        values["frame_s"] = period_s
    if cycle_s is not None:
        values["fields"] = {"cycle_s": cycle_s}
        if fields is not None:
            shown_s = (fields.red_s, fields.green_s, fields.blue_s)
            values["fields"] |= {"shown_s": shown_s, "locked": fields.locked}
    return DecodeSettings(**values)


def end_log(path: Path, n_frames: int) -> None:
    """End the log of a capture that was killed with the last frame that its recording holds.

    Parameters
    ----------
    path : Path
        The log.
    n_frames : int
        Number of frames.

    Raises
    ------
    OutputError
        It cannot be read or written.
    """
    kept = []
    try:
        for line in read_plain(path, _MOST_LOG).splitlines():
            try:
                event = json.loads(line)
                ahead = event["event"] == "frame" and event["frame"] >= n_frames
                ahead |= event["event"] == "burst" and event["first_frame"] >= n_frames
            except (ValueError, KeyError, TypeError, RecursionError):
                ahead = True  # the last line, cut off
            if not ahead:
                kept.append(line)
    except OSError as error:
        raise OutputError(f"cannot read {path}: {error.strerror or error}") from None
    end = {"event": "end", "time": time.time(), "frames": n_frames, "error": "the program was killed"}
    write_atomically(path, b"\n".join([*kept, json.dumps(end).encode()]) + b"\n")
