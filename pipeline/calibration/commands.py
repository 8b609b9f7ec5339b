"""`colorphase calibrate ...`: parse, call, say what was found."""

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from cyclopts import App, Parameter
from rich.console import Console
from rich.table import Table

from pipeline.calibration.captures import CapturedFolder, write_sequence
from pipeline.calibration.model import Calibration, Capture
from pipeline.calibration.radiometry import (
    measure_radiometry,
    plot_radiometry,
    radiometry_codes,
    radiometry_sequence,
)
from pipeline.errors import OutputError, SettingsError

_out = Console()

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
    found = measure_radiometry(CapturedFolder(folder, radiometry_sequence(size_of(size)).names), transfer, white_level)
    stood = Capture.model_validate({"exposure_s": exposure_s, "gain": gain, "white_balance": white_balance})
    found.add_to(known, stood).write(target, force=force)
    plot = target.with_name(f"{target.stem}-radiometry.png")
    plot_radiometry(found, plot)
    table = Table(title="crosstalk: what each camera channel sees of the projector's", show_header=True)
    for heading in ("", "red", "green", "blue"):
        table.add_column(heading)
    for i, channel in enumerate(("red", "green", "blue")):
        cells = zip(found.crosstalk_matrix[i], found.crosstalk_sigma[i], strict=True)
        table.add_row(channel, *(f"{value:.4f} ± {sigma:.4f}" for value, sigma in cells))
    _out.print(table)
    name = found.transfer if isinstance(found.transfer, str) else "a curve of its own, measured"
    _say(f"the camera's transfer: {name}; grey is red + green + blue to {found.additivity:.2%} of white")
    _say(f"wrote {target} and {plot}")


def _say(line: str) -> None:
    _out.print(line, highlight=False, soft_wrap=True)


def _both(captures: Path | None, out: Path | None) -> tuple[Path, Path]:
    if captures is None or out is None:
        raise SettingsError("give either --make and a folder, or a folder of captures and --out")
    return captures, out


def _check_target(target: Path, force: bool) -> None:
    """Refuse a target that exists before minutes have gone into what would be written."""
    if target.exists() and not force:
        raise OutputError(f"{target} exists already: choose another name, or add --force")
