"""`colorphase capture`: parse, call, show how it stands, say what became of it."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter
from rich.console import Console
from rich.progress import Progress as Bar
from rich.progress import SpinnerColumn, TextColumn, TimeElapsedColumn

from hardware.instruments import open_instruments
from pipeline.calibration import Calibration
from pipeline.capture.session import CALIBRATION, Plan, Progress, capture
from pipeline.capture.stopping import Stopping
from pipeline.errors import SettingsError
from pipeline.rig_file import read_rig
from pipeline.settings import DecodeSettings

_SIMULATED = "simulated"
#: Exit code where it was stopped before all bursts were there.
_STOPPED = 130

_out = Console(markup=False, emoji=False)
_err = Console(stderr=True, markup=False, emoji=False)


def capture_command(
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
        How many; left out, one, or with --endless as many as come until Ctrl-C.
    endless
        Let pulses run on without a gap, until Ctrl-C.
    keep_last
        Keep frames in memory, and record only so many seconds before it is stopped.
    format
        "zarr" is fast, "mkv" (FFV1) a third smaller.
    live
        Decode the newest frame meanwhile, into live.png, and show how long after its exposure that is done.
    settings
        TOML file of settings for --live.
    arch
        Where --live computes, and the simulated rig is rendered.
    """
    stopping = Stopping()
    with stopping.listening(), _status() as show:
        if rig == _SIMULATED:
            from pipeline.capture.simulated_rig import SETTINGS, simulated_instruments

            opened, calibration = simulated_instruments(arch, show)
            wiring = SETTINGS
        else:
            wiring = read_rig(rig)
            calibration = None if wiring.calibration is None else Calibration.read(wiring.calibration)
            opened = lambda: open_instruments(wiring)  # noqa: E731
        plan = Plan(
            n_bursts=1 if bursts is None and not endless else bursts,
            endless=endless,
            keep_last_s=keep_last,
            suffix=f".{format}",
            live=live,
            arch=arch,
        )
        show("opening trigger source and camera")
        summary = capture(
            wiring,
            opened,
            out,
            plan,
            calibration=calibration,
            decoding=DecodeSettings() if settings is None else DecodeSettings.read(settings),
            stopping=stopping,
            tell=lambda progress: show(_line(progress)),
        )
