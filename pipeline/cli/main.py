"""The command line: parses, calls, shows progress."""

import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from json import dumps
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import App, Parameter
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from hardware.camera import list_cameras
from hardware.display import list_displays
from hardware.errors import BurstError, CameraError, ProjectorError, RigError, TriggerError
from hardware.link import list_serial_ports
from pipeline.calibration import Calibration
from pipeline.cli.calibrate import BoardOptions, calibrate, chosen_pattern, size_of
from pipeline.cli.capture import capture
from pipeline.cli.decode import FootageOptions, decode_video, write_meshes
from pipeline.cli.project import project, projector
from pipeline.decoder import Decoder
from pipeline.errors import (
    CalibrationError,
    ClusterError,
    DecodeWarning,
    FootageError,
    OutputError,
    RenderError,
    SettingsError,
)
from pipeline.footage.image_folder import IMAGE_SUFFIXES
from pipeline.footage.opening import open_source
from pipeline.footage.source import BadFrame, StoredAs
from pipeline.output.stored_result import MeshKind
from pipeline.settings import DecodeSettings
from tikernels import runtime
from tikernels.errors import DeviceNotReady, ShapeError
from tikernels.raw.development import develop

Arch = Literal["auto", "cpu", "vulkan", "cuda", "metal"]

#: Every error that a user can cause; each message is one line.
_USER_ERRORS = (
    BurstError,
    CalibrationError,
    CameraError,
    ClusterError,
    DeviceNotReady,
    FootageError,
    OutputError,
    ProjectorError,
    RenderError,
    RigError,
    SettingsError,
    ShapeError,
    TriggerError,
)

_BOARD = BoardOptions()
_FOOTAGE = FootageOptions()
_AS_IT_SAYS = StoredAs()

# Names of files may look like markup.
_out = Console(markup=False, emoji=False)
_err = Console(stderr=True, markup=False, emoji=False)

app = App(
    name="colorphase",
    help="Measure shape from ONE colour photograph of three phase-shifted sinusoids.",
    version=lambda: version("colorphase"),
    version_flags=["--version"],
    suppress_keyboard_interrupt=False,  # `main` says what it has stopped
    error_formatter=lambda error: Text(f"error: {' '.join(str(error).split())}", style="red"),
)


@app.command
def demo(*, out: Path = Path("colorphase-demo"), arch: Arch = "auto", force: bool = False) -> None:
    """Simulate one colour frame of a bust, decode it, and measure the result against the truth.

    Example: colorphase demo --out demo

    Parameters
    ----------
    out
        Folder for the frame, the mesh, the pictures and the report.
    arch
        Where to compute.
    force
        Write into a folder that holds other things.
    """
    from pipeline.cli.demo import run_demo

    with _progress() as step:
        summary = run_demo(out, arch, force=force, step=step)
    table = Table(title="measured from one frame, against the truth", show_header=False)
    for name, value in summary.measured.items():
        table.add_row(name, value)
    _out.print(table)
    for note in summary.notes:
        _err.print(f"note: {note}", style="yellow", highlight=False, soft_wrap=True)
    _out.print(f"look at {summary.picture}", highlight=False, soft_wrap=True)


app.command(calibrate)
app.command(capture)
app.command(project)
app.command(projector)


@app.command
def pattern(
    file: Path,
    /,
    *,
    size: str | None = None,
    period: float | None = None,
    stripes: Literal["horizontal", "vertical"] | None = None,
    code: Literal["contrast"] | None = None,
    calibration: Path | None = None,
    brightness: float = 1.0,
    board: Literal["charuco", "chessboard"] | None = None,
    options: BoardOptions = _BOARD,
) -> None:
    """Write the picture that the projector shows, and its description beside it as JSON; or a board to be printed.

    Example: colorphase pattern pattern.png --size 1024x768 --period 17.4545 --stripes horizontal, or
    colorphase pattern board.pdf --board charuco --squares 11x8 --square-mm 20

    Parameters
    ----------
    file
        The PNG to write; a board may be a PDF or SVG.
    size
        The projector's width and height in px; left out, the calibration's, else 1024x768.
    period
        Projector px a cycle; left out, the calibration's, else 17.4545.
    stripes
        Which way they run; left out, the calibration's, else horizontal.
    code
        "contrast": the modulation of each cycle tells which one it is, so that one frame gives absolute depth.
    calibration
        The rig's calibration.json; the projector's response is then undone in the pattern.
    brightness
        Show the same with so much of the light, above 0 to 1; without a calibration as if light were linear in the
        codes. A rig that shows two pictures in turn tells them apart by it.
    board
        Write this kind of calibration board instead, in its true size, as PDF, SVG or PNG.
    """
    if board is not None:
        options.board(board).write(file)
        return
    from pipeline.pattern.fringes import write_pattern

    rig = None if calibration is None else Calibration.read(calibration)
    if rig is not None and rig.response is None:
        raise CalibrationError(f"{calibration} holds no response: run colorphase calibrate radiometry")
    size_px = rig.projector.size_px if rig is not None and rig.projector is not None else (1024, 768)
    chosen = chosen_pattern(rig, period, stripes, code)
    response = None if rig is None else rig.response
    write_pattern(file, size_px if size is None else size_of(size), chosen, response, brightness)


