"""`colorphase render` and `colorphase export`: what is made of a result."""

import sys
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from pipeline.cli.console import bounded, counted, remark, say, steps
from pipeline.errors import OutputError
from pipeline.output.mesh_export import export_frames
from pipeline.output.stored_result import MeshKind
from tikernels import runtime


def render(
    input: str,
    /,
    *,
    out: Path,
    view: Literal["three-quarter", "front"] = "three-quarter",
    size: Annotated[tuple[int, int], Parameter(consume_multiple=True)] = (1280, 960),
    turn: Annotated[float, Parameter(validator=bounded(-3600, 3600))] = 0.0,
    sway: Annotated[float, Parameter(validator=bounded(0, 180))] = 0.0,
    colors: Literal["depth", "shaded", "modulation", "sigma"] = "depth",
    fps: Annotated[float, Parameter(validator=bounded(0.1, 1000))] = 30.0,
    seconds: Annotated[float, Parameter(validator=bounded(0.1, 3600))] = 4.0,
) -> None:
    """Draw a mesh, or a film of all frames of a result.zarr, off screen.

    Example: colorphase render face/mesh.ply --out face.png --view front, or
    colorphase render film/result.zarr --out film.mp4 --sway 25 --colors shaded

    Parameters
    ----------
    input
        The mesh, a PLY file; or a result.zarr, a folder or an fsspec URL.
    out
        The PNG to write; of a result.zarr the MP4.
    view
        From where.
    size
        Width and height of the picture in px.
    turn
        How far a film's eye goes round the surface, degrees.
    sway
        How far it swings to either side, once, degrees.
    colors
        What a film's colours show.
    fps
        A film's pictures a second, one a frame.
    seconds
        How long the film of a single frame is.
    """
    from pipeline.output.film import FilmOptions, render_film
    from pipeline.output.mesh_files import read_mesh
    from pipeline.output.render import render_mesh

    if "://" not in input and not Path(input).is_dir():
        if out.suffix.lower() != ".png":
            raise OutputError(f"{out} is not a PNG file: name it .png, or give a result.zarr for a film of it")
        with steps() as step:
            step("reading")
            mesh = read_mesh(input)
            step("drawing")
            render_mesh(mesh, out, view=view, size_px=size)
        return
    options = FilmOptions(view, turn, sway, colors, fps, seconds, size)
    with steps() as step:
        film = render_film(input, out, options, tell=lambda done, of: step(f"picture {done} of {of}"))
    for held in film.held[:1]:
        remark(f"{len(film.held)} frames hold no surface, as frame {held}: the one before is shown in their place")
    say(f"wrote {out}: {film.n_images} pictures, by {film.codec}")


def export(input: str, /, *, out: Path, kind: MeshKind = "ply", force: bool = False) -> None:
    """Write every frame of a result.zarr as a mesh.

    Run again, it writes what is missing, or made of a frame that has been decoded anew.

    Example: colorphase export film/result.zarr --out meshes --kind glb

    Parameters
    ----------
    input
        The result.zarr: a folder, or an fsspec URL.
    out
        The folder for frame_000000.ply and so on.
    kind
        The format; PLY keeps modulation and standard deviation, too.
    force
        Write all again, and replace files of these names that were changed or are not ours.
    """
    if not write_meshes(input, out, kind, force=force):
        sys.exit(1)


def write_meshes(store: str, folder: Path, kind: MeshKind, *, force: bool) -> int:
    """Write every frame of a store that is done as a mesh, say what became of it, and return how many there are."""
    runtime.init("cpu")
    with counted("meshes") as show:
        done = export_frames(store, folder, kind, show, force=force)
    if done.empty:
        remark(f"{len(done.empty)} frames show no surface, as frame {done.empty[0]}: there is no mesh of them")
    n_meshes = len(done.written) + len(done.before) - len(done.empty)
    if not done.written:
        say(f"{n_meshes} meshes in {folder} were exported before, and are whole: --force writes them again")
    else:
        before = f", {len(done.before)} of them before" if done.before else ""
        say(f"{n_meshes} meshes in {folder}{before}")
    return n_meshes
