"""`colorphase calibrate ...`: radiometry, geometry, and whether they still hold."""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from cyclopts import App, Parameter
from rich.table import Table

from pipeline.calibration.board import Board
from pipeline.calibration.captures import CapturedFolder, PictureSequence, refuse_other_camera, write_sequence
from pipeline.calibration.color_chart import chart_codes, chart_sequence, measure_wavelengths, read_spectra
from pipeline.calibration.model import DEFAULT_PROJECTOR_PX, Calibration, Uncertainty, choose_pattern
from pipeline.calibration.multishot import multishot_codes, multishot_sequence
from pipeline.calibration.pose_folders import measure_poses
from pipeline.calibration.radiometry import (
    PRIMARIES,
    Radiometry,
    measure_radiometry,
    radiometry_codes,
    radiometry_sequence,
)
from pipeline.calibration.radiometry_plot import plot_radiometry
from pipeline.calibration.rig_geometry import GeometryFit, solve_geometry
from pipeline.cli.console import Arch, above_zero, check_target, read_calibration, read_settings, say, size_of, stdout
from pipeline.errors import SettingsError
from pipeline.models import CameraState, FloatArray, build

if TYPE_CHECKING:
    from pipeline.diagnosis.check_result import CheckResult
    from pipeline.diagnosis.ripple_finding import RippleFinding

calibrate = App(name="calibrate", help="Measure the rig: its light, its geometry, and later whether both still hold.")


@Parameter(name="*")
@dataclass(frozen=True)
class BoardOptions:
    """The options that describe a board."""

    squares: str = "11x8"
    """The board's squares, columns and rows."""
    square_mm: Annotated[float, Parameter(validator=above_zero)] = 20.0
    """The side of a square."""
    marker_mm: Annotated[float | None, Parameter(validator=above_zero)] = None
    """The side of a ChArUco marker; left out, three quarters of a square."""
    dictionary: str = "DICT_5X5_250"
    """The markers' dictionary, as OpenCV names it."""

    def board(self, kind: str) -> Board:
        """Return the board.

        Raises
        ------
        SettingsError
            There is no such board.
        """
        sides = {
            "squares": size_of(self.squares, "--squares"),
            "square_mm": self.square_mm,
            "marker_mm": self.marker_mm,
        }
        return build(Board, {"kind": kind, "dictionary": self.dictionary, **sides}, SettingsError, "board")


_BOARD = BoardOptions()
_SIZE = "{}x{}".format(*DEFAULT_PROJECTOR_PX)


@calibrate.command
def radiometry(
    captures: Path | None = None,
    /,
    *,
    make: Path | None = None,
    out: Path | None = None,
    size: str = _SIZE,
    calibration: Path | None = None,
    transfer: Literal["linear", "srgb", "bt709"] | None = None,
    white_level: Annotated[float | None, Parameter(validator=above_zero)] = None,
    exposure_s: float | None = None,
    gain: float | None = None,
    white_balance: Annotated[tuple[float, float, float] | None, Parameter(consume_multiple=True)] = None,
    force: bool = False,
) -> None:
    """Measure the projector's response, the colour crosstalk and the camera's transfer.

    Example: colorphase calibrate radiometry --make ramps, project and capture each picture on a white target, then
    colorphase calibrate radiometry captures --out calibration.json

    Parameters
    ----------
    captures
        Folder with the captures, under the names that the pictures have.
    make
        Write the pictures to project into this new folder instead.
    out
        The calibration to write; a plot of the responses goes beside it.
    size
        The projector's width and height in px.
    calibration
        An earlier calibration, whose geometry is kept.
    transfer
        How the camera encodes light; left out, it is measured.
    white_level
        Full scale of the captures; left out, their type's.
    exposure_s
        Exposure, s, to be compared when frames are decoded.
    gain
        The camera's gain, likewise.
    white_balance
        The camera's gains of red, green and blue, likewise.
    force
        Replace an existing calibration.
    """
    if make is not None and captures is None and out is None:
        _write_fields(make, radiometry_sequence(size_of(size)), radiometry_codes, "a white target")
        return
    folder, target = _both(captures, out)
    check_target(target, force=force)
    known = read_calibration(calibration)
    values = {"exposure_s": exposure_s, "gain": gain, "white_balance": white_balance}
    camera = build(CameraState, values, SettingsError, "capture")
    ramps = CapturedFolder(folder, radiometry_sequence(size_of(size)).names)
    if known is not None:
        height, width = next(iter(ramps.values())).shape[:2]
        refuse_other_camera(known, (width, height), str(folder))
    found = measure_radiometry(ramps, transfer, white_level)
    found.add_to(known, camera).write(target, force=force)
    plot = target.with_name(f"{target.stem}-radiometry.png")
    plot_radiometry(found, plot)
    _show_crosstalk(found)
    name = found.transfer if isinstance(found.transfer, str) else "a curve of its own, measured"
    say(f"the camera's transfer: {name}; grey is red + green + blue to {found.additivity:.2%} of white")
    say(f"wrote {target} and {plot}")


