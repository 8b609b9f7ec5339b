"""One capture: fire, record, log, and decode the newest frame meanwhile."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from hardware.protocols import Camera, Trigger
from hardware.rig import Rejected, Rig
from hardware.settings import RigSettings
from pipeline.acquisition.capture_folder import CaptureFolder, CapturePlan, CaptureProgress, taken
from pipeline.acquisition.stopping import Stopping
from pipeline.calibration import Calibration
from pipeline.settings import DecodeSettings


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
        See `Rig`; or the camera sends a Bayer mosaic and does not say which.
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
            tell(kept.progress())

        stopping.check()
        tell(kept.progress())
        bursts = rig.bursts(endless=plan.endless)
        try:
            for burst in islice(bursts, plan.n_bursts):
                with stopping.shield():
                    kept.keep(burst)
                    n_taken += 1
                tell(kept.progress())
        except KeyboardInterrupt:
            stopped = n_taken != plan.n_bursts
        finally:
            stopping.ignore()
            bursts.close()
        notes = rig.notes + kept.notes
    return CaptureSummary(kept.n_bursts, kept.n_frames, kept.n_rejected, kept.recording, stopped, notes)
