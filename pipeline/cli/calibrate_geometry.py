"""`colorphase calibrate geometry`."""

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from cyclopts import Parameter
from rich.table import Table

from pipeline.calibration.board_poses import measure_poses
from pipeline.calibration.captures import write_sequence
from pipeline.calibration.model import Calibration, Uncertainty, choose_pattern
from pipeline.calibration.multishot import multishot_codes, multishot_sequence
from pipeline.calibration.rig_geometry import GeometryFit, SecondBoard, solve_geometry
from pipeline.cli.calibrate_options import PROJECTOR_SIZE, BoardOptions, captures_and_target
from pipeline.cli.console import above_zero, check_target, read_calibration, say, size_of, stdout
from pipeline.errors import SettingsError

_BOARD = BoardOptions()


def geometry(
    captures: Path | None = None,
    /,
    *,
    make: Path | None = None,
    out: Path | None = None,
    size: str = PROJECTOR_SIZE,
    board: Literal["charuco", "chessboard"] = "charuco",
    options: BoardOptions = _BOARD,
    period: float | None = None,
    stripes: Literal["horizontal", "vertical"] | None = None,
    code: Literal["contrast", "none"] | None = None,
    baseline_mm: float | None = None,
    second_board: Path | None = None,
    second_square_mm: Annotated[float | None, Parameter(validator=above_zero)] = None,
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
    second_board
        Folder with one pose or more of the same board printed in another size; a wrong square size shows in it.
    second_square_mm
        The side of its squares, measured by itself.
    white_level
        Full scale of the captures; left out, their type's.
    calibration
        An earlier calibration, whose light is kept.
    force
        Replace an existing calibration.
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
    pattern = choose_pattern(known, period, stripes, code)
    measured = measure_poses(folder, described, size_px, white_level)
    refused, second = [*measured.refused], None
    if second_board is not None and second_square_mm is not None:
        other = options.with_square(second_square_mm).board(board)
        seen = measure_poses(second_board, other, size_px, white_level, least=1)
        refused += seen.refused
        second = SecondBoard(seen.poses, second_square_mm, described.square_mm)
    found = solve_geometry(measured.poses, measured.camera_size_px, size_px, pattern, known, baseline_mm, second)
    found.calibration.write(target, force=force)
    _show_geometry(found)
    _say_verdict(found, refused)
    say(f"wrote {target}")


def _write_fringes(folder: Path, size_px: tuple[int, int]) -> None:
    """Write the pictures to project."""
    sequence = multishot_sequence(size_px)
    write_sequence(folder, sequence, lambda name: multishot_codes(name, size_px))
    say(f"{len(sequence.names)} pictures in {folder}: project and capture all of them in each pose, a folder a pose")


def _say_verdict(found: GeometryFit, refused: list[str]) -> None:
    """Say which poses are missing or bad, what the geometry is worth, and what is known of its scale."""
    for line in (*refused, *(f"{name} left out: {reason}" for name, reason in found.left_out)):
        say(f"note: {line}")
    if found.calibration.color_shift_px is not None and found.calibration.crosstalk_matrix is None:
        say("note: crosstalk dampens the projector's lateral colour: measure radiometry first, and give --calibration")
    worst, *faulty = found.verdict.poses
    say(f"worst pose: {worst.in_words()}")
    for pose in faulty:
        say(f"look at {pose.in_words()}")
    say(found.verdict.in_words())
    for advice in found.verdict.advice:
        say(f"better: {advice}")
    say(_scale_in_words(found.calibration))


def _scale_in_words(calibration: Calibration) -> str:
    """Return what is to be known of the scale."""
    baseline_mm = float(np.linalg.norm(calibration.geometry().translation_mm))
    if calibration.scale_proof is not None:
        return f"scale proven by the {calibration.scale_proof}; camera and projector stand {baseline_mm:.1f} mm apart"
    return (
        f"scale unproven: only --square-mm tells it, and camera and projector stand {baseline_mm:.0f} mm apart by it; "
        "measure that and give it as --baseline-mm, or show a board of another size (--second-board)"
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
