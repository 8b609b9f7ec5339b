"""`colorphase render`: pictures of a result, without a screen."""

import sys
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from pipeline.cli.console import SOME_ARE_BAD, bounded, counted, frames, remark, say, steps
from pipeline.errors import OutputError, SettingsError
from pipeline.output.folder import store_in
from pipeline.output.mesh_files import read_mesh
from pipeline.output.pictures.color_meaning import Colors
from pipeline.output.pictures.drawing_process import MOST_SIDE_PX, Buffer, PictureOptions
from pipeline.output.pictures.viewpoint import CameraPath, View, Viewpoint
from pipeline.output.stored_result import StoredResult


def render(
    input: str,
    /,
    *,
    out: Path,
    frame: int | None = None,
    view: View | None = None,
    camera: Annotated[tuple[float, ...] | None, Parameter(consume_multiple=True)] = None,
    camera_path: Path | None = None,
    turn: Annotated[float | None, Parameter(validator=bounded(-3600, 3600))] = None,
    sway: Annotated[float | None, Parameter(validator=bounded(0, 180))] = None,
    colors: Colors | None = None,
    compare: Path | None = None,
    buffers: Annotated[tuple[Buffer, ...], Parameter(consume_multiple=True)] = (),
    size: Annotated[tuple[int, int], Parameter(consume_multiple=True)] = (1280, 960),
    fps: Annotated[float | None, Parameter(validator=bounded(0.1, 1000))] = None,
    seconds: Annotated[float | None, Parameter(validator=bounded(0.1, 3600))] = None,
) -> None:
    """Draw a surface, or frames of a result.zarr, off screen: a still picture, a turntable, or a film of all frames.

    A film that was stopped goes on by the same command. Exit code 3: some frames are missing, empty or
    damaged, the rest is drawn.

    Example: colorphase render face/mesh.ply --out face.png --view front --colors depth, or
    colorphase render face/mesh.ply --out turntable.mp4 --turn 360, or
    colorphase render film/result.zarr --out film.mp4 --sway 25

    Parameters
    ----------
    input
        A mesh, a PCD file, a depth picture or a bag (.mcap); or a result.zarr, the folder that it is in, or an fsspec
        URL.
    out
        The PNG to write; or the MP4.
    frame
        The only frame of a result.zarr or a bag to draw; left out, a film shows all of a result.zarr.
    view
        From where, so that all is seen; left out, three-quarter.
    camera
        From where by numbers: x, y, z of the eye, and of the point that it looks at, mm in the camera's frame (x right,
        y down, z away from it); and, if wanted, of what is up.
    camera_path
        A TOML file with the way of a film's eye, a table keyframes for each place: at, position, focal_point, up.
    turn
        How far a film's eye goes round the surface, degrees.
    sway
        How far it swings to either side, once, degrees.
    colors
        What colours show; left out, nothing (clay), so that relief is seen.
    compare
        Another mesh in mm, the signed distance from which colours show, in place of --colors.
    buffers
        What to write in addition to a still: NAME.depth.tiff (float32, mm before the eye), NAME.normals.png.
    size
        Width and height of the picture in px.
    fps
        A film's pictures a second, one a frame; left out, 30.
    seconds
        How long the film of a single surface is; left out, 4.
    """
    store = _store(input)
    asked = {"frame": frame, "fps": fps, "seconds": seconds, "turn": turn, "sway": sway, "camera-path": camera_path}
    given = {name for name, value in asked.items() if value is not None} | ({"buffers"} if buffers else set())
    film = out.suffix.lower() == ".mp4"
    if not film and out.suffix.lower() != ".png":
        raise OutputError(f"{out} is neither a PNG nor an MP4 file: name it .png for a still picture, .mp4 for a film")
    result = None if store is None else StoredResult(store)
    _refuse_useless(given, result, frame, film=film, of_bag=Path(input).suffix.lower() == ".mcap")
    _refuse_pairs({"view": view, "camera": camera, "camera-path": camera_path}, {"colors": colors, "compare": compare})
    if camera_path is not None and given & {"turn", "sway"}:
        raise SettingsError("--camera-path moves the eye already: leave out --turn and --sway")
    chosen: dict[str, Any] = {
        "view": view,
        "camera": None if camera is None else Viewpoint.of_numbers(camera),
        "path": None if camera_path is None else CameraPath.read(camera_path),
        **{"turn_deg": turn, "sway_deg": sway, "colors": colors, "fps": fps, "seconds": seconds, "size_px": size},
    }
    if not all(16 <= side <= MOST_SIDE_PX for side in size):
        raise SettingsError(f"--size is {size[0]}x{size[1]}: give 16 to {MOST_SIDE_PX} px")
    options = PictureOptions(**{name: value for name, value in chosen.items() if value is not None})
    number = frame if result is None or frame is not None else _only_frame(result)
    if film:
        _render_film(input if store is None else store, out, options, number, compare, is_store=store is not None)
    else:
        _render_still(input if store is None else store, out, options, number, compare, buffers)


