"""`colorphase calibrate ...`: parse, call, say what was found."""

import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from cyclopts import App, Parameter
from rich.console import Console
from rich.table import Table

from pipeline.calibration.board import Board
from pipeline.calibration.captures import CapturedFolder, Picture, captured_files, write_sequence
from pipeline.calibration.model import Calibration, Capture, Pattern, Uncertainty
from pipeline.calibration.multishot import WHITE, multishot_codes, multishot_sequence
from pipeline.calibration.radiometry import (
    measure_radiometry,
    plot_radiometry,
    radiometry_codes,
    radiometry_sequence,
)
from pipeline.calibration.rig_geometry import MIN_POSES, GeometryFit, measure_pose, solve_geometry
from pipeline.errors import CalibrationError, OutputError, SettingsError
from pipeline.models import build

if TYPE_CHECKING:
    from pipeline.decoding.frame import DecodedFrame
    from pipeline.diagnosis.ripple import Finding
    from pipeline.diagnosis.surface_check import CheckResult
    from tikernels.raw.linearization import Transfer

# Names of files may look like markup.
_out = Console(markup=False, emoji=False)

calibrate = App(name="calibrate", help="Measure the rig: its light, its geometry, and later whether both still hold.")


def size_of(text: str, option: str = "--size") -> tuple[int, int]:
    """Read a width and height in px, as in 1024x768.

    Raises
    ------
    SettingsError
        It is none.
    """
    width, separator, height = text.lower().partition("x")
    if not (separator and width.isdigit() and height.isdigit() and int(width) > 0 and int(height) > 0):
        raise SettingsError(f"{option} is {text!r}: give width and height in px, as in 1024x768")
    return int(width), int(height)


@Parameter(name="*")
@dataclass(frozen=True)
class BoardOptions:
    """The options that describe a board."""

    squares: str = "11x8"
    """The board's squares, columns and rows."""
    square_mm: float = 20.0
    """The side of a square."""
    marker_mm: float | None = None
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


