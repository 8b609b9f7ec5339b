"""`colorphase calibrate ...`: measure the rig's light and geometry, or simulate the captures for it."""

import shlex
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from cyclopts import App, Parameter
from rich.table import Table

from pipeline.calibration.board import Board
from pipeline.calibration.board_poses import measure_poses
from pipeline.calibration.captures import PictureSequence, write_sequence
from pipeline.calibration.color_chart import chart_codes, chart_sequence, measure_wavelengths, read_spectra
from pipeline.calibration.figures import geometry_figure, radiometry_figure, write_figure
from pipeline.calibration.model import DEFAULT_PROJECTOR_PX, Calibration, Uncertainty
from pipeline.calibration.multishot import multishot_codes, multishot_sequence
from pipeline.calibration.picture_matching import find_captures
from pipeline.calibration.radiometry import (
    PRIMARIES,
    Radiometry,
    measure_radiometry,
    radiometry_codes,
    radiometry_sequence,
)
from pipeline.calibration.rig_geometry import GeometryFit, SecondBoard, solve_geometry
from pipeline.calibration.verdict import judge_radiometry
from pipeline.cli.calibrate_check import check
from pipeline.cli.console import (
    Arch,
    Make,
    NewCalibration,
    ProjectorSize,
    Replace,
    WhiteLevel,
    above_zero,
    check_target,
    read_calibration,
    say,
    size_of,
    stdout,
    steps,
)
from pipeline.cli.project import BoardOptions, PatternOptions
from pipeline.errors import SettingsError
from pipeline.models import CameraState, FloatArray, build

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: The projector's size where none is given.
PROJECTOR_SIZE = "{}x{}".format(*DEFAULT_PROJECTOR_PX)
_BOARD, _FRINGES = BoardOptions(), PatternOptions()


def captures_and_target(captures: Path | None, out: Path | None) -> tuple[Path, Path]:
    """Return what is measured, and where the result goes.

    Raises
    ------
    SettingsError
        One of them is missing.
    """
    if captures is None or out is None:
        raise SettingsError("give either --make and a folder, or a folder of captures and --out")
    return captures, out


def radiometry(
    captures: Path | None = None,
    /,
    *,
    make: Make = None,
    out: Path | None = None,
    size: ProjectorSize = PROJECTOR_SIZE,
    calibration: Path | None = None,
    transfer: Literal["linear", "srgb", "bt709"] | None = None,
    white_level: WhiteLevel = None,
    exposure_s: float | None = None,
    gain: float | None = None,
    white_balance: Annotated[tuple[float, float, float] | None, Parameter(consume_multiple=True)] = None,
    force: Replace = False,
) -> None:
    """Measure the projector's response, the colour crosstalk and the camera's transfer.

    Example: colorphase calibrate radiometry --make ramps, project and capture each picture on a white target, then
    colorphase calibrate radiometry captures --out calibration.json

    Parameters
    ----------
    captures
        Folder with the captures, under the names that the pictures have or in the order of projection; or a recording
        or a video of the pictures, each shown for half a second or longer.
    out
        The calibration to write; a picture of light and crosstalk is written next to it.
    calibration
        An earlier calibration, whose geometry is kept.
    transfer
        Encoding of the camera's light; left out, it is measured.
    exposure_s
        Exposure, s, to be compared when frames are decoded.
    gain
        The camera's gain, likewise.
    white_balance
        The camera's gains of red, green and blue, likewise.
    """
    if make is not None and captures is None and out is None:
        _write_fields(make, radiometry_sequence(size_of(size)), radiometry_codes, "a white target")
        return
    folder, target = captures_and_target(captures, out)
    check_target(target, force=force)
    known = read_calibration(calibration)
    values = {"exposure_s": exposure_s, "gain": gain, "white_balance": white_balance}
    camera = build(CameraState, values, SettingsError, "capture")
    ((_, ramps),) = find_captures(folder, radiometry_sequence(size_of(size)))
    if known is not None and known.has_geometry:
        height, width = next(iter(ramps.values())).shape[:2]
        known.geometry().check_frame((width, height), str(folder))
    found = measure_radiometry(ramps, transfer, white_level)
    found.add_to(known, camera).write(target, force=force)
    _show_crosstalk(found)
    verdict = judge_radiometry(found, known.geometry() if known is not None and known.has_geometry else None)
    name = found.transfer if isinstance(found.transfer, str) else "a curve of its own, measured"
    say(f"the camera's transfer: {name}; grey is red + green + blue to {found.additivity:.2%} of white")
    for line in verdict.lines():
        say(line)
    _write_picture(radiometry_figure(found), target, "radiometry")


