"""`colorphase render`: pictures of a result, without a screen."""

import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from pipeline.cli.console import SOME_ARE_BAD, bounded, counted, frames, remark, say, steps
from pipeline.errors import OutputError, SettingsError
from pipeline.files import explain, make_folder
from pipeline.models import build
from pipeline.output.folder import store_in
from pipeline.output.formats.table import AxesName, UnitName
from pipeline.output.mesh import Mesh
from pipeline.output.mesh_files import read_placed
from pipeline.output.pictures.color_meaning import Colors
from pipeline.output.pictures.drawing_process import MOST_SIDE_PX, Buffer, PictureOptions
from pipeline.output.pictures.picture_overlay import Colormap
from pipeline.output.pictures.viewpoint import CameraPath, View, Viewpoint
from pipeline.output.stored_result import StoredResult


@Parameter(name="*")
@dataclass(frozen=True)
class ColorChoice:
    """The meaning and the look of colours."""

    colors: Colors | None = None
    """Meaning of colours; left out, none (clay), so that relief is seen."""
    limits: tuple[float, float] | None = None
    """The values with the first and the last colour, in mm, rad or levels; left out, by what is drawn."""
    colormap: Colormap | None = None
    """Colours of values; left out, turbo, or blue to red where zero is in the middle."""
    transparent: bool = False
    """Leave a still picture transparent where no surface is."""

    def check(self, *, compared: bool, film: bool) -> None:
        """Refuse what would do nothing.

        Raises
        ------
        SettingsError
            Some of it would.
        """
        plain = not compared and self.colors in (None, "clay", "texture")
        for name, value in (("limits", self.limits), ("colormap", self.colormap)):
            if value is not None and plain:
                raise SettingsError(f"--{name} does nothing without values: add --colors depth, or --compare")
        if self.limits is not None and not self.limits[0] < self.limits[1]:
            low, high = self.limits
            raise SettingsError(f"--limits is {low:g} {high:g}: give the lower one first, as 700 900")
        if self.transparent and film:
            raise SettingsError("--transparent does nothing for a film: leave it out, or name the output .png")


@Parameter(name="*")
@dataclass(frozen=True)
class Placement:
    """The axes and units of files that do not state theirs."""

    axes: AxesName | None = None
    """Axes of the input: y-up (x right, z towards the camera), z-up (x right, y away from it), camera (x right, y
    down, z away from it); left out, as the file states."""
    unit: UnitName | None = None
    """Unit of the input; left out, as the file states."""
    compare_axes: AxesName | None = None
    """Axes of the mesh to compare with."""
    compare_unit: UnitName | None = None
    """Unit of the mesh to compare with."""


_CLAY, _AS_IT_SAYS = ColorChoice(), Placement()


def render(
    input: str,
    /,
    *more: str,
    out: Path,
    frame: int | None = None,
    view: View | None = None,
    camera: Annotated[tuple[float, ...] | None, Parameter(consume_multiple=True)] = None,
    camera_path: Path | None = None,
    turn: Annotated[float | None, Parameter(validator=bounded(-3600, 3600))] = None,
    sway: Annotated[float | None, Parameter(validator=bounded(0, 180))] = None,
    look: ColorChoice = _CLAY,
    compare: Path | None = None,
    placed: Placement = _AS_IT_SAYS,
    buffers: Annotated[tuple[Buffer, ...], Parameter(consume_multiple=True)] = (),
    size: Annotated[tuple[int, int], Parameter(consume_multiple=True)] = (1280, 960),
    fps: Annotated[float | None, Parameter(validator=bounded(0.1, 1000))] = None,
    seconds: Annotated[float | None, Parameter(validator=bounded(0.1, 3600))] = None,
) -> None:
    """Draw a surface, or frames of a result.zarr, off screen: a still picture, a turntable, or a film of all frames.

    A film that was stopped is continued by the same command. Exit code 3: some frames are missing, empty or damaged,
    the rest is drawn.

    Example: colorphase render face/mesh.ply --out face.png --view front --colors depth, or
    colorphase render face/mesh.ply --out turntable.mp4 --turn 360, or
    colorphase render film/result.zarr --out film.mp4 --sway 25

    Parameters
    ----------
    input
        A mesh, a PCD file, a depth picture or a bag (.mcap); or a result.zarr, the folder that it is in, or an fsspec
        URL.
    more
        More of them, each to be drawn in the same way.
    out
        The PNG to write; or the MP4. Of several inputs the folder for a PNG of each.
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
        Angle by which a film's eye goes round the surface, degrees.
    sway
        Angle by which it swings to either side, once, degrees.
    compare
        Another mesh, the signed distance from which colours show, in place of --colors.
    buffers
        Files to write in addition to a still: NAME.depth.tiff (float32, mm before the eye), NAME.normals.png.
    size
        Width and height of the picture in px.
    fps
        A film's pictures a second, one a frame; left out, 30.
    seconds
        Length of the film of a single surface; left out, 4.
    """
    asked = {"frame": frame, "fps": fps, "seconds": seconds, "turn": turn, "sway": sway, "camera-path": camera_path}
    given = {name for name, value in asked.items() if value is not None} | ({"buffers"} if buffers else set())
    film = out.suffix.lower() == ".mp4"
    if more and out.suffix.lower() in (".png", ".mp4"):
        raise OutputError(f"{out} is one picture, and there are {1 + len(more)} inputs: name a folder")
    if not more and not film and out.suffix.lower() != ".png":
        raise OutputError(f"{out} is neither a PNG nor an MP4 file: name it .png for a still picture, .mp4 for a film")
    _refuse_pairs(
        {"view": view, "camera": camera, "camera-path": camera_path}, {"colors": look.colors, "compare": compare}
    )
    look.check(compared=compare is not None, film=film)
    if camera_path is not None and given & {"turn", "sway"}:
        raise SettingsError("--camera-path moves the eye already: leave out --turn and --sway")
    chosen: dict[str, Any] = {
        "view": view,
        "camera": None if camera is None else Viewpoint.of_numbers(camera),
        "path": None if camera_path is None else CameraPath.read(camera_path),
        **{"turn_deg": turn, "sway_deg": sway, "fps": fps, "seconds": seconds, "size_px": size, **asdict(look)},
    }
    if not all(16 <= side <= MOST_SIDE_PX for side in size):
        raise SettingsError(f"--size is {size[0]}x{size[1]}: give 16 to {MOST_SIDE_PX} px")
    known = {name: value for name, value in chosen.items() if value is not None}
    options = build(PictureOptions, known, SettingsError, "options")
    compared = None
    if compare is not None:
        compared = _read(compare, None, placed.compare_axes, placed.compare_unit, "--compare-")
    pictures = _pictures_in(out, (input, *more)) if more else {input: out}
    whole = True
    for each, picture in pictures.items():
        store = _store(each)
        result = None if store is None else StoredResult(store)
        _refuse_useless(given, result, frame, film=film, of_bag=Path(each).suffix.lower() == ".mcap")
        number = result.done[0] if frame is None and result is not None and len(result.done) == 1 else frame
        if store is None:
            subject: str | Mesh = _read(each, number, placed.axes, placed.unit, None if compare is None else "--")
        elif placed.axes is not None or placed.unit is not None:
            raise SettingsError("--axes and --unit do nothing for a result: leave them out")
        else:
            subject = store
        if film:
            whole &= _render_film(subject, picture, options, number, compared)
        else:
            _render_still(subject, picture, options, number, compared, buffers)
    if not whole:
        sys.exit(SOME_ARE_BAD)


