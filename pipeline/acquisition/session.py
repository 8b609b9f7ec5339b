"""One capture: fire, record, log, and decode the newest frame meanwhile; Ctrl-C ends it, but splits no burst."""

import signal
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from types import FrameType

from hardware.protocols import Camera, Trigger
from hardware.rig import Rejected, Rig
from hardware.settings import RigSettings
from pipeline.acquisition.capture_folder import (
    LIVE_READY_S,
    CaptureFolder,
    CapturePlan,
    CaptureProgress,
    pixel_format,
    taken,
)
from pipeline.acquisition.live import LiveDecoder, WatchedFrame
from pipeline.calibration import Calibration
from pipeline.models import SensorPart
from pipeline.settings import DecodeSettings


class Stopping:
    """Turn the first request to stop into a KeyboardInterrupt, and ignore others: everything is being closed by then.

    Ctrl-C, a request to terminate and a terminal that is closed are all the same to it.
    """

    def __init__(self) -> None:
        self.asked = False
        self._raised = self._shielded = self._closing = False

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Take the requests that come in here."""
        names = ["SIGINT", "SIGTERM"]
        # Windows has none; and nohup means to continue when the terminal is closed.
        if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
            names.append("SIGHUP")
        before = {name: signal.signal(getattr(signal, name), self._take) for name in names}
        try:
            yield
        finally:
            for name, handler in before.items():
                signal.signal(getattr(signal, name), handler)

    @contextmanager
    def shield(self) -> Iterator[None]:
        """Let a request wait until what is in here is done."""
        self._shielded = True
        try:
            yield
        finally:
            self._shielded = False
        self.check()

    def check(self) -> None:
        """Stop if that was requested, and has had no effect: libraries have lost a KeyboardInterrupt before.

        Raises
        ------
        KeyboardInterrupt
            It was requested.
        """
        if self.asked and not self._closing:
            self._raised = True
            raise KeyboardInterrupt

    def ignore(self) -> None:
        """Ignore requests from now on: everything is being closed."""
        self._closing = True

    def _take(self, number: int, frame: FrameType | None) -> None:
        self.asked = True
        if not self._shielded and not self._raised:
            self.check()


@dataclass(frozen=True)
class CaptureSummary:
    """Result of a capture."""

    n_bursts: int
    n_frames: int
    n_rejected: int
    recording: Path
    stopped: bool  # by its user, before all bursts were there
    notes: tuple[str, ...]  # what could not be seen or held, one sentence each


def capture_bursts(
    settings: RigSettings,
    open_instruments: Callable[[], tuple[Trigger, Camera]],
    folder: Path,
    plan: CapturePlan,
    *,
    calibration: Calibration | None,
    decoding: DecodeSettings,
    stopping: Stopping,
    notify: Callable[[CaptureProgress], None] = lambda progress: None,
) -> CaptureSummary:
    """Capture bursts until there are enough, or until it is stopped.

    Whatever happens, what was whole is kept: a burst is in the recording and in its log, or in neither.

    Parameters
    ----------
    settings : RigSettings
        The rig.
    open_instruments : callable
        Open its trigger source and its camera.
    folder : Path
        The folder to make: the recording, ``log.jsonl`` and ``calibration.json``.
    plan : CapturePlan
        The number of bursts, and the way to keep them.
    calibration : Calibration, optional
        The rig's.
    decoding : DecodeSettings
        Settings for live decoding.
    stopping : Stopping
        The handler of Ctrl-C.
    notify : callable, optional
        Called with the progress, at the start and after every burst that is kept or thrown away.

    Raises
    ------
    RigError, TriggerError, CameraError, BurstError
        See `Rig`; or the camera sends a Bayer mosaic and does not report which.
    CalibrationError
        The calibration is for frames of another size.
    SettingsError
        The frames to be kept in memory do not fit there.
    OutputError
        The folder is there already or cannot be written, or the disk is full.
    """
    if folder.exists():
        raise taken(folder)  # before any instrument is opened
    stopped = False
    n_taken = 0
    with (
        Rig(settings, open_instruments, lambda rejected: reject(rejected)) as rig,
        CaptureFolder(folder, rig, plan, calibration, decoding) as kept,
    ):

        def reject(rejected: Rejected) -> None:
            kept.reject(rejected)
            notify(kept.progress())

        stopping.check()
        notify(kept.progress())
        kept.wait_for_live()
        bursts = rig.bursts(endless=plan.endless)
        try:
            for burst in islice(bursts, plan.n_bursts):
                with stopping.shield():
                    kept.keep(burst)
                    n_taken += 1
                notify(kept.progress())
            kept.wait_for_live()
        except KeyboardInterrupt:
            stopped = n_taken != plan.n_bursts
        finally:
            stopping.ignore()
            bursts.close()
        notes = rig.notes + kept.notes
    return CaptureSummary(kept.n_bursts, kept.n_frames, kept.n_rejected, kept.recording, stopped, notes)


def watch_bursts(
    settings: RigSettings,
    open_instruments: Callable[[], tuple[Trigger, Camera]],
    *,
    calibration: Calibration | None,
    decoding: DecodeSettings,
    arch: str,
    notify: Callable[[WatchedFrame, int], None],
) -> None:
    """Decode the newest frame of one burst after the other, and keep none of them, until KeyboardInterrupt.

    Parameters
    ----------
    settings, open_instruments, calibration, decoding
        See `capture_bursts`.
    arch : str
        Device to compute on.
    notify : callable
        Called at the start and after every burst, with the frame that is decoded and the number of bursts thrown away.

    Raises
    ------
    RigError, TriggerError, CameraError, BurstError, CalibrationError
        See `capture_bursts`.
    """
    rejected: list[Rejected] = []
    with Rig(settings, open_instruments, rejected.append) as rig:
        limits = rig.camera.limits
        format = pixel_format(limits.format)
        if calibration is not None:
            calibration = calibration.as_read_out(limits.size_px, SensorPart.of(limits), "the camera's frame")
        with LiveDecoder(limits.size_px, decoding, calibration, format, arch) as decoder:
            watched = WatchedFrame(decoder, format)
            notify(watched, 0)
            decoder.wait(LIVE_READY_S)
            number = 0
            with closing(rig.bursts(endless=True)) as bursts:
                for burst in bursts:
                    number += len(burst.frames)
                    watched = watched.offered(burst.frames[-1], number - 1)
                    notify(watched, len(rejected))