@app.command
def decode(
    input: Path,
    /,
    *,
    out: str,
    settings: Path | None = None,
    calibration: Path | None = None,
    arch: Arch = "auto",
    force: bool = False,
    video: FootageOptions = _FOOTAGE,
    stored_as: Annotated[StoredAs, Parameter(name="*")] = _AS_IT_SAYS,
) -> None:
    """Decode a picture, or footage: a folder of pictures, a video or a recording.

    A picture gives result.zarr, mesh.ply, range.png, shaded.png and report.json, footage result.zarr. Run again, it
    goes on where it was stopped. Exit code 3: some frames are bad, the rest is done.

    Example: colorphase decode face.png --out face --settings settings.toml --calibration calibration.json, or
    colorphase decode film.mkv --out film --fields mask points phase_sigma --export ply

    Parameters
    ----------
    input
        The picture or footage.
    out
        Folder for the results; footage's may be an fsspec URL, as s3://bucket/film.
    settings
        TOML file of settings; what is left out is the default.
    calibration
        The rig's calibration.json; with it results are in mm.
    arch
        Where to compute.
    force
        Write into a folder that holds other things.
    """
    chosen = DecodeSettings() if settings is None else DecodeSettings.read(settings)
    rig = None if calibration is None else Calibration.read(calibration)
    if input.suffix.lower() not in IMAGE_SUFFIXES or input.is_dir():
        decode_video(input, out, chosen, rig, arch, video, stored_as, force=force)
        return
    if video != _FOOTAGE:
        raise SettingsError(
            f"{input.name} is a picture, and these options are for footage: leave them away, or give its folder"
        )
    from pipeline.output.folder import output_folder, write_frame
    from pipeline.output.report import frame_report

    with _progress() as step, output_folder(out, force=force) as folder:
        step("reading")
        (stored,) = open_source(input, **vars(stored_as)).frames()
        if isinstance(stored, BadFrame):
            raise FootageError(stored.reason)
        step("decoding")
        decoder = Decoder(chosen, rig, arch=arch)
        frame = decoder.decode(develop(stored.planes, stored.format, stripes=chosen.stripes))
        step("writing")
        write_frame(folder, frame, chosen, rig, frame_report(frame, chosen, rig, input.name))
    _out.print(f"{frame.mask.mean():.1%} of the pixels measured; wrote {out}", highlight=False, soft_wrap=True)
    if not frame.mask.any():  # the warning has said why
        sys.exit(1)


@app.command
def inspect(
    input: Path,
    /,
    *,
    settings: Path | None = None,
    json: bool = False,
    arch: Arch = "auto",
    stored_as: Annotated[StoredAs, Parameter(name="*")] = _AS_IT_SAYS,
) -> None:
    """Say what footage will cost in accuracy, and what to change. Exit code 3: do not use it as it is.

    Looks at some twenty frames, however long the footage is. Costs are radians RMS of a pixel's phase.

    Example: colorphase inspect film.mp4, or colorphase inspect film.mp4 --siting centre --json

    Parameters
    ----------
    input
        A picture, a folder of pictures, a video or a recording.
    settings
        TOML file of the settings that it is to be decoded with.
    json
        Print JSON instead of a table.
    arch
        Where to compute.
    """
    from pipeline.diagnosis.footage_inspection import NOT_AS_IT_IS, inspect_footage

    chosen = DecodeSettings() if settings is None else DecodeSettings.read(settings)
    with _progress() as step:
        found = inspect_footage(input, stored_as, chosen, arch, step)
    if json:
        print(dumps(found.as_json(), indent=1))
    else:
        table = Table("what", "found", "costs, rad", "what to change", title=str(input))
        styles = {"fine": "", "costs": "yellow", "spoils": "red"}
        for finding in found.findings:
            cost = "" if finding.cost_rad is None else f"{finding.cost_rad:.3f}"
            table.add_row(finding.topic, finding.found, cost, finding.advice, style=styles[finding.grade])
        _out.print(table)
        for sentence in found.not_told:
            _out.print(f"not told: {sentence}", highlight=False, soft_wrap=True)
        verdict = {"fine": "fine", "costs": "fine to use, could be better", "spoils": "do not use it as it is"}
        worst = "" if found.grade == "fine" else f" ({', '.join(found.topics(found.grade))})"
        _out.print(verdict[found.grade] + worst, highlight=False, soft_wrap=True)
    if found.grade == "spoils":
        sys.exit(NOT_AS_IT_IS)