def _store(input: str) -> str | None:
    """Return where the result.zarr is; None: the input is a mesh."""
    place = store_in(input)
    return place if "://" in place or Path(place).is_dir() or Path(place).suffix == ".zarr" else None


def _refuse_useless(
    given: set[str], result: StoredResult | None, frame: int | None, *, film: bool, of_bag: bool
) -> None:
    """Refuse options that would do nothing."""
    many = result is not None and frame is None and len(result.wanted) > 1
    useless = {
        "a still picture": given & {"fps", "seconds", "turn", "sway", "camera-path"} if not film else set(),
        "a film": given & {"buffers"} if film else set(),
        "a mesh's file": given & {"frame"} if result is None and not of_bag else set(),
        "a film of many frames, which is one picture a frame long": given & {"seconds"} if film and many else set(),
    }
    for what, names in useless.items():
        for name in sorted(names):
            cure = "" if film or name == "frame" else ", or name the output .mp4"
            raise SettingsError(f"--{name} does nothing for {what}: leave it out{cure}")


def _refuse_pairs(*groups: dict[str, object]) -> None:
    """Refuse options that say the same thing in different words."""
    for group in groups:
        given = [f"--{name}" for name, value in group.items() if value is not None]
        if len(given) > 1:
            raise SettingsError(f"{' and '.join(given[:2])} contradict each other: leave one of them out")


def _only_frame(result: StoredResult) -> int | None:
    return result.done[0] if len(result.done) == 1 else None


def _render_still(
    source: str,
    out: Path,
    options: PictureOptions,
    number: int | None,
    compare: Path | None,
    buffers: tuple[Buffer, ...],
) -> None:
    from pipeline.output.render import buffer_path, render_frame, render_mesh

    is_store = _store(source) is not None
    if is_store and number is None:
        raise SettingsError(f"{source} holds many frames: choose one with --frame, or name the output .mp4 for a film")
    with steps() as step:
        step("reading")
        mesh = None if is_store else read_mesh(source, number)
        compared = None if compare is None else read_mesh(compare)
        step("drawing")
        if mesh is not None:
            renderer = render_mesh(mesh, out, options, buffers=buffers, compared=compared)
        else:
            renderer = render_frame(source, number or 0, out, options, buffers=buffers, compared=compared)
    written = [str(out), *(str(buffer_path(out, buffer)) for buffer in buffers)]
    say(f"wrote {' '.join(written)}: drawn by {renderer}")


def _render_film(
    source: str, out: Path, options: PictureOptions, number: int | None, compare: Path | None, *, is_store: bool
) -> None:
    from pipeline.output.film import render_film

    subject = source if is_store else read_mesh(source, number)
    compared = None if compare is None else read_mesh(compare)
    with counted("pictures") as show:
        film = render_film(subject, out, options, frame=number if is_store else None, compared=compared, tell=show)
    absent = [held for held in film.held if held not in film.broken]
    if absent:
        remark(f"{frames(len(absent))} missing or empty, as frame {absent[0]}: the one before is shown in its place")
    for why in list(film.broken.values())[:1]:
        remark(f"{frames(len(film.broken))} damaged, and the one before is shown in its place: {why}")
    before = f", {film.before} of them before" if film.before else ""
    say(f"wrote {out}: {film.n_images} pictures{before}, by {film.codec}, drawn by {film.renderer}")
    if film.held:
        sys.exit(SOME_ARE_BAD)
