"""One capture: fire, record, log, and decode the newest frame meanwhile."""

import os
import shutil
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from fractions import Fraction
from importlib.metadata import version
from itertools import islice
from pathlib import Path

import numpy as np

from hardware.protocols import Camera, Trigger
from hardware.rig import Burst, Rejected, Rig
from hardware.settings import RigSettings
from pipeline.acquisition.capture_log import CaptureLog
from pipeline.acquisition.live import LiveDecoder
from pipeline.acquisition.stopping import Stopping
from pipeline.calibration import Calibration
from pipeline.errors import CalibrationError, OutputError, SettingsError
from pipeline.files import explain
from pipeline.footage.recording_tags import MOST_FRAMES_A_SECOND
from pipeline.recording.recorder import Recorder
from pipeline.settings import DecodeSettings
from tikernels.raw.pixel_format import PixelFormat

#: What a capture's folder holds, beside the recording.
LOG, CALIBRATION, PREVIEW = "log.jsonl", "calibration.json", "live.png"
# Rates are those of so many bursts.
_RATE_BURSTS = 10


@dataclass(frozen=True)
class CapturePlan:
    """What is to be captured, and how it is kept."""

    n_bursts: int | None = 1  # None: until it is stopped
    endless: bool = False  # pulses run on without a gap
    keep_last_s: float | None = None  # keep frames in memory, and record only so many seconds before it is stopped
    suffix: str = ".zarr"  # of the recording
    live: bool = False  # decode the newest frame meanwhile
    arch: str = "auto"


@dataclass(frozen=True)
class CaptureProgress:
    """How a capture stands."""

    n_bursts: int
    n_frames: int
    n_rejected: int  # bursts that were thrown away
    rate_hz: float  # whole frames a second, of late
    latency_s: float | None  # from an exposure to its range image; None: none is decoded
    note: str | None  # what went wrong last


@dataclass(frozen=True)
class CaptureSummary:
    """What became of a capture."""

    n_bursts: int
    n_frames: int
    n_rejected: int
    recording: Path
    stopped: bool  # by its user, before all bursts were there
    notes: tuple[str, ...]  # what could not be seen or held, a sentence each


def capture_bursts(
    settings: RigSettings,
    open_instruments: Callable[[], tuple[Trigger, Camera]],
    folder: Path,
    plan: CapturePlan,
    *,
    calibration: Calibration | None,
    decoding: DecodeSettings,
    stopping: Stopping,
    tell: Callable[[CaptureProgress], None] = lambda progress: None,
) -> CaptureSummary:
    """Capture bursts until there are enough, or until it is stopped.

    Whatever happens, what was whole is kept: a burst stands in the recording and in its log, or in neither.

    Parameters
    ----------
    settings : RigSettings
        The rig.
    open_instruments : callable
        Open its trigger source and its camera.
    folder : Path
        The folder to make: the recording, ``log.jsonl``, ``calibration.json`` and, decoding live, ``live.png``.
    plan : CapturePlan
        How much is captured, and how it is kept.
    calibration : Calibration, optional
        The rig's.
    decoding : DecodeSettings
        How frames are decoded live.
    stopping : Stopping
        Where Ctrl-C comes in.
    tell : callable, optional
        Hears how the capture stands, at its start and after every burst that is kept or thrown away.

    Raises
    ------
    RigError, TriggerError, CameraError, BurstError
        See `Rig`.
    CalibrationError
        The calibration is for frames of another size.
    SettingsError
        So many frames do not fit into memory.
    OutputError
        The folder is there already or cannot be written, or the disk is full.
    """
    if folder.exists():
        raise _taken(folder)  # before any instrument is opened
    stopped = False
    n_taken = 0
    with (
        Rig(settings, open_instruments, lambda rejected: reject(rejected)) as rig,
        _Keeper(folder, rig, plan, calibration, decoding) as keeper,
    ):

        def reject(rejected: Rejected) -> None:
            keeper.reject(rejected)
            tell(keeper.progress())

        tell(keeper.progress())
        bursts = rig.bursts(endless=plan.endless)
        try:
            for burst in islice(bursts, plan.n_bursts):
                with stopping.shield():
                    keeper.keep(burst)
                    n_taken += 1
                tell(keeper.progress())
        except KeyboardInterrupt:
            stopped = n_taken != plan.n_bursts
        finally:
            stopping.ignore()
            bursts.close()
        notes = rig.notes + keeper.notes
    return CaptureSummary(keeper.n_bursts, keeper.n_frames, keeper.n_rejected, keeper.recording, stopped, notes)