@calibrate.command
def wavelengths(
    captures: Path | None = None,
    /,
    *,
    make: Path | None = None,
    out: Path | None = None,
    size: str = _SIZE,
    calibration: Path | None = None,
    spectra: Path | None = None,
    corners: Annotated[
        tuple[float, float, float, float, float, float, float, float] | None, Parameter(consume_multiple=True)
    ] = None,
    nm: Annotated[
        tuple[float, float, float, float, float, float, float, float, float] | None, Parameter(consume_multiple=True)
    ] = None,
    white_level: Annotated[float | None, Parameter(validator=above_zero)] = None,
    force: bool = False,
) -> None:
    """Measure at which wavelengths the camera's channels see the projector's primaries, from a colour chart.

    It lessens the steps between surfaces of different colours. Example: colorphase calibrate wavelengths --make fields,
    project and capture each of the four pictures on a chart of 24 patches, then colorphase calibrate wavelengths
    captures --spectra chart.csv --corners 120 90 510 95 505 350 118 345 --calibration calibration.json --out new.json

    Parameters
    ----------
    captures
        Folder with the captures, in linear light, under the names that the pictures have.
    make
        Write the pictures to project into this new folder instead.
    out
        The calibration to write.
    size
        The projector's width and height in px.
    calibration
        The calibration that they are added to; it holds the crosstalk.
    spectra
        CSV table of the patches' reflectances: a row a wavelength, nm and then 24 patches in reading order, 0..1.
    corners
        x and y, px, of the middles of the first row's first and last patch, and of the last row's last and first.
    nm
        The nine wavelengths from data sheets instead: of the red channel under red, green and blue light, then of the
        green one, then of the blue one.
    white_level
        Full scale of the captures; left out, their type's.
    force
        Replace an existing calibration.
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
            raise SettingsError("--nm gives the wavelengths: leave the captures away")
        values = {**known.model_dump(), "wavelengths_nm": np.reshape(nm, (3, 3))}
        build(Calibration, values, SettingsError, "calibration").write(out, force=force)
        say(f"wrote {out}")
        return
    if captures is None or spectra is None or corners is None:
        raise SettingsError("give a folder of captures, --spectra and --corners, or the nine wavelengths with --nm")
    fields = CapturedFolder(captures, chart_sequence(size_of(size)).names)
    found = measure_wavelengths(fields, np.reshape(corners, (4, 2)), read_spectra(spectra), white_level)
    found.add_to(known).write(out, force=force)
    table = Table(title="wavelengths at which each camera channel sees the projector's light, nm", show_header=True)
    for heading in ("", *PRIMARIES):
        table.add_column(heading)
    for channel, own, sigma in zip(PRIMARIES, found.wavelengths_nm, found.sigma_nm, strict=True):
        table.add_row(channel, *(f"{value:.0f} ± {deviation:.0f}" for value, deviation in zip(own, sigma, strict=True)))
    stdout.print(table)
    say(f"patches are off their spectra by {found.misfit:.1%}; wrote {out}")


@calibrate.command
def geometry(
    captures: Path | None = None,
    /,
    *,
    make: Path | None = None,
    out: Path | None = None,
    size: str = _SIZE,
    board: Literal["charuco", "chessboard"] = "charuco",
    options: BoardOptions = _BOARD,
    period: float | None = None,
    stripes: Literal["horizontal", "vertical"] | None = None,
    code: Literal["contrast", "none"] | None = None,
    baseline_mm: float | None = None,
    white_level: Annotated[float | None, Parameter(validator=above_zero)] = None,
    calibration: Path | None = None,
    force: bool = False,
) -> None:
    """Measure both lenses and where camera and projector stand, from a board in eight poses or more.

    Example: colorphase calibrate geometry --make fringes, project and capture all of them in each pose of the board, a
    folder a pose, then colorphase calibrate geometry poses --board chessboard --squares 10x7 --square-mm 24 --out
    calibration.json

    Parameters
    ----------
    captures
        Folder with a folder a pose, each with the captures under the names that the pictures have.
    make
        Write the pictures to project into this new folder instead.
    out
        The calibration to write.
    size
        The projector's width and height in px.
    board
        What the board is.
    period
        Period of the pattern that frames will be taken with, projector px; left out, the earlier calibration's, else
        17.4545.
    stripes
        Its direction; left out, the earlier calibration's, else horizontal.
    code
        Its code, as colorphase pattern was told; left out, the earlier calibration's, else contrast.
    baseline_mm
        The distance between camera and projector where it is known; a wrong square size shows in it.
    white_level
        Full scale of the captures; left out, their type's.
    calibration
        An earlier calibration, whose light is kept.
    force
        Replace an existing calibration.
    """
    size_px = size_of(size)
    if make is not None and captures is None and out is None:
        sequence = multishot_sequence(size_px)
        write_sequence(make, sequence, lambda name: multishot_codes(name, size_px))
        say(f"{len(sequence.names)} pictures in {make}: project and capture all of them in each pose, a folder a pose")
        return
    folder, target = _both(captures, out)
    check_target(target, force=force)
    known = read_calibration(calibration)
    described = options.board(board)
    pattern = choose_pattern(known, period, stripes, code)
    measured = measure_poses(folder, described, size_px, white_level)
    found = solve_geometry(measured.poses, measured.camera_size_px, size_px, pattern, known, baseline_mm)
    found.calibration.write(target, force=force)
    _show_geometry(found)
    for line in (*measured.refused, *(f"{name} left out: {reason}" for name, reason in found.left_out)):
        say(f"note: {line}")
    if baseline_mm is None and found.calibration.translation_mm is not None:
        say(f"note: {_scale_note(found.calibration.translation_mm)}")
    if found.calibration.color_shift_px is not None and found.calibration.crosstalk_matrix is None:
        say("note: crosstalk dampens the projector's lateral colour: measure radiometry first, and give --calibration")
    say(f"wrote {target}")


def _scale_note(translation_mm: FloatArray) -> str:
    """Return what is to be known of a scale that the board's squares alone tell."""
    baseline_mm = float(np.linalg.norm(translation_mm))
    return (
        f"only --square-mm tells the scale: camera and projector stand {baseline_mm:.0f} mm apart by it; measure that, "
        "and give it as --baseline-mm"
    )


