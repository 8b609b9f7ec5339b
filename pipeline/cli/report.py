"""`colorphase report`."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from pipeline.calibration import Calibration
from pipeline.cli.console import Replace, above_zero, check_target, read_calibration, say, steps
from pipeline.errors import SettingsError
from pipeline.files import write_atomically
from pipeline.output.folder import store_in


def report(
    input: str,
    /,
    *,
    out: Path,
    calibration: Path | None = None,
    plane: Annotated[bool, Parameter(negative="")] = False,
    ball_mm: Annotated[float | None, Parameter(validator=above_zero)] = None,
    spacing_mm: Annotated[float | None, Parameter(validator=above_zero)] = None,
    force: Replace = False,
) -> None:
    """Write a result or a calibration as a document: one HTML file that needs nothing else, and that also prints.

    Example: colorphase report film --calibration calibration.json --out report.html, or
    colorphase report calibration.json --out calibration.html

    Parameters
    ----------
    input
        A result.zarr or the folder that it is in, or a calibration.json.
    out
        The HTML file to write.
    calibration
        The calibration that the result was decoded with, for what it is uncertain by.
    plane
        The result shows a plane, the largest surface in view: state its errors in the words of VDI/VDE 2634 Part 2.
    ball_mm
        The result shows a ball of this diameter: the same.
    spacing_mm
        It shows two such balls, whose centres are this far apart.
    """
    from pipeline.view.report import Artefacts, report_calibration, report_result

    if spacing_mm is not None and ball_mm is None:
        raise SettingsError("--spacing-mm is of two balls: add --ball-mm, their diameter")
    check_target(out, force=force)
    artefacts = Artefacts(plane, ball_mm, spacing_mm)
    with steps() as show:
        show("reading")
        if Path(input).suffix == ".json":
            if calibration is not None or artefacts != Artefacts():
                raise SettingsError(f"{input} is a calibration: leave out what is of a result")
            text = report_calibration(Calibration.read(input), Path(input).name)
        else:
            text = report_result(store_in(input), read_calibration(calibration), artefacts)
    content = text.encode()
    write_atomically(out, content)
    say(f"wrote {out}: {len(content) / 1e6:.1f} MB")
