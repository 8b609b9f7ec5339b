"""`colorphase capture`: parse, call, show how it stands, say what became of it."""

import sys
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from functools import partial
from math import inf
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress as Bar
from rich.progress import SpinnerColumn, TextColumn, TimeElapsedColumn

from hardware.errors import ProjectorError
from hardware.instruments import open_instruments
from hardware.projector import open_projector
from hardware.settings import RigSettings
from pipeline.acquisition import session
from pipeline.acquisition.capture_folder import CALIBRATION, LOG, CapturePlan, CaptureProgress
from pipeline.acquisition.rig_file import read_rig
from pipeline.acquisition.session import CaptureSummary
from pipeline.acquisition.stopping import Stopping
from pipeline.calibration import Calibration
from pipeline.errors import SettingsError
from pipeline.settings import DecodeSettings

_SIMULATED = "simulated"
#: Exit code where it was stopped before all bursts were there.
_STOPPED = 130

_out = Console(markup=False, emoji=False)
_err = Console(stderr=True, markup=False, emoji=False)


def capture(
    *,
    rig: str,
    out: Path,
    bursts: Annotated[int | None, Parameter(validator=lambda _, value: _positive(value))] = None,
    endless: bool = False,
    keep_last: Annotated[float | None, Parameter(validator=lambda _, value: _positive(value))] = None,
    format: Literal["zarr", "mkv"] = "zarr",
    live: bool = False,
    settings: Path | None = None,
    arch: Literal["auto", "cpu", "vulkan", "cuda", "metal"] = "auto",
) -> None:
    """Fire projector and camera, and record every frame with the pulse that it belongs to.

    A burst is kept whole, or thrown away and fired again, three times at most. The folder gets the recording, log.jsonl
    and the rig's calibration.json.

    Example: colorphase capture --rig rig.toml --out face --bursts 10, or
    colorphase capture --rig simulated --out captured --endless --live

    Parameters
    ----------
    rig
        The rig's TOML file; or "simulated", which needs nothing to be there.
    out
        The folder to make.
    bursts
        How many; left out, one, or with --endless or --keep-last as many as come until Ctrl-C.
    endless
        Let pulses run on without a gap, until Ctrl-C.
    keep_last
        Keep frames in memory until Ctrl-C, and record only so many seconds before it.
    format
        "zarr" is fast, "mkv" (FFV1) a third smaller.
    live
        Decode the newest frame meanwhile, into live.png, and show how long after its exposure that is done.
    settings
        TOML file of settings for --live.
    arch
        Where --live computes, and the simulated rig is rendered.
    """
    from pipeline.acquisition.simulated_capture import SETTINGS, simulated_instruments

    if settings is not None and not live:
        raise SettingsError(f"{settings} tells how --live decodes: add --live, or leave --settings away")
    stopping = Stopping()
    calibration: Calibration | None
    with stopping.listening():  # to the last line, which who asks twice is not to miss
        with _status() as show:
            wiring = SETTINGS if rig == _SIMULATED else read_rig(rig)
            if wiring.trigger.driver == wiring.camera.driver == _SIMULATED:
                opened, calibration = simulated_instruments(wiring, arch, show)
            else:
                calibration = None if wiring.calibration is None else Calibration.read(wiring.calibration)
                opened = partial(open_instruments, wiring)
                _check_projector(wiring, rig)
            for note in _differences(wiring, calibration):
                _say(f"note: {note}")
            plan = CapturePlan(
                n_bursts=1 if bursts is None and not endless and keep_last is None else bursts,
                endless=endless,
                keep_last_s=keep_last,
                suffix=f".{format}",
                live=live,
                arch=arch,
            )
            show("opening trigger source and camera")
            summary = session.capture_bursts(
                wiring,
                opened,
                out,
                plan,
                calibration=calibration,
                decoding=DecodeSettings() if settings is None else DecodeSettings.read(settings),
                stopping=stopping,
                tell=lambda progress: show(_line(progress)),
            )
        for note in summary.notes:
            _say(f"note: {note}")
        if not summary.n_frames:
            _err.print("stopped before a burst was whole: nothing is kept", style="red")
            sys.exit(_STOPPED)
        if summary.n_rejected:
            _say(f"{_times(summary.n_rejected)} a burst was thrown away; {out / LOG} says why")
        what = f"recorded {_frames(summary)} in {summary.recording}"
        _out.print(f"{what}; each frame's pulse is in {out / LOG}", highlight=False, soft_wrap=True)
        rig_file = "" if calibration is None else f" --calibration {out / CALIBRATION}"
        _out.print(
            f"colorphase decode {summary.recording} --out {out / 'decoded'}{rig_file}", highlight=False, soft_wrap=True
        )
        if summary.stopped and bursts is not None:
            sys.exit(_STOPPED)


def _check_projector(wiring: RigSettings, rig: str) -> None:
    """Refuse a projector that is known to show nothing."""
    if wiring.projector.control is None:
        return
    with closing(open_projector(wiring.projector)) as projector:
        found = projector.status()
    if found.power not in ("on", None):
        raise ProjectorError(f"the projector is {found.power}: run `colorphase projector on --rig {rig}`")
    if found.blank:
        raise ProjectorError(f"the projector shows black: run `colorphase projector unblank --rig {rig}`")


def _differences(wiring: RigSettings, calibration: Calibration | None) -> list[str]:
    """Say where the camera stands otherwise than at calibration."""
    before = None if calibration is None or calibration.capture is None else calibration.capture.exposure_s
    if before is None or abs(wiring.camera.exposure_s / before - 1) < 1e-3:
        return []
    return [f"the exposure is {wiring.camera.exposure_s:g} s, and was {before:g} s at calibration"]


def _say(text: str) -> None:
    _err.print(text, style="yellow", highlight=False, soft_wrap=True)


def _times(n: int) -> str:
    return {1: "once", 2: "twice"}.get(n, f"{n} times")


def _frames(counted: CaptureProgress | CaptureSummary) -> str:
    counts = ((counted.n_frames, "frame"), (counted.n_bursts, "burst"))
    return " of ".join(f"{n} {word}{'' if n == 1 else 's'}" for n, word in counts)


def _positive(value: float | None) -> None:
    if value is not None and not 0 < value < inf:  # nor NaN
        raise ValueError("must be above 0, and a number")


def _line(progress: CaptureProgress) -> str:
    parts = [_frames(progress), f"{progress.rate_hz:.0f} frames/s"]
    if progress.latency_s is not None:
        parts.append(f"{1e3 * progress.latency_s:.0f} ms from strobe to range image")
    if progress.n_rejected:
        parts.append(f"{_times(progress.n_rejected)} a burst was thrown away ({progress.note})")
    return ", ".join(parts)


@contextmanager
def _status() -> Iterator[Callable[[str], None]]:
    """Show one line, live on a terminal."""
    columns = SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn()
    with Bar(*columns, console=_err, transient=True, disable=not _err.is_terminal) as bar:
        task = bar.add_task("starting")
        yield lambda line: bar.update(task, description=escape(line))