@calibrate.command
def check(
    capture: Path,
    /,
    *,
    calibration: Path,
    shape: Literal["plane", "ball"] | None = None,
    radius_mm: Annotated[float | None, Parameter(validator=above_zero)] = None,
    settings: Path | None = None,
    fix: Path | None = None,
    arch: Arch = "auto",
    force: bool = False,
) -> None:
    """Ask whether a calibration still holds, and why a surface is wavy.

    Example: colorphase calibrate check ball.png --calibration calibration.json --shape ball --radius-mm 40

    Parameters
    ----------
    capture
        A picture of a smooth surface under the pattern; a folder of frames, one after another, for beat and motion; or
        a folder with the captures that geometry is measured from, of anything, for the epipolar error.
    calibration
        The calibration in doubt.
    shape
        What was captured, to be compared with a perfect one.
    radius_mm
        The ball's true radius.
    settings
        TOML file of decoding settings.
    fix
        Write a calibration with what the picture tells of the light corrected.
    arch
        Where to compute.
    force
        Replace an existing calibration.
    """
    from pipeline.diagnosis.rig_check import check_captures, check_picture, check_sequence, holds_captures

    if radius_mm is not None and shape != "ball":
        raise SettingsError("--radius-mm is a ball's: add --shape ball")
    if capture.is_dir() and (shape is not None or fix is not None):
        raise SettingsError(f"{capture} is a folder: --shape and --fix take one picture")
    if fix is not None:
        check_target(fix, force=force)
    known = Calibration.read(calibration)
    chosen = read_settings(settings)
    if holds_captures(capture):
        _show_check(check_captures(capture, known, chosen))
        return
    if capture.is_dir():
        n_frames, changes = check_sequence(capture, known, chosen, arch)
        _say_findings(changes.findings, f"{n_frames} frames: " + ("nothing found" if changes.notes else "fine"))
        for note in changes.notes:
            say(f"note: {note}")
        return
    found = check_picture(capture, known, chosen, arch, shape, radius_mm)
    if found is None:  # the warning has said why
        sys.exit(1)
    if found.surface is not None:
        _show_check(found.surface)
    ripple = found.diagnosis
    _say_findings(ripple.findings, ripple.notes[0] if np.isnan(ripple.limit_rad) else "fine")
    if ripple.findings:
        worst = max(ripple.seen_rad, key=lambda harmonic: ripple.seen_rad[harmonic])
        say(f"of it, decoding with this calibration leaves {ripple.seen_rad[worst]:.3f} rad, in harmonic {worst}")
    if fix is not None:
        found.corrected().write(fix, force=force)
        say(f"wrote {fix}: it fits this pattern; measure the radiometry before you make a new one")


