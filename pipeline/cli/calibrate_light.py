"""`colorphase calibrate radiometry` and `colorphase calibrate wavelengths`."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from cyclopts import Parameter
from rich.table import Table

from pipeline.calibration.captures import CapturedFolder, PictureSequence, refuse_other_camera, write_sequence
from pipeline.calibration.color_chart import chart_codes, chart_sequence, measure_wavelengths, read_spectra
from pipeline.calibration.model import Calibration
from pipeline.calibration.radiometry import (
    PRIMARIES,
    Radiometry,
    measure_radiometry,
    plot_radiometry,
    radiometry_codes,
    radiometry_sequence,
)
from pipeline.calibration.verdict import judge_radiometry
from pipeline.cli.calibrate_options import PROJECTOR_SIZE, captures_and_target
from pipeline.cli.console import above_zero, check_target, read_calibration, say, size_of, stdout
from pipeline.errors import SettingsError
from pipeline.models import CameraState, FloatArray, build


def radiometry(
    captures: Path | None = None,
    /,
    *,
    make: Path | None = None,
    out: Path | None = None,
    size: str = PROJECTOR_SIZE,
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
    folder, target = captures_and_target(captures, out)
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
    verdict = judge_radiometry(found, known.geometry() if known is not None and known.has_geometry else None)
    name = found.transfer if isinstance(found.transfer, str) else "a curve of its own, measured"
    say(f"the camera's transfer: {name}; grey is red + green + blue to {found.additivity:.2%} of white")
    say(verdict.in_words())
    for advice in verdict.advice:
        say(f"better: {advice}")
    say(f"wrote {target} and {plot}")


def wavelengths(
    captures: Path | None = None,
    /,
    *,
    make: Path | None = None,
    out: Path | None = None,
    size: str = PROJECTOR_SIZE,
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