@app.command
def render(
    input: str,
    /,
    *,
    out: Path,
    view: Literal["three-quarter", "front"] = "three-quarter",
    size: Annotated[tuple[int, int], Parameter(consume_multiple=True)] = (1280, 960),
    turn: Annotated[float, Parameter(validator=lambda _, value: _within(-3600, value, 3600))] = 0.0,
    sway: Annotated[float, Parameter(validator=lambda _, value: _within(0, value, 180))] = 0.0,
    colors: Literal["depth", "shaded", "modulation", "sigma"] = "depth",
    fps: Annotated[float, Parameter(validator=lambda _, value: _within(0.1, value, 1000))] = 30.0,
    seconds: Annotated[float, Parameter(validator=lambda _, value: _within(0.1, value, 3600))] = 4.0,
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
        A film's eye goes round the surface by so many degrees.
    sway
        It swings by so many degrees to either side, once.
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
        with _progress() as step:
            step("reading")
            mesh = read_mesh(input)
            step("drawing")
            render_mesh(mesh, out, view=view, size_px=size)
        return
    options = FilmOptions(view, turn, sway, colors, fps, seconds, size)
    with _progress() as step:
        film = render_film(input, out, options, tell=lambda done, of: step(f"picture {done} of {of}"))
    for held in film.held[:1]:
        text = f"{len(film.held)} frames hold no surface, as frame {held}: the one before is shown in their place"
        _err.print(text, style="yellow", highlight=False, soft_wrap=True)
    _out.print(f"wrote {out}: {film.n_images} pictures, by {film.codec}", highlight=False, soft_wrap=True)


@app.command
def export(input: str, /, *, out: Path, kind: MeshKind = "ply") -> None:
    """Write every frame of a result.zarr as a mesh.

    Example: colorphase export film/result.zarr --out meshes --kind glb

    Parameters
    ----------
    input
        The result.zarr: a folder, or an fsspec URL.
    out
        The folder for frame_000000.ply and so on.
    kind
        The format; PLY keeps modulation and standard deviation, too.
    """
    if not write_meshes(input, out, kind):
        sys.exit(1)


@app.command
def devices() -> None:
    """List where kernels can run, the cameras, the serial ports, and the displays that pictures can be shown on.

    Example: colorphase devices
    """
    table = Table("what", "name", "note")
    for arch in runtime.supported_archs():
        software = arch == "vulkan" and all(device.software for device in runtime.vulkan_devices())
        names = ", ".join(device.name for device in runtime.vulkan_devices()) if arch == "vulkan" else ""
        table.add_row("arch", arch, f"{names} (software: for checking, slow)" if software else names)
    table.add_row("kernel language", runtime.kernel_language(), "")
    for camera in list_cameras():
        note = f"driver {camera.driver}" + (f": {camera.note}" if camera.note else "")
        table.add_row("camera", str(camera.identity or ""), note)
    for port in list_serial_ports():
        table.add_row("serial port", port.device, port.description)
    for display in list_displays():
        table.add_row("display", str(display.number), "{}x{}".format(*display.size_px))
    _out.print(table)


def _within(least: float, value: float, most: float) -> None:
    if not least <= value <= most:  # nor NaN
        raise ValueError(f"must be {least:g} to {most:g}")


@contextmanager
def _progress() -> Iterator[Callable[[str], None]]:
    """Show what is being done and for how long, on a terminal."""
    with Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        TimeElapsedColumn(),
        console=_err,
        transient=True,
        disable=not _err.is_terminal,
    ) as progress:
        task = progress.add_task("starting")
        yield lambda what: progress.update(task, description=what)


def _show_warning(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
    prefix = "warning" if issubclass(category, DecodeWarning) else category.__name__
    _err.print(f"{prefix}: {message}", style="yellow", highlight=False, soft_wrap=True)


def main() -> None:
    """Run the command line; a user's mistake is one line on standard error and exit code 1."""
    warnings.showwarning = _show_warning
    try:
        app()
    except _USER_ERRORS as error:
        _err.print(f"error: {error}", style="red", highlight=False, soft_wrap=True)
        sys.exit(1)
    except KeyboardInterrupt as stopped:
        _err.print(str(stopped) or "interrupted", style="red", highlight=False, soft_wrap=True)
        sys.exit(130)
