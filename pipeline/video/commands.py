"""`colorphase decode FOOTAGE`: parse, call, show progress, say what was found."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from pipeline.calibration import Calibration
from pipeline.errors import OutputError, SettingsError
from pipeline.settings import DecodeSettings
from pipeline.store import chosen_fields
from pipeline.video.job import Job, Region
from pipeline.video.run import decode_footage
from pipeline.video.stored import StoredAs
from tikernels.pixel_format import Bayer, Matrix, Siting

#: Exit code where some frames are bad and the rest is done.
SOME_ARE_BAD = 3
_STORE = "result.zarr"
_SHOWN = 10  # bad frames that are named

# Names of files may look like markup.
_out = Console(markup=False, emoji=False)
_err = Console(stderr=True, markup=False, emoji=False)


@Parameter(name="*")
@dataclass(frozen=True)
class FootageOptions:
    """The options for footage."""

    fields: Annotated[tuple[str, ...] | None, Parameter(consume_multiple=True)] = None
    """Which fields to store, as range_image mask; left out, all."""
    start: Annotated[int, Parameter(validator=lambda _, value: _at_least(0, value))] = 0
    """The first frame, from 0."""
    stop: Annotated[int | None, Parameter(validator=lambda _, value: _at_least(0, value))] = None
    """The first frame that is left out again."""
    step: Annotated[int, Parameter(validator=lambda _, value: _at_least(1, value))] = 1
    """Every so many frames."""
    roi: str | None = None
    """The part of each frame that is decoded, in px: x,y,width,height."""
    strict: bool = False
    """Stop at the first bad frame, instead of leaving it out."""
    workers: Annotated[int, Parameter(validator=lambda _, value: _at_least(0, value))] = 0
    """Decode in so many processes."""
    cluster: str | None = None
    """Decode on a Dask cluster: the scheduler's address, as tcp://10.0.0.1:8786."""
    bayer: Bayer | None = None
    """Which mosaic grey footage is."""
    bits: int | None = None
    """How many bits of its values are used."""
    siting: Siting | None = None
    """Where chroma samples sit."""
    matrix: Matrix | None = None
    """How luma was made."""
    full_range: bool | None = None
    """Whether luma uses every level."""

    def region(self) -> Region | None:
        """Return the part of each frame that is decoded.

        Raises
        ------
        SettingsError
            It is not described by four whole numbers.
        """
        if self.roi is None:
            return None
        parts = self.roi.split(",")
        if (
            len(parts) != 4
            or not all(part.strip().isdigit() for part in parts)
            or "0" in (p.strip() for p in parts[2:])
        ):
            raise SettingsError(f"--roi is {self.roi!r}: give x,y,width,height in px, as in 100,50,640,480")
        return Region(*map(int, parts))


def _at_least(least: int, value: int | None) -> None:
    if value is not None and value < least:
        raise ValueError(f"must be {least} or more")


def decode_video(
    footage: Path,
    out: str,
    settings: DecodeSettings,
    calibration: Calibration | None,
    arch: str,
    options: FootageOptions,
    *,
    force: bool,
) -> None:
    """Decode footage and say what became of it; exit with code 3 where frames are bad.

    Raises
    ------
    OutputError
        The folder holds something else, or cannot be written.
    """
    job = Job(
        footage=str(footage),
        says=StoredAs(options.bayer, options.bits, options.siting, options.matrix, options.full_range),
        settings=settings,
        calibration=calibration,
        region=options.region(),
        step=options.step,
        first=options.start % options.step,
        fields=chosen_fields(options.fields, in_mm=calibration is not None and calibration.has_geometry),
        store=f"{out.rstrip('/')}/{_STORE}",
        arch=arch,
    )
    if "://" not in out and Path(out).is_dir() and not force:
        others = sorted(entry.name for entry in Path(out).iterdir() if entry.name != _STORE)
        if others:
            raise OutputError(f"{out} holds something else ({others[0]}): choose another folder, or add --force")
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        _Rate(),
        TimeRemainingColumn(),
        console=_err,
        transient=True,
        disable=not _err.is_terminal,
    ) as progress:
        task = progress.add_task("starting", total=None)

        def show(done: int, of: int) -> None:
            if progress.tasks[0].total is None:  # what was done before says nothing of the rate
                progress.reset(task, total=of, completed=done, description="decoding")
            else:
                progress.update(task, completed=done)

        summary = decode_footage(
            job,
            options.start,
            options.stop,
            strict=options.strict,
            workers=options.workers,
            cluster=options.cluster,
            tell=show,
        )
    for note in summary.notes:
        _say(f"note: {note}")
    for bad in summary.bad[:_SHOWN]:
        _say(f"frame {bad.number} is bad: {bad.reason}")
    if len(summary.bad) > _SHOWN:
        _say(f"and {len(summary.bad) - _SHOWN} more frames are bad")
    if summary.warned:
        first = min(summary.warned)
        _say(f"warning: {len(summary.warned)} frames are in doubt; frame {first}: {summary.warned[first][0]}")
    n_good = summary.n_frames - len(summary.bad)
    before = f", {summary.n_before} of them before" if summary.n_before else ""
    _out.print(
        f"{n_good} of {summary.n_frames} frames decoded{before}; they are in {job.store}",
        highlight=False,
        soft_wrap=True,
    )
    if summary.bad:
        sys.exit(SOME_ARE_BAD)


class _Rate(ProgressColumn):
    """Frames a second."""

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text("" if speed is None else f"{speed:.1f} frames/s")


def _say(text: str) -> None:
    _err.print(text, style="yellow", highlight=False, soft_wrap=True)
