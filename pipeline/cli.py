"""The command line: parses, calls, shows progress."""

import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import App, Parameter
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from hardware.link import list_serial_ports
from pipeline.calibration import Calibration
from pipeline.calibration.commands import BoardOptions, calibrate, chosen_pattern, size_of
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
from pipeline.settings import DecodeSettings
from pipeline.video.commands import FootageOptions, decode_video
from pipeline.video.pictures import PICTURE_SUFFIXES
from tikernels import runtime
from tikernels.errors import DeviceNotReady, ShapeError

Arch = Literal["auto", "cpu", "vulkan", "cuda", "metal"]

#: Every error that a user can cause; each message is one line.
_USER_ERRORS = (
    CalibrationError,
    ClusterError,
    DeviceNotReady,
    FootageError,
    OutputError,
    RenderError,
    SettingsError,
    ShapeError,
)

_BOARD = BoardOptions()
_FOOTAGE = FootageOptions()

_out = Console()
_err = Console(stderr=True)

app = App(
    name="colorphase",
    help="Measure shape from ONE colour photograph of three phase-shifted sinusoids.",
    version_flags=["--version"],
    suppress_keyboard_interrupt=False,  # `main` says what it has stopped
    error_formatter=lambda error: f"[red]error: {' '.join(str(error).split())}[/red]",
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
    from pipeline.demo import run_demo

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
    board
        Write this kind of calibration board instead, in its true size, as PDF, SVG or PNG.
    """
    if board is not None:
        options.board(board).write(file)
        return
    from pipeline.pattern import write_pattern

    rig = None if calibration is None else Calibration.read(calibration)
    if rig is not None and rig.response is None:
        raise CalibrationError(f"{calibration} holds no response: run colorphase calibrate radiometry")
    size_px = rig.projector.size_px if rig is not None and rig.projector is not None else (1024, 768)
    chosen = chosen_pattern(rig, period, stripes, code)
    write_pattern(file, size_px if size is None else size_of(size), chosen, None if rig is None else rig.response)


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
) -> None:
    """Decode a picture, or footage: a folder of pictures, a video or a recording.

    A picture gives result.zarr, mesh.ply, range.png, shaded.png and report.json, footage result.zarr. Run again, it
    goes on where it was stopped. Exit code 3: some frames are bad, the rest is done.

    Example: colorphase decode face.png --out face --settings settings.toml --calibration calibration.json, or
    colorphase decode film.mkv --out film --fields range_image phase_sigma mask --workers 4

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
    if input.suffix.lower() not in PICTURE_SUFFIXES or input.is_dir():
        decode_video(input, out, chosen, rig, arch, video, force=force)
        return
    from pipeline.outputs import output_folder, write_frame
    from pipeline.picture import read_picture
    from pipeline.report import frame_report

    with _progress() as step, output_folder(out, force=force) as folder:
        step("reading")
        image = read_picture(input)
        step("decoding")
        frame = Decoder(chosen, rig, arch=arch).decode(image)
        step("writing")
        write_frame(folder, frame, chosen, rig, frame_report(frame, chosen, rig, input.name))
    _out.print(f"{frame.mask.mean():.1%} of the pixels measured; wrote {out}", highlight=False, soft_wrap=True)
    if not frame.mask.any():  # the warning has said why
        sys.exit(1)


@app.command
def render(
    input: Path,
    /,
    *,
    out: Path,
    view: Literal["three-quarter", "front"] = "three-quarter",
    size: Annotated[tuple[int, int], Parameter(consume_multiple=True)] = (1280, 960),
) -> None:
    """Draw a mesh off screen.

    Example: colorphase render face/mesh.ply --out face.png --view front

    Parameters
    ----------
    input
        The mesh: a PLY file.
    out
        The PNG to write.
    view
        From where.
    size
        Width and height of the picture in px.
    """
    from pipeline.export import read_mesh
    from pipeline.render import render_mesh

    if out.suffix.lower() != ".png":
        raise OutputError(f"{out} is not a PNG file: name it .png")
    with _progress() as step:
        step("reading")
        mesh = read_mesh(input)
        step("drawing")
        render_mesh(mesh, out, view=view, size_px=size)


@app.command
def devices() -> None:
    """List where kernels can run, and the serial ports.

    Example: colorphase devices
    """
    table = Table("what", "name", "note")
    for arch in runtime.supported_archs():
        software = arch == "vulkan" and all(device.software for device in runtime.vulkan_devices())
        names = ", ".join(device.name for device in runtime.vulkan_devices()) if arch == "vulkan" else ""
        table.add_row("arch", arch, f"{names} (software: for checking, slow)" if software else names)
    table.add_row("kernel language", runtime.kernel_language(), "")
    for port in list_serial_ports():
        table.add_row("serial port", port.device, port.description)
    _out.print(table)


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
