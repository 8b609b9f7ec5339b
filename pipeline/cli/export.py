"""`colorphase export`: a result as files for other programs."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from pipeline.cli.console import SOME_ARE_BAD, bounded, counted, frames, remark, say
from pipeline.errors import FootageError, OutputError, SettingsError
from pipeline.output.folder import store_in
from pipeline.output.formats.table import format_of
from pipeline.output.frame_export import export_frames
from pipeline.output.surface_mesh import MeshOptions
from pipeline.recording.video_export import export_video
from tikernels import runtime


@Parameter(name="*")
@dataclass(frozen=True)
class MeshChoice:
    """The parts to leave out of meshes."""

    crop: Annotated[tuple[float, float, float, float, float, float] | None, Parameter(consume_multiple=True)] = None
    """Keep what is inside a box: two opposite corners, x0 y0 z0 x1 y1 z1, mm in the camera's frame (x right, y down, z
    away from it)."""
    background: Annotated[bool, Parameter(negative="--no-background")] = True
    """Keep the largest plane; --no-background leaves it out, as a wall or a table."""
    triangles: Annotated[int | None, Parameter(validator=bounded(1))] = None
    """The most triangles that a mesh may have; of a larger one vertices are left out."""
    smooth: bool = True
    """Move vertices to the surface through their neighbours; --no-smooth leaves each where it was measured."""

    def options(self) -> MeshOptions:
        """Return the same as a mesh takes it."""
        return MeshOptions(self.smooth, self.crop, not self.background, self.triangles)


_ALL = MeshChoice()


def export(
    input: str,
    /,
    *,
    out: Path | None = None,
    kind: str = "ply",
    force: bool = False,
    part: MeshChoice = _ALL,
) -> None:
    """Write every frame of a result in a format that other programs open, or a recording as a video.

    Run again, it writes what is missing, or made of a frame that has been decoded anew. Exit code 3: some frames are
    damaged or empty, the rest is written.

    Example: colorphase export film/result.zarr --out meshes --kind glb, or
    colorphase export face --out print --kind stl --no-background

    Parameters
    ----------
    input
        The result.zarr, or the folder that it is in; or an fsspec URL. With --kind mkv a recording, recording.zarr.
    out
        The folder for frame_000000.ply and so on; for a video, left out, the folder that its recording is in.
    kind
        The format: meshes as ply, obj, stl, glb or wrl; the camera's grid of points as pcd or npz; measured points as
        xyz or csv; depth as 16-bit png or tiff; all frames in one ROS bag as mcap. Of a recording a lossless video
        (FFV1) as mkv, which decodes to the same. Installed packages may add others.
    force
        Write all again, and replace files of these names that were changed or are not ours.
    """
    if kind == "mkv":
        _write_video(Path(input), out, force=force)
        return
    if out is None:
        raise SettingsError("where are the files to go? Name a folder, as --out meshes")
    if not write_frames(store_in(input), out, kind, part.options(), force=force):
        sys.exit(SOME_ARE_BAD)


def _write_video(recording: Path, folder: Path | None, *, force: bool) -> None:
    """Write a recording as a video of its name, and print where it is."""
    video = (recording.parent if folder is None else folder) / f"{recording.stem}.mkv"
    if video.exists() and not force:
        raise OutputError(f"{video} exists: choose another folder, or --force replaces it")
    with counted("frames") as show:
        n_frames = export_video(recording, video, show)
    say(f"{n_frames} frame{'s' if n_frames != 1 else ''} as FFV1 in {video}")


def write_frames(store: str, folder: Path, kind: str, options: MeshOptions, *, force: bool) -> bool:
    """Write every frame of a store that is done, report the result, and return whether there is a file of each.

    Raises
    ------
    FootageError
        No frame shows a surface.
    SettingsError
        There is no such format.
    """
    form = format_of(kind)
    runtime.init("cpu")
    with counted("frames") as show:
        done = export_frames(store, folder, kind, show, options=options, force=force, remark=remark)
    n_files = len(done.written) + len(done.before) - len(done.empty)
    if not n_files:
        raise FootageError(f"no frame of {store} shows a surface: run colorphase inspect on the footage")
    if done.empty:
        remark(f"{frames(len(done.empty))} empty, as frame {done.empty[0]}: there is no file of what shows no surface")
    for number, why in sorted(done.damaged.items())[:1]:
        remark(f"{frames(len(done.damaged))} damaged and left out; frame {number}: {why}")
    what = f"{n_files} frame{'s' if n_files != 1 else ''} as {form.meaning} in {folder}"
    if not done.written:
        say(f"{what} were exported before, and are whole: --force writes them again")
    else:
        before = f", {len(done.before)} of them before" if done.before else ""
        say(f"{what}{before}")
    return not done.damaged and not done.empty
