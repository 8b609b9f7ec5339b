"""`colorphase decode FOOTAGE`: parse, call, show progress, say what was found."""

import re
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

from pipeline.batch.job import Crop, Job
from pipeline.batch.run import decode_footage
from pipeline.calibration import Calibration
from pipeline.errors import OutputError, SettingsError
from pipeline.footage.source import StoredAs
from pipeline.output.store import chosen_fields
from pipeline.output.stored_result import MeshKind, export_frames, mesh_fields
from pipeline.settings import DecodeSettings
from tikernels import runtime

#: Exit code where some frames are bad and the rest is done.
SOME_ARE_BAD = 3
_STORE, _MESHES = "result.zarr", "meshes"
_DIGITS = re.compile("[0-9]{1,6}")
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
    export: MeshKind | None = None
    """Write a mesh of each frame, too, into the folder meshes."""

    def crop(self) -> Crop | None:
        """Return the part of each frame that is decoded.

        Raises
        ------
        SettingsError
            It is not described by four whole numbers.
        """
        if self.roi is None:
            return None
        parts = [int(part) if _DIGITS.fullmatch(part.strip()) else -1 for part in self.roi.split(",")]
        if len(parts) != 4 or min(parts) < 0 or min(parts[2:]) < 1:
            raise SettingsError(f"--roi is {self.roi!r}: give x,y,width,height in px, as in 100,50,640,480")
        return Crop(*parts)


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
    stored_as: StoredAs,
    *,
    force: bool,
) -> None:
    """Decode footage and say what became of it; exit with code 3 where frames are bad.

    Raises
    ------
    OutputError
        The folder holds something else, or cannot be written.
    """
    in_mm = calibration is not None and calibration.has_geometry
    job = Job(
        footage=str(footage),
        says=stored_as,
        settings=settings,
        calibration=calibration,
        crop=options.crop(),
        step=options.step,
        first=options.start % options.step,
        fields=chosen_fields(options.fields, in_mm=in_mm),
        store=f"{out.rstrip('/')}/{_STORE}",
        arch=arch,
    )
    meshes = Path(out, _MESHES)
    if options.export is not None:
        if "://" in out:
            raise SettingsError(
                f"meshes go into folders here: leave --export away, and run colorphase export {job.store}"
            )
        lacking = [name for name in mesh_fields(in_mm=in_mm) if name not in job.fields]
        if lacking:
            raise SettingsError(f"meshes are made of {' and '.join(lacking)}: add that to --fields")
    if "://" not in out and Path(out).is_dir() and not force:
        others = sorted(entry.name for entry in Path(out).iterdir() if entry.name not in (_STORE, _MESHES))
        if others:
            raise OutputError(f"{out} holds something else ({others[0]}): choose another folder, or add --force")
    with _progress() as progress:
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
    if options.export is not None:
        write_meshes(job.store, meshes, options.export)
    if summary.bad:
        sys.exit(SOME_ARE_BAD)


def write_meshes(store: str, folder: Path, kind: MeshKind) -> int:
    """Write every frame of a store that is done as a mesh, say what became of it, and return how many there are."""
    runtime.init("cpu")
    with _progress() as progress:
        task = progress.add_task("meshes", total=None)
        written, empty = export_frames(
            store, folder, kind, lambda done, of: progress.update(task, completed=done, total=of)
        )
    if empty:
        _say(f"{len(empty)} frames show no surface, as frame {empty[0]}: there is no mesh of them")
    _out.print(f"{written} meshes in {folder}", highlight=False, soft_wrap=True)
    return written


def _progress() -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        _Rate(),
        TimeRemainingColumn(),
        console=_err,
        transient=True,
        disable=not _err.is_terminal,
    )


class _Rate(ProgressColumn):
    """Frames a second."""

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text("" if speed is None else f"{speed:.1f} frames/s")


def _say(text: str) -> None:
    _err.print(text, style="yellow", highlight=False, soft_wrap=True)