def _pictures_in(folder: Path, inputs: tuple[str, ...]) -> dict[str, Path]:
    """Return the picture of each input, by its name, or by its folder's and its own where names are not enough."""
    paths = {each: Path(each).absolute() for each in inputs}
    for names in (
        {each: path.stem for each, path in paths.items()},
        {each: f"{path.parent.name}_{path.stem}" for each, path in paths.items()},
    ):
        if len({*names.values()}) == len(inputs):
            try:
                make_folder(folder)
            except OSError as error:
                raise OutputError(f"cannot write {folder}: {explain(error)}") from error
            return {each: folder / f"{name}.png" for each, name in names.items()}
    raise SettingsError("two inputs have the same name: render them one at a time")


def _read(
    path: str | Path, frame: int | None, axes: AxesName | None, unit: UnitName | None, options: str | None
) -> Mesh:
    """Return a mesh; refuse one without a known orientation where options that state it are named, else warn."""
    mesh, known = read_placed(path, frame, axes, unit)
    if not known and options is not None:
        asked = {"axes": "y-up, z-up or camera"} if axes is None else {}
        asked |= {"unit": "mm, cm, m or in"} if unit is None else {}
        give = ", and ".join(f"{options}{name} {allowed}" for name, allowed in asked.items())
        raise SettingsError(f"{path} does not say its {' and '.join(asked)}: give {give}")
    if not known:
        remark(f"{path} does not say its axes and unit, and is shown as if it were ours: see --axes and --unit")
    return mesh


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
    """Refuse options that mean the same in different words."""
    for group in groups:
        given = [f"--{name}" for name, value in group.items() if value is not None]
        if len(given) > 1:
            raise SettingsError(f"{' and '.join(given[:2])} contradict each other: leave one of them out")


def _render_still(
    subject: str | Mesh,
    out: Path,
    options: PictureOptions,
    number: int | None,
    compared: Mesh | None,
    buffers: tuple[Buffer, ...],
) -> None:
    from pipeline.output.render import buffer_path, render_frame, render_mesh

    with steps() as step:
        step("drawing")
        if isinstance(subject, Mesh):
            renderer = render_mesh(subject, out, options, buffers=buffers, compared=compared, remark=remark)
        elif number is None:
            raise SettingsError(
                f"{subject} holds many frames: choose one with --frame, or name the output .mp4 for a film"
            )
        else:
            renderer = render_frame(subject, number, out, options, buffers=buffers, compared=compared, remark=remark)
    written = [str(out), *(str(buffer_path(out, buffer)) for buffer in buffers)]
    say(f"wrote {' '.join(written)}: drawn by {renderer}")


def _render_film(
    subject: str | Mesh, out: Path, options: PictureOptions, number: int | None, compared: Mesh | None
) -> bool:
    """Draw a film, report the result, and return whether every frame is seen."""
    from pipeline.output.film import render_film

    frame = None if isinstance(subject, Mesh) else number
    with counted("pictures") as show:
        film = render_film(subject, out, options, frame=frame, compared=compared, notify=show, remark=remark)
    absent = [held for held in film.held if held not in film.broken]
    if absent:
        remark(f"{frames(len(absent))} missing or empty, as frame {absent[0]}: the one before is shown in its place")
    for why in list(film.broken.values())[:1]:
        remark(f"{frames(len(film.broken))} damaged, and the one before is shown in its place: {why}")
    before = f", {film.before} of them before" if film.before else ""
    say(f"wrote {out}: {film.n_images} pictures{before}, by {film.codec}, drawn by {film.renderer}")
    return not film.held
