"""`colorphase decode`: a picture, or footage."""

import sys
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from pipeline.batch.job import Crop
from pipeline.batch.run import DecodeSummary, decode_footage, wanted_fields
from pipeline.calibration import Calibration
from pipeline.cli.console import (
    SOME_ARE_BAD,
    Arch,
    IntoOther,
    SettingsFile,
    bounded,
    counted,
    frames,
    part_of,
    read_calibration,
    read_settings,
    remark,
    say,
    steps,
)
from pipeline.cli.export import MeshChoice, write_frames
from pipeline.errors import FootageError, SettingsError
from pipeline.footage.footage import StoredAs
from pipeline.footage.image_folder import is_footage
from pipeline.models import CodeChoice
from pipeline.output.folder import MESHES, STORE
from pipeline.output.formats.table import format_of
from pipeline.output.report import depth_in_words
from pipeline.output.store import chosen_fields
from pipeline.output.stored_result import StoredResult, mesh_fields
from pipeline.output.surface_mesh import MeshOptions
from pipeline.settings import DecodeSettings

_SHOWN = 10  # bad frames that are named


@Parameter(name="*")
@dataclass(frozen=True)
class SettingsOptions:
    """The most common settings; they overrule those of --settings."""

    stripes: Literal["horizontal", "vertical"] | None = None
    """Horizontal where the phase changes from row to row."""
    transfer: Literal["linear", "srgb", "bt709"] | None = None
    """The camera's encoding of light; left out, that of the calibration or the file."""
    period: float | None = None
    """Camera px per cycle, roughly; left out, measured from the frame."""
    code: CodeChoice | None = None
    """The pattern's code; left out, the calibration states it, or the first frame with fringes shows it."""
    smoothing: int | None = None
    """Side of the window that the phase is smoothed over, px, an odd number; 0: none."""

    def applied_to(self, settings: DecodeSettings) -> DecodeSettings:
        """Return settings in which these are replaced.

        Raises
        ------
        SettingsError
            A value is wrong.
        """
        names = {"period": "camera_period_px", "smoothing": "smoothing_px"}
        given = {names.get(name, name): value for name, value in asdict(self).items() if value is not None}
        if not given:
            return settings
        return settings.replace(**given)


@Parameter(name="*")
@dataclass(frozen=True)
class FootageOptions:
    """The options for footage."""

    fields: Annotated[tuple[str, ...] | None, Parameter(consume_multiple=True)] = None
    """The fields to store, as range_image mask, or all; left out, mask, phase_sigma, absolute and points, or
    range_image without a calibration."""
    start: Annotated[int, Parameter(validator=bounded(0))] = 0
    """The first frame, from 0."""
    stop: Annotated[int | None, Parameter(validator=bounded(0))] = None
    """The first frame that is left out again."""
    step: Annotated[int, Parameter(validator=bounded(1))] = 1
    """Decode every n-th frame."""
    roi: str | None = None
    """The part of each frame that is decoded, in px: x,y,width,height."""
    strict: bool = False
    """Stop at the first bad frame, instead of leaving it out."""
    workers: Annotated[int | None, Parameter(validator=bounded(1))] = None
    """In how many processes to decode; left out, one for each core, or a single one with a GPU."""
    cluster: str | None = None
    """Decode on a Dask cluster: the scheduler's address, as tcp://10.0.0.1:8786."""
    export: str | None = None
    """Write each frame in another format, too, as ply, glb or pcd, into the folder meshes."""


_FOOTAGE, _AS_SET, _ALL = FootageOptions(), SettingsOptions(), MeshChoice()
_AS_IT_SAYS = StoredAs()


def decode(
    input: Path,
    /,
    *,
    out: str,
    settings: SettingsFile = None,
    calibration: Path | None = None,
    depth_range: tuple[float, float] | None = None,
    arch: Arch = "auto",
    force: IntoOther = False,
    mesh: bool = True,
    chosen: SettingsOptions = _AS_SET,
    video: FootageOptions = _FOOTAGE,
    part: MeshChoice = _ALL,
    stored_as: Annotated[StoredAs, Parameter(name="*")] = _AS_IT_SAYS,
) -> None:
    """Decode a picture, or footage: a folder of pictures, a video or a recording.

    A picture gives result.zarr, mesh.ply, range.png, shaded.png and report.json, footage result.zarr. Run again, it
    continues where it was stopped. Exit code 3: some frames are bad or show nothing, the rest is done; 1: nothing was
    measured.

    Example: colorphase decode face.png --out face --settings settings.toml --calibration calibration.json, or
    colorphase decode film.mkv --out film --fields mask points phase_sigma --export ply

    Parameters
    ----------
    input
        The picture or footage.
    out
        Folder for the results; footage's may be an fsspec URL, as s3://bucket/film.
    calibration
        The rig's calibration.json; with it results are in mm.
    depth_range
        The nearest and the farthest depth of what was photographed, mm; it places surfaces without a code.
    mesh
        Write a picture's mesh.ply; --no-mesh leaves it out.
    """
    how, rig = chosen.applied_to(read_settings(settings)), _within(read_calibration(calibration), depth_range)
    if is_footage(input):
        if part != _ALL and video.export is None:
            raise SettingsError("--crop, --no-background and --triangles are for meshes: add --export, or omit them")
        if not mesh:
            raise SettingsError("--no-mesh does nothing for footage, which gets meshes by --export: leave it out")
        _decode_video(input, out, how, rig, arch, video, part.options(), stored_as, force=force)
        return
    if video != _FOOTAGE:
        given = ", ".join(f"--{each.name}" for each in fields(video) if getattr(video, each.name) != each.default)
        raise SettingsError(f"{input.name} is a picture, and only footage takes {given}: omit that, or give its folder")
    if not mesh and part != _ALL:
        raise SettingsError("--no-mesh leaves nothing for --crop, --no-background and --triangles: leave them out")
    from pipeline.batch.one_frame import decode_picture

    options = part.options() if mesh else None
    with steps() as step:
        frame, notes = decode_picture(
            input, out, how, rig, stored_as, arch, options, force=force, notify=step, remark=remark
        )
    for note in notes:
        remark(f"note: {note}")
    say(f"{frame.mask.mean():.1%} of the pixels measured; wrote {out}")
    relative = depth_in_words(frame, front_known=frame.front_known)
    if relative is not None:
        say(relative)