def wavelengths(
    captures: Path | None = None,
    /,
    *,
    make: Make = None,
    out: NewCalibration = None,
    size: ProjectorSize = PROJECTOR_SIZE,
    calibration: Path | None = None,
    spectra: Path | None = None,
    corners: Annotated[
        tuple[float, float, float, float, float, float, float, float] | None, Parameter(consume_multiple=True)
    ] = None,
    nm: Annotated[
        tuple[float, float, float, float, float, float, float, float, float] | None, Parameter(consume_multiple=True)
    ] = None,
    white_level: WhiteLevel = None,
    force: Replace = False,
) -> None:
    """Measure at which wavelengths the camera's channels see the projector's primaries, from a colour chart.

    It lessens the steps between surfaces of different colours. Example: colorphase calibrate wavelengths --make fields,
    project and capture each of the four pictures on a chart of 24 patches, then colorphase calibrate wavelengths
    captures --spectra chart.csv --corners 120 90 510 95 505 350 118 345 --calibration calibration.json --out new.json

    Parameters
    ----------
    captures
        Folder with the captures, in linear light, under the names that the pictures have or in the order of projection;
        or a recording or a video of the pictures, each shown for half a second or longer.
    calibration
        The calibration that they are added to; it holds the crosstalk.
    spectra
        CSV table of the patches' reflectances: a row a wavelength, nm and then 24 patches in reading order, 0..1.
    corners
        x and y, px, of the middles of the first row's first and last patch, and of the last row's last and first.
    nm
        The nine wavelengths from data sheets instead: of the red channel under red, green and blue light, then of the
        green one, then of the blue one.
    """
    if make is not None and captures is None and out is None:
        _write_fields(make, chart_sequence(size_of(size)), chart_codes, "the chart")
        return
    if out is None or calibration is None:
        raise SettingsError("give --calibration, to which the wavelengths are added, and --out")
    check_target(out, force=force)
    known = Calibration.read(calibration)
    if nm is not None:
        if captures is not None:
            raise SettingsError("--nm gives the wavelengths: omit the captures")
        values = {**known.model_dump(), "wavelengths_nm": np.reshape(nm, (3, 3))}
        build(Calibration, values, SettingsError, "calibration").write(out, force=force)
        say(f"wrote {out}")
        return
    if captures is None or spectra is None or corners is None:
        raise SettingsError("give a folder of captures, --spectra and --corners, or the nine wavelengths with --nm")
    ((_, fields),) = find_captures(captures, chart_sequence(size_of(size)))
    found = measure_wavelengths(fields, np.reshape(corners, (4, 2)), read_spectra(spectra), white_level)
    found.add_to(known).write(out, force=force)
    table = Table(title="wavelengths at which each camera channel sees the projector's light, nm", show_header=True)
    for heading in ("", *PRIMARIES):
        table.add_column(heading)
    for channel, own, sigma in zip(PRIMARIES, found.wavelengths_nm, found.sigma_nm, strict=True):
        table.add_row(channel, *(f"{value:.0f} ± {deviation:.0f}" for value, deviation in zip(own, sigma, strict=True)))
    stdout.print(table)
    say(f"patches are off their spectra by {found.misfit:.1%}; wrote {out}")


def _write_fields(folder: Path, sequence: PictureSequence, codes: Callable[[str], FloatArray], target: str) -> None:
    """Write full fields to project, given each one's (3,) projector codes, 0..1."""
    width, height = sequence.size_px
    write_sequence(folder, sequence, lambda name: np.broadcast_to(codes(name), (height, width, 3)))
    say(f"{len(sequence.names)} pictures in {folder}: project each on {target}, in order, and capture it")


def _show_crosstalk(found: Radiometry) -> None:
    table = Table(title="crosstalk: what each camera channel sees of the projector's", show_header=True)
    for heading in ("", "red", "green", "blue"):
        table.add_column(heading)
    for i, channel in enumerate(("red", "green", "blue")):
        cells = zip(found.crosstalk_matrix[i], found.crosstalk_sigma[i], strict=True)
        table.add_row(channel, *(f"{value:.5f} ± {sigma:.5f}" for value, sigma in cells))
    stdout.print(table)