def _taken(folder: Path) -> OutputError:
    return OutputError(f"{folder} exists: choose another folder")


def _check_memory(n_bytes: int) -> None:
    """Refuse what would be killed for its size, where the system tells how much there is."""
    try:
        there = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError):
        return
    if n_bytes > there / 2:
        raise SettingsError(
            f"the frames that are kept in memory take {n_bytes / 1e9:.1f} GB, and this machine has {there / 1e9:.1f}: "
            "make timing.frames or --keep-last smaller"
        )


class _Keeper:
    """A capture's folder: whole bursts go in, with their log."""

    def __init__(
        self, folder: Path, rig: Rig, plan: CapturePlan, calibration: Calibration | None, decoding: DecodeSettings
    ) -> None:
        self.n_bursts = self.n_frames = self.n_rejected = 0
        self.recording = folder / f"recording{plan.suffix}"
        self._folder = folder
        self._plan = plan
        self._ring: deque[Burst] = deque()
        self._ended_s: deque[float] = deque([time.monotonic()], maxlen=_RATE_BURSTS + 1)
        self._frames_a_burst = rig.settings.timing.frames
        self._period_s = rig.train.period_s
        self._note: str | None = None
        limits = rig.camera.limits
        kind = limits.format
        format = PixelFormat(kind.layout, kind.bits, bayer=kind.bayer or "rggb")
        if calibration is not None and calibration.camera is not None and calibration.camera.size_px != limits.size_px:
            here, there = ("{}x{}".format(*size_px) for size_px in (limits.size_px, calibration.camera.size_px))
            raise CalibrationError(
                f"the camera's frames are {here} but the calibration is for {there}: set camera.size_px, calibrate "
                "anew, or leave calibration away"
            )
        (shape,) = format.plane_shapes(*limits.size_px[::-1])
        n_kept = max(self._frames_a_burst, round((plan.keep_last_s or 0.0) / self._period_s))
        _check_memory(n_kept * int(np.prod(shape)) * np.dtype(format.dtype).itemsize)
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            raise _taken(folder) from None
        except OSError as error:
            raise OutputError(f"cannot write {folder}: {explain(error)}") from None
        try:
            if calibration is not None:
                calibration.write(folder / CALIBRATION)
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
            # A camera that takes frames when told to encodes them as it likes.
            transfer = "linear" if limits.triggered else None
            rate_hz = min(Fraction(1 / rig.train.period_s).limit_denominator(10**6), Fraction(MOST_FRAMES_A_SECOND))
            self._recorder = Recorder(self.recording, format, transfer=transfer, rate_hz=rate_hz)
            self._live = None
            if plan.live:
                self._live = LiveDecoder(decoding, calibration, format, limits.size_px, folder / PREVIEW, plan.arch)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise

    def __enter__(self) -> "_Keeper":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, *_: object) -> None:
        """Finish; without any whole burst there is nothing."""
        try:
            if self._live is not None:
                self._live.close()
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

    def keep(self, burst: Burst) -> None:
        """Record a burst, or remember it."""
        if self._live is not None:
            newest = burst.frames[-1]
            self._live.offer(newest.image, self.n_frames + len(burst.frames) - 1, newest.exposed_at_s)
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
        """What went wrong beside the bursts, a sentence each."""
        if self._live is None:
            return ()
        if self._live.ended is not None:
            return (self._live.ended,)
        if self._live.latest() is None:
            return ("the capture was over before live decoding was ready, which takes some seconds",)
        return ()

    def progress(self) -> CaptureProgress:
        """Return how it stands."""
        seconds = self._ended_s[-1] - self._ended_s[0]
        rate_hz = (len(self._ended_s) - 1) * self._frames_a_burst / seconds if seconds > 0 else 0.0
        decoded = None if self._live is None else self._live.latest()
        n_bursts = self.n_bursts + len(self._ring)
        return CaptureProgress(
            n_bursts=n_bursts,
            n_frames=n_bursts * self._frames_a_burst,
            n_rejected=self.n_rejected,
            rate_hz=rate_hz,
            latency_s=None if decoded is None else decoded.latency_s,
            note=self._note,
        )

    def _write(self, burst: Burst) -> None:
        self._log.keep(burst, self.n_frames)
        try:
            for paired in burst.frames:
                self._recorder.add(paired.image)
            self._recorder.commit()
        except BaseException:
            self._log.take_back()
            raise
        self.n_frames += len(burst.frames)
        self.n_bursts += 1
