"""`colorphase certify`."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from rich.table import Table

from pipeline import __version__
from pipeline.calibration.model import Calibration
from pipeline.cli.console import (
    Arch,
    Replace,
    SettingsFile,
    above_zero,
    bounded,
    check_target,
    read_settings,
    remark,
    say,
    stdout,
)
from pipeline.errors import CalibrationError, SettingsError
from pipeline.files import write_atomically
from pipeline.settings import DecodeSettings
from pipeline.text import sizes_differ

if TYPE_CHECKING:
    from pipeline.diagnosis.artefacts import BallBar, Position
    from pipeline.diagnosis.certificate import Certificate


def certify(
    pictures: Path,
    /,
    *,
    diameter_mm: Annotated[float, Parameter(validator=above_zero)],
    spacing_mm: Annotated[float, Parameter(validator=above_zero)],
    reference_mm: Annotated[float, Parameter(validator=bounded(0))],
    rig: str | None = None,
    calibration: Path | None = None,
    distance_mm: Annotated[float | None, Parameter(validator=above_zero)] = None,
    relief: Annotated[bool, Parameter(negative="")] = False,
    out: Path | None = None,
    settings: SettingsFile = None,
    arch: Arch = "auto",
    force: Replace = False,
) -> None:
    """Certify a rig by a ball bar and a plate, each in seven positions, in the words of VDI/VDE 2634 Part 2.

    Pictures of a corrugated plate (docs/certify.md) measure the lateral resolution, too.

    With --rig it says where to hold them, and takes the pictures that the folder lacks, each when the artefact has been
    still for 2 s, or Enter is pressed. Stopped at any time, it goes on where it was when it is called again.

    Example: colorphase certify certified --rig rig.toml --diameter-mm 60 --spacing-mm 200.012 --reference-mm 0.004

    Parameters
    ----------
    pictures
        Folder with the pictures bar-1 to bar-7 and plane-1 to plane-7, and relief-1 and relief-2 if there is a
        corrugated plate, taken under the pattern that colorphase pattern --code contrast2 --calibration writes.
    diameter_mm
        The balls' diameter.
    spacing_mm
        The distance of their centres.
    reference_mm
        The expanded uncertainty (k = 2) of that distance, by the bar's own certificate.
    rig
        The rig's TOML file, whose projector.display shows the pattern; or simulated, which needs nothing to be there.
    calibration
        The rig's calibration; left out, the one that the rig's file names.
    distance_mm
        The distance of the measuring volume's middle; left out, where the axes of camera and projector meet.
    relief
        Take the pictures of a corrugated plate, too.
    out
        The JSON file to write.
    """
    from pipeline.calibration.captures import captured_files
    from pipeline.decoding.footage_light import with_transfer_of
    from pipeline.diagnosis.artefacts import BallBar, Volume, positions_in
    from pipeline.diagnosis.certificate import certify as measure
    from pipeline.diagnosis.certificate import open_pictures, under_cells

    if out is not None:
        check_target(out, force=force)
    bar, chosen = BallBar(diameter_mm, spacing_mm), read_settings(settings)
    if rig is not None:
        known = _capture(rig, pictures, bar, calibration, distance_mm, chosen, arch, relief=relief)
    elif calibration is not None:
        known = under_cells(Calibration.read(calibration))
    else:
        raise SettingsError("give --calibration, or --rig to take the pictures with")
    relief = relief or any(name.startswith("relief-") for name in captured_files(pictures))
    positions = positions_in(Volume.before(known.geometry(), distance_mm), bar, relief=relief)
    source = open_pictures(pictures, positions)
    chosen, _ = with_transfer_of(source, chosen, known)
    found = measure(source, bar, reference_mm, known, chosen, arch, distance_mm)
    _show(found, bar)
    if out is not None:
        said = {"version": __version__, "calibration": known.digest(), "reference": asdict(bar)} | asdict(found)
        write_atomically(out, (json.dumps(said, indent=1) + "\n").encode())
        say(f"wrote {out}")


def _capture(
    rig: str,
    folder: Path,
    bar: "BallBar",
    path: Path | None,
    distance_mm: float | None,
    settings: DecodeSettings,
    arch: str,
    *,
    relief: bool,
) -> Calibration:
    """Take the pictures that a folder lacks; return the calibration, under the pattern that they show."""
    from hardware.drivers import SIMULATED
    from pipeline.acquisition.chosen_rig import read_rig
    from pipeline.acquisition.guided_capture import GuidedCapture
    from pipeline.acquisition.simulated_capture import SETTINGS
    from pipeline.calibration.captures import captured_files
    from pipeline.cli.calibrate_capture import GUIDE
    from pipeline.cli.opened_studio import opened_studio
    from pipeline.decoding.footage_light import with_transfer_of
    from pipeline.diagnosis.artefacts import Plate, Relief, Volume
    from pipeline.diagnosis.certificate import bar_in, under_cells
    from pipeline.diagnosis.picture_reader import PictureReader
    from pipeline.footage.opening import open_footage
    from pipeline.pattern import make_pattern
    from pipeline.simulation import OWN_CALIBRATION

    instruments = SETTINGS if rig == SIMULATED else read_rig(rig)
    named = path or instruments.calibration or (OWN_CALIBRATION if rig == SIMULATED else None)
    if named is None:
        raise SettingsError(f"{rig} names no calibration: give --calibration")
    known = under_cells(Calibration.read(named))
    geometry = known.geometry()
    volume = Volume.before(geometry, distance_mm)
    reliefs = (Relief.within(volume),) if relief else ()
    bars = list(bar.positions(volume))

    def check(position: "Position", picture: Path) -> None:
        with open_footage(picture) as source:
            chosen, _ = with_transfer_of(source, settings, known)
            ((_, frame),) = PictureReader.of_one(source, known, chosen, arch).frames()
        bar_in(position, bars, frame, bar, geometry, chosen.smoothing_px)

    artefacts = (Plate.within(volume), *reliefs)
    for positions, artefact in ((bars, bar), *((list(each.positions(volume)), each) for each in artefacts)):
        if all(position.name in captured_files(folder) for position in positions):
            continue
        with opened_studio(instruments, rig, artefact, folder / GUIDE) as (studio, show):
            identity = {"camera": instruments.camera.model_dump(mode="json"), "bar": asdict(bar)}
            guided = GuidedCapture(studio, folder, identity, show, remark)
            guided.check_rig()
            geometry.check_frame(guided.camera_px)
            if studio.projector_px != geometry.projector.size_px:
                sizes = "the projector", studio.projector_px, "the calibrated one is", geometry.projector.size_px
                raise CalibrationError(f"{sizes_differ(*sizes)}: choose its display")
            codes = make_pattern(studio.projector_px, geometry.pattern, known.response)
            if artefact is bar:
                guided.take_positions(positions, codes, check)
            else:
                guided.take_positions(positions, codes)
    return known


def _show(found: "Certificate", bar: "BallBar") -> None:
    table = Table("mm", "largest", "trueness", "precision")
    for figure in found.figures:
        values = (figure.largest_mm, figure.trueness_mm, figure.precision_mm)
        table.add_row(figure.name, *(f"{value:.3f}" for value in values))
    stdout.print(table)
    say(f"noise of a point: {found.noise_mm:.3f} mm, {found.noise_predicted_mm:.3f} mm predicted")
    for direction, lateral in found.lateral.items():
        limit = f"under {lateral.periods_mm[-1]:g} mm"
        if lateral.limit_mm is not None and lateral.sigma_mm is not None:
            limit = f"{lateral.limit_mm:.2f} mm, U (k = 2) {2 * lateral.sigma_mm:.2f} mm"
        say(f"lateral resolution {direction} the stripes: {limit}, {lateral.predicted_mm:.2f} mm predicted")
    if not found.lateral:
        say("lateral resolution: not measured, as there are no pictures of a corrugated plate")
    table = Table(f"uncertainty of {bar.spacing_mm:g} mm", "mm")
    for name, sigma_mm in found.budget_mm.items():
        table.add_row(name, f"{sigma_mm:.3f}")
    table.add_row("mean error, not corrected", f"{found.spacing.trueness_mm:+.3f}")
    table.add_row("U (k = 2)", f"{found.uncertainty_mm:.3f}")
    stdout.print(table)