def geometry(
    captures: Path | None = None,
    /,
    *,
    make: Make = None,
    out: Path | None = None,
    size: ProjectorSize = PROJECTOR_SIZE,
    board: Literal["charuco", "chessboard"] = "charuco",
    options: BoardOptions = _BOARD,
    fringes: PatternOptions = _FRINGES,
    baseline_mm: float | None = None,
    second_board: Path | None = None,
    second_square_mm: Annotated[float | None, Parameter(validator=above_zero)] = None,
    white_level: WhiteLevel = None,
    calibration: Path | None = None,
    force: Replace = False,
) -> None:
    """Measure both lenses and the poses of camera and projector, from a board in eight poses or more.

    Example: colorphase calibrate geometry --make fringes, project and capture all of them in each pose of the board, a
    folder a pose, then colorphase calibrate geometry poses --board chessboard --squares 10x7 --square-mm 24 --out
    calibration.json

    Parameters
    ----------
    captures
        Folder with one folder per pose, each with the captures under the names that the pictures have or in the order
        of projection, or with a recording; or one such folder, recording or video with all poses.
    board
        Kind of the board.
    out
        The calibration to write; a picture of corners, poses and rig is written next to it.
    baseline_mm
        The distance between camera and projector where it is known; a wrong square size shows in it.
    second_board
        One pose or more of the same board printed in another size, likewise; a wrong square size shows in it.
    second_square_mm
        The side of its squares, measured by itself.
    calibration
        An earlier calibration, whose light is kept.
    """
    size_px = size_of(size)
    if make is not None and captures is None and out is None:
        _write_fringes(make, size_px)
        return
    folder, target = captures_and_target(captures, out)
    if (second_board is None) != (second_square_mm is None):
        raise SettingsError("a second board is its poses and its squares: give --second-board and --second-square-mm")
    check_target(target, force=force)
    known = read_calibration(calibration)
    described = options.board(board)
    pattern = fringes.pattern(known)
    measured = measure_poses(folder, described, size_px, white_level)
    refused, second = [*measured.refused], None
    if second_board is not None and second_square_mm is not None:
        other = options.with_square(second_square_mm).board(board)
        seen = measure_poses(second_board, other, size_px, white_level, least=1)
        refused += seen.refused
        second = SecondBoard(seen.poses, second_square_mm, described.square_mm)
    sizes = measured.camera_size_px, size_px
    found = solve_geometry(measured.poses, *sizes, pattern, known, baseline_mm, second, measured.sensor)
    fringes.shown_to(found.calibration).write(target, force=force)
    _show_geometry(found)
    _say_verdict(found, refused)
    _write_picture(geometry_figure(found), target, "geometry")


def _write_picture(figure: "Figure", target: Path, kind: str) -> None:
    """Write the picture of a calibration next to it, and print both names."""
    picture = target.with_name(f"{target.stem}-{kind}.png")
    write_figure(figure, picture)
    say(f"wrote {target} and {picture}")


def _write_fringes(folder: Path, size_px: tuple[int, int]) -> None:
    """Write the pictures to project."""
    sequence = multishot_sequence(size_px)
    write_sequence(folder, sequence, lambda name: multishot_codes(name, size_px))
    say(
        f"{len(sequence.names)} pictures in {folder}: project and capture all of them in each pose, one folder per pose"
    )


def _say_verdict(found: GeometryFit, refused: list[str]) -> None:
    """Print which poses are missing or bad, the quality of the geometry, and what is known of its scale."""
    for line in (*refused, *(f"{name} left out: {reason}" for name, reason in found.left_out)):
        say(f"note: {line}")
    if found.calibration.color_shift_px is not None and found.calibration.crosstalk_matrix is None:
        say("note: crosstalk dampens the projector's lateral colour: measure radiometry first, and give --calibration")
    for line in (*found.verdict.lines(), _scale_in_words(found.calibration)):
        say(line)