def _within(rig: Calibration | None, depth_range_mm: tuple[float, float] | None) -> Calibration | None:
    """Return a calibration with the depths at which things are."""
    if depth_range_mm is None:
        return rig
    if rig is None or not rig.has_geometry:
        raise SettingsError("--depth-range is in mm: give a --calibration with the rig's geometry, too")
    nearest, farthest = depth_range_mm
    if not 0 < nearest < farthest:
        raise SettingsError(
            f"--depth-range is {nearest:g} {farthest:g}: give the nearest and the farthest depth in mm, as 700 1100"
        )
    return rig.replace(depth_range_mm=depth_range_mm)


def _decode_video(
    footage: Path,
    out: str,
    settings: DecodeSettings,
    calibration: Calibration | None,
    arch: str,
    options: FootageOptions,
    part: MeshOptions,
    stored_as: StoredAs,
    *,
    force: bool,
) -> None:
    """Decode footage and report the result; exit with code 3 where frames are bad."""
    store = f"{out.rstrip('/')}/{STORE}"
    if options.export is not None:
        _check_meshes(out, options.fields, options.export, in_mm=calibration is not None and calibration.has_geometry)
    with counted("decoding") as show:
        summary = decode_footage(
            footage,
            out,
            settings,
            calibration,
            fields=options.fields,
            start=options.start,
            stop=options.stop,
            step=options.step,
            crop=None if options.roi is None else Crop(*part_of(options.roi, "--roi")),
            on_bad="raise" if options.strict else "skip",
            workers=options.workers,
            cluster=options.cluster,
            arch=arch,
            stored_as=stored_as,
            force=force,
            progress=show.progress,
        )
    _say_summary(summary, store)
    _say_whether_relative(store)
    if len(summary.unmeasured) == summary.n_frames - len(summary.bad):
        raise FootageError(f"nothing was measured in {footage.name}: run colorphase inspect {footage}")
    if options.export is not None:
        write_frames(store, Path(out, MESHES), options.export, part, force=force)
    if summary.bad or summary.unmeasured:
        sys.exit(SOME_ARE_BAD)


def _check_meshes(out: str, names: tuple[str, ...] | None, kind: str, *, in_mm: bool) -> None:
    """Refuse files that could not be made, before footage is decoded for hours."""
    if "://" in out:
        store = f"{out.rstrip('/')}/{STORE}"
        raise SettingsError(f"meshes go into folders here: omit --export, and run colorphase export {store}")
    fields = chosen_fields(wanted_fields(names, in_mm=in_mm), in_mm=in_mm)
    lacking = [name for name in mesh_fields(in_mm=in_mm) if name not in fields]
    if lacking:
        raise SettingsError(f"meshes are made of {' and '.join(lacking)}: add that to --fields")
    form = format_of(kind)
    if form.encode_mesh is None and not in_mm:
        raise SettingsError(f"{form.meaning} is in mm: give a --calibration that holds the geometry")


def _say_whether_relative(location: str) -> None:
    """Say of the last frame whether its depth is only relative."""
    stored = StoredResult(location)
    if not len(stored):
        return
    frame = stored[-1]
    relative = depth_in_words(frame, front_known=stored.front_known)
    if relative is not None:
        say(f"frame {frame.number}: {relative}")


def _say_summary(summary: DecodeSummary, store: str) -> None:
    first = min(summary.warned, default=None)
    doubt = None if first is None else summary.warned[first][0]
    for note in summary.notes:
        if note != doubt:  # which is reported below
            remark(f"note: {note}")
    if summary.damaged:
        number, fault = min(summary.damaged.items())
        remark(f"{frames(len(summary.damaged))} decoded again; frame {number}: {fault}")
    for bad in summary.bad[:_SHOWN]:
        remark(f"frame {bad.number} is bad: {bad.reason}")
    if len(summary.bad) > _SHOWN:
        remark(f"and {len(summary.bad) - _SHOWN} more frames are bad")
    if doubt is not None:
        remark(f"warning: {frames(len(summary.warned))} in doubt; frame {first}: {doubt}")
    if summary.unmeasured:
        remark(f"{frames(len(summary.unmeasured))} empty, as frame {summary.unmeasured[0]}: nothing was measured there")
    n_good = summary.n_frames - len(summary.bad)
    before = f", {summary.n_before} of them before" if summary.n_before else ""
    say(f"{n_good} of {summary.n_frames} frames decoded{before}; they are in {store}")