@calibrate.command
def radiometry(
    captures: Path | None = None,
    /,
    *,
    make: Path | None = None,
    out: Path | None = None,
    size: str = "1024x768",
    calibration: Path | None = None,
    transfer: Literal["linear", "srgb", "bt709"] | None = None,
    white_level: float | None = None,
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
        sequence = radiometry_sequence(size_of(size))
        width, height = sequence.size_px
        write_sequence(make, sequence, lambda name: np.broadcast_to(radiometry_codes(name), (height, width, 3)))
        _say(f"{len(sequence.names)} pictures in {make}: project each, and capture it under the same name")
        return
    folder, target = _both(captures, out)
    _check_target(target, force)
    known = None if calibration is None else Calibration.read(calibration)
    values = {"exposure_s": exposure_s, "gain": gain, "white_balance": white_balance}
    stood = build(Capture, values, SettingsError, "capture")
    ramps = CapturedFolder(folder, radiometry_sequence(size_of(size)).names)
    if known is not None:
        from pipeline.diagnosis.surface_check import refuse_other_camera

        height, width = next(iter(ramps.values())).shape[:2]
        refuse_other_camera(known, (width, height), str(folder))
    found = measure_radiometry(ramps, transfer, white_level)
    found.add_to(known, stood).write(target, force=force)
    plot = target.with_name(f"{target.stem}-radiometry.png")
    plot_radiometry(found, plot)
    table = Table(title="crosstalk: what each camera channel sees of the projector's", show_header=True)
    for heading in ("", "red", "green", "blue"):
        table.add_column(heading)
    for i, channel in enumerate(("red", "green", "blue")):
        cells = zip(found.crosstalk_matrix[i], found.crosstalk_sigma[i], strict=True)
        table.add_row(channel, *(f"{value:.5f} ± {sigma:.5f}" for value, sigma in cells))
    _out.print(table)
    name = found.transfer if isinstance(found.transfer, str) else "a curve of its own, measured"
    _say(f"the camera's transfer: {name}; grey is red + green + blue to {found.additivity:.2%} of white")
    _say(f"wrote {target} and {plot}")


@calibrate.command
def geometry(
    captures: Path | None = None,
    /,
    *,
    make: Path | None = None,
    out: Path | None = None,
    size: str = "1024x768",
    board: Literal["charuco", "chessboard"] = "charuco",
    options: BoardOptions = _BOARD,
    period: float | None = None,
    stripes: Literal["horizontal", "vertical"] | None = None,
    baseline_mm: float | None = None,
    white_level: float | None = None,
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
        _say(f"{len(sequence.names)} pictures in {make}: project and capture all of them in each pose, a folder a pose")
        return
    folder, target = _both(captures, out)
    _check_target(target, force)
    known = None if calibration is None else Calibration.read(calibration)
    described = options.board(board)
    pattern = chosen_pattern(known, period, stripes)
    names = multishot_sequence(size_px).names
    if not folder.is_dir():
        raise CalibrationError(f"{folder} is no folder: give the one with a folder a pose")
    poses, refused, camera_px = [], [], None
    for place in sorted(entry for entry in folder.iterdir() if entry.is_dir()):
        pose_captures = CapturedFolder(place, names)
        height, width = pose_captures[names[0]].shape[:2]
        if camera_px is not None and camera_px != (width, height):
            raise CalibrationError(f"{place} is {width}x{height}, the poses before are {camera_px[0]}x{camera_px[1]}")
        camera_px = (width, height)
        try:
            poses.append(measure_pose(place.name, pose_captures, described, size_px, white_level))
        except CalibrationError as error:
            refused.append(str(error))
    if camera_px is None or len(poses) < MIN_POSES:
        reason = refused[0] if refused else f"{folder} holds {len(poses)} folders of captures"
        raise CalibrationError(f"{len(poses)} usable poses, at least {MIN_POSES} are needed: {reason}")
    found = solve_geometry(poses, camera_px, size_px, pattern, known, baseline_mm)
    found.calibration.write(target, force=force)
    _say_geometry(found)
    for line in (*refused, *(f"{name} left out: {reason}" for name, reason in found.left_out)):
        _say(f"note: {line}")
    if found.calibration.color_shift_px is not None and found.calibration.crosstalk_matrix is None:
        _say("note: crosstalk dampens the projector's lateral colour: measure radiometry first, and give --calibration")
    _say(f"wrote {target}")


@calibrate.command
def check(
    capture: Path,
    /,
    *,
    calibration: Path,
    shape: Literal["plane", "ball"] | None = None,
    radius_mm: float | None = None,
    settings: Path | None = None,
    fix: Path | None = None,
    arch: Literal["auto", "cpu", "vulkan", "cuda", "metal"] = "auto",
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
    from pipeline.decoder import Decoder
    from pipeline.diagnosis.ripple import diagnose
    from pipeline.diagnosis.surface_check import check_epipolar, check_surface, corrected_light, refuse_other_camera
    from pipeline.footage.image_file import read_picture
    from pipeline.settings import DecodeSettings
    from tikernels import runtime
    from tikernels.raw.lateral_color import align_channels
    from tikernels.raw.linearization import WHITE_LEVELS

    if radius_mm is not None and shape != "ball":
        raise SettingsError("--radius-mm is a ball's: add --shape ball")
    if capture.is_dir() and (shape is not None or fix is not None):
        raise SettingsError(f"{capture} is a folder: --shape and --fix take one picture")
    if fix is not None:
        _check_target(fix, force)
    known = Calibration.read(calibration)
    chosen = DecodeSettings() if settings is None else DecodeSettings.read(settings)
    if WHITE in captured_files(capture):
        names = multishot_sequence(known.geometry().projector.size_px).names
        _say_check(check_epipolar(CapturedFolder(capture, names), known, str(capture), chosen.white_level))
        return
    if known.pattern is not None and "stripes" not in chosen.model_fields_set:
        chosen = chosen.model_copy(update={"stripes": known.pattern.stripes})
    decoder = Decoder(chosen, known, arch=arch)
    stood = known.capture.transfer if known.capture is not None else None
    transfer = chosen.transfer if "transfer" in chosen.model_fields_set or stood is None else stood

    def decoded(path: Path) -> "tuple[Picture, DecodedFrame]":
        picture = read_picture(path)
        refuse_other_camera(known, (picture.shape[1], picture.shape[0]), str(path))
        return picture, decoder.decode(picture)

    if capture.is_dir():
        _check_sequence(capture, decoded, transfer, chosen.white_level, known)
        return
    image, frame = decoded(capture)
    if not frame.mask.any():  # the warning has said why
        sys.exit(1)
    if shape is not None:
        _say_check(check_surface(frame, known, shape, radius_mm))
    white = chosen.white_level or WHITE_LEVELS[image.dtype.name]
    light = image
    if known.color_shift_px is not None:
        light = runtime.to_host(align_channels(image, known.color_shift_px.camera))
    matrix = known.crosstalk_matrix if chosen.crosstalk_matrix is None else chosen.crosstalk_matrix
    compensated = known.pattern is not None and known.pattern.compensated is True
    response = None if compensated else known.response
    lag = known.projector_lag_rad()
    found = diagnose(light, white, frame.unwrapped_phase, frame.mask, matrix, transfer, response, lag)
    _say_findings(found.findings, found.notes[0] if np.isnan(found.limit_rad) else "fine")
    if found.findings:
        worst = max(found.seen_rad, key=lambda harmonic: found.seen_rad[harmonic])
        _say(f"of it, decoding with this calibration leaves {found.seen_rad[worst]:.3f} rad, in harmonic {worst}")
    if fix is not None:
        corrected_light(known, found, light, white, frame, transfer).write(fix, force=force)
        _say(f"wrote {fix}: it fits this pattern; measure the radiometry before you make a new one")


def _check_sequence(
    folder: Path,
    decoded: "Callable[[Path], tuple[Picture, DecodedFrame]]",
    transfer: "Transfer",
    white_level: float | None,
    known: Calibration,
) -> None:
    """Say what a folder of frames, one after another, shows."""
    from pipeline.diagnosis.sequence import MIN_FRAMES, diagnose_sequence
    from tikernels import runtime
    from tikernels.raw.linearization import linearize

    suffixes = (".png", ".tif", ".tiff", ".jpg", ".jpeg")
    paths = [path for path in folder.iterdir() if path.suffix.lower() in suffixes]
    # 2.png before 10.png.
    paths.sort(key=lambda path: [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", path.name)])
    if len(paths) < MIN_FRAMES:
        raise CalibrationError(
            f"{folder} holds {len(paths)} pictures: at least {MIN_FRAMES} frames in a row tell anything"
        )
    light: list[Picture] = []
    phases, masks = [], []
    for path in paths:
        picture, frame = decoded(path)
        if light and picture.shape != light[0].shape:
            raise CalibrationError(f"{path} has another size than the frames before it: give frames of one camera")
        light.append(runtime.to_host(linearize(picture, transfer, white_level)))
        phases.append(frame.unwrapped_phase)
        masks.append(frame.mask)
    place = known.geometry() if known.has_geometry else None
    found = diagnose_sequence(light, 1.0, phases, masks, place, known.crosstalk_matrix)
    _say_findings(found.findings, f"{len(paths)} frames: " + ("nothing found" if found.notes else "fine"))
    for note in found.notes:
        _say(f"note: {note}")


def _say_findings(findings: "tuple[Finding, ...]", otherwise: str) -> None:
    if not findings:
        _say(f"ripple: {otherwise}")
    for finding in findings:
        worst = max(finding.ripple_rad, key=lambda harmonic: finding.ripple_rad[harmonic])
        ripple = f"; {finding.ripple_rad[worst]:.3f} rad in harmonic {worst}" if finding.ripple_rad[worst] > 0 else ""
        _say(
            f"ripple: {' or '.join(finding.causes)} ({finding.size}{ripple}, confidence {finding.confidence:.0%}): "
            f"{finding.advice}"
        )


def _say_check(found: "CheckResult") -> None:
    table = Table("figure", "measured", "predicted", "")
    for measure in found.measures:
        verdict = "fine" if measure.fine else "re-calibrate"
        table.add_row(
            measure.name, f"{measure.measured:.3f} {measure.unit}", f"{measure.predicted:.3f} {measure.unit}", verdict
        )
    _out.print(table)
    _say("fine" if found.fine else "re-calibrate")
    if found.fine and found.blind_spot:
        _say(f"note: {found.blind_spot}")


def chosen_pattern(
    known: Calibration | None,
    period: float | None,
    stripes: Literal["horizontal", "vertical"] | None,
    code: Literal["contrast"] | None = None,
) -> Pattern:
    """Return the pattern that frames are taken with: what was named, else the calibration's.

    Raises
    ------
    SettingsError
        There is no such pattern.
    """
    before = known.pattern if known is not None and known.pattern is not None else Pattern(period_px=768 / 44)
    values = before.model_dump()
    chosen = (("period_px", period), ("stripes", stripes), ("code", code))
    values |= {name: value for name, value in chosen if value is not None}
    return build(Pattern, values, SettingsError, "pattern")


def _say_geometry(found: GeometryFit) -> None:
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
    _out.print(table)


def _say(line: str) -> None:
    _out.print(line, highlight=False, soft_wrap=True)


def _both(captures: Path | None, out: Path | None) -> tuple[Path, Path]:
    if captures is None or out is None:
        raise SettingsError("give either --make and a folder, or a folder of captures and --out")
    return captures, out


def _check_target(target: Path, force: bool) -> None:
    """Refuse a target that cannot be written before minutes have gone into what would be."""
    if not target.parent.is_dir():
        raise OutputError(f"cannot write {target}: its folder does not exist: create the folder first")
    if target.exists() and not force:
        raise OutputError(f"{target} exists already: choose another name, or add --force")