def _scale_in_words(calibration: Calibration) -> str:
    """Return what is known of the scale."""
    baseline_mm = float(np.linalg.norm(calibration.geometry().translation_mm))
    if calibration.scale_proof is not None:
        return f"scale proven by the {calibration.scale_proof}; camera and projector stand {baseline_mm:.1f} mm apart"
    return (
        f"scale unproven: only --square-mm determines it, and camera and projector stand {baseline_mm:.0f} mm apart "
        "by it; measure that and give it as --baseline-mm, or show a board of another size (--second-board)"
    )


def _show_geometry(found: GeometryFit) -> None:
    place, deviations = found.calibration.geometry(), found.calibration.uncertainty or Uncertainty()
    table = Table(title=f"geometry from {len(found.poses)} poses", show_header=True)
    for heading in ("", "value", "standard deviation"):
        table.add_column(heading)
    for name, lens, sigma, rms in (
        ("camera", place.camera, deviations.camera, found.camera_rms_px),
        ("projector", place.projector, deviations.projector, found.projector_rms_px),
    ):
        if sigma is not None:
            focal = f"{lens.matrix[0, 0]:.2f}, {lens.matrix[1, 1]:.2f} px"
            table.add_row(f"{name}'s focal lengths", focal, f"{sigma[0]:.2f}, {sigma[1]:.2f} px")
        table.add_row(f"{name}'s corners off by", f"{rms:.3f} px RMS", "")
    baseline = float(np.linalg.norm(place.translation_mm))
    if deviations.translation_mm is not None:
        along = place.translation_mm / baseline
        table.add_row("baseline", f"{baseline:.2f} mm", f"{np.linalg.norm(along * deviations.translation_mm):.2f} mm")
    if deviations.depth_bias_mm is not None:
        table.add_row("depth bias to be expected", "", f"{deviations.depth_bias_mm:.2f} mm")
    stdout.print(table)


def simulate(*, out: Path, arch: Arch = "auto") -> None:
    """Make captures of a simulated rig for every step of a calibration, to practise on, and the truth to judge it by.

    It takes a minute or two, and 33 MB.

    Example: colorphase calibrate simulate --out practice

    Parameters
    ----------
    out
        The folder to make.
    """
    from pipeline.acquisition import practice_set as practice

    with steps() as show:
        truth = practice.write_practice(out, arch, show)
    board, second = practice.BOARD, practice.SECOND_BOARD
    baseline_mm = float(np.linalg.norm(truth.geometry().translation_mm))
    say(
        f"made {out}: the board's squares are {board.square_mm:g} mm, the second board's {second.square_mm:g} mm; "
        f"camera and projector stand {baseline_mm:g} mm apart; the ball's radius is {practice.BALL_RADIUS_MM:g} mm"
    )
    say("next:")
    for line in _next_commands(out, board, second):
        say(f"  {line}")


def _next_commands(out: Path, board: Board, second: Board) -> list[str]:
    """Return the commands that calibrate the simulated rig and try the result."""
    from pipeline.acquisition import practice_set as practice

    folder = shlex.quote(str(out))
    described = "--board {} --squares {}x{} --square-mm {:g}".format(board.kind, *board.squares, board.square_mm)
    proof = f"--second-board {folder}/{practice.SECOND_POSES} --second-square-mm {second.square_mm:g}"
    light = "--calibration light.json"
    ball = f"{folder}/{practice.BALL} --calibration rig.json"
    return [
        f"colorphase calibrate radiometry {folder}/{practice.LIGHT} --out light.json",
        f"colorphase calibrate geometry {folder}/{practice.POSES} {described} {proof} {light} --out rig.json",
        f"colorphase calibrate check {ball} --shape ball --radius-mm {practice.BALL_RADIUS_MM:g}",
        f"colorphase decode {ball} --out ball",
    ]


calibrate = App(name="calibrate", help="Measure the rig: its light, its geometry, and later whether both still hold.")
for command in (simulate, radiometry, wavelengths, geometry, check):
    calibrate.command(command)
calibrate.command(
    "pipeline.cli.calibrate_import:import_calibration", name="import", help="Read other programs' calibrations."
)
calibrate.command("pipeline.cli.calibrate_capture:capture", name="capture", help="Show and take the pictures, guided.")
calibrate.command(
    "pipeline.cli.calibrate_touch_up:touch_up",
    name="touch-up",
    help="Correct a calibration for drift, by a still object.",
)
