"""`colorphase calibrate check`."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from cyclopts import Parameter
from rich.table import Table

from pipeline.calibration.model import Calibration
from pipeline.cli.console import Arch, Replace, SettingsFile, above_zero, check_target, read_settings, say, stdout
from pipeline.errors import SettingsError

if TYPE_CHECKING:
    from pipeline.diagnosis.channel_spectra import RippleFinding
    from pipeline.diagnosis.rig_check import CheckResult


def check(
    capture: Path,
    /,
    *,
    calibration: Path,
    shape: Literal["plane", "ball"] | None = None,
    radius_mm: Annotated[float | None, Parameter(validator=above_zero)] = None,
    settings: SettingsFile = None,
    fix: Path | None = None,
    arch: Arch = "auto",
    force: Replace = False,
) -> None:
    """Check whether a calibration still holds, and why a surface is wavy.

    Example: colorphase calibrate check ball.png --calibration calibration.json --shape ball --radius-mm 40

    Parameters
    ----------
    capture
        A picture of a smooth surface under the pattern, or a capture of one frame; a folder of frames, one after
        another, for beat and motion; or a folder with the captures that geometry is measured from, of anything, for the
        epipolar error.
    calibration
        The calibration in doubt.
    shape
        What was captured, to be compared with a perfect one.
    radius_mm
        The ball's true radius.
    fix
        Write a calibration whose light is corrected by the picture.
    """
    from pipeline.acquisition.capture_folder import RECORDING
    from pipeline.decoding.footage_light import with_transfer_of
    from pipeline.diagnosis.rig_check import check_captures, check_picture, check_sequence, holds_captures
    from pipeline.footage.opening import open_footage

    if radius_mm is not None and shape != "ball":
        raise SettingsError("--radius-mm is a ball's: add --shape ball")
    one_picture = shape is not None or fix is not None
    if fix is not None:
        check_target(fix, force=force)
    known = Calibration.read(calibration)
    chosen = read_settings(settings)
    if holds_captures(capture):
        if one_picture:
            raise SettingsError(f"{capture} holds captures of a calibration: --shape and --fix take one picture")
        _show_check(check_captures(capture, known, chosen))
        return
    recorded = capture / RECORDING
    source = open_footage(recorded if recorded.is_dir() else capture)
    chosen, _ = with_transfer_of(source, chosen, known)
    if capture.is_dir() and not one_picture:
        n_frames, changes = check_sequence(source, known, chosen, arch)
        _say_findings(changes.findings, f"{n_frames} frames: " + ("nothing found" if changes.notes else "fine"))
        for note in changes.notes:
            say(f"note: {note}")
        return
    found = check_picture(source, known, chosen, arch, shape, radius_mm)
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