def _write_fields(folder: Path, sequence: PictureSequence, codes: Callable[[str], FloatArray], target: str) -> None:
    """Write full fields to project, given each one's (3,) projector codes, 0..1."""
    width, height = sequence.size_px
    write_sequence(folder, sequence, lambda name: np.broadcast_to(codes(name), (height, width, 3)))
    say(f"{len(sequence.names)} pictures in {folder}: project each on {target}, and capture it under the same name")


def _show_crosstalk(found: Radiometry) -> None:
    table = Table(title="crosstalk: what each camera channel sees of the projector's", show_header=True)
    for heading in ("", "red", "green", "blue"):
        table.add_column(heading)
    for i, channel in enumerate(("red", "green", "blue")):
        cells = zip(found.crosstalk_matrix[i], found.crosstalk_sigma[i], strict=True)
        table.add_row(channel, *(f"{value:.5f} ± {sigma:.5f}" for value, sigma in cells))
    stdout.print(table)


def _say_findings(findings: "tuple[RippleFinding, ...]", otherwise: str) -> None:
    if not findings:
        say(f"ripple: {otherwise}")
    for finding in findings:
        worst = max(finding.ripple_rad, key=lambda harmonic: finding.ripple_rad[harmonic])
        ripple = f"; {finding.ripple_rad[worst]:.3f} rad in harmonic {worst}" if finding.ripple_rad[worst] > 0 else ""
        say(
            f"ripple: {' or '.join(finding.causes)} ({finding.size}{ripple}, confidence {finding.confidence:.0%}): "
            f"{finding.advice}"
        )


def _show_check(found: "CheckResult") -> None:
    table = Table("figure", "measured", "predicted", "")
    for measure in found.measures:
        verdict = "fine" if measure.fine else "re-calibrate"
        table.add_row(
            measure.name, f"{measure.measured:.3f} {measure.unit}", f"{measure.predicted:.3f} {measure.unit}", verdict
        )
    stdout.print(table)
    say("fine" if found.fine else "re-calibrate")
    if found.fine and found.blind_spot:
        say(f"note: {found.blind_spot}")


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


def _both(captures: Path | None, out: Path | None) -> tuple[Path, Path]:
    if captures is None or out is None:
        raise SettingsError("give either --make and a folder, or a folder of captures and --out")
    return captures, out
