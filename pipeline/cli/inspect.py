"""`colorphase inspect`."""

import sys
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from rich.table import Table

from pipeline.cli.console import Arch, SettingsFile, read_calibration, read_settings, say, stdout, steps
from pipeline.footage.footage import StoredAs

if TYPE_CHECKING:
    from pipeline.diagnosis.footage_inspection import Inspection

_AS_IT_SAYS = StoredAs()
_STYLES = {"fine": "", "costs": "yellow", "spoils": "red"}
_VERDICTS = {"fine": "fine", "costs": "fine to use, could be better", "spoils": "do not use it as it is"}


def inspect(
    input: Path,
    /,
    *,
    settings: SettingsFile = None,
    calibration: Path | None = None,
    json: bool = False,
    arch: Arch = "auto",
    stored_as: Annotated[StoredAs, Parameter(name="*")] = _AS_IT_SAYS,
) -> None:
    """Say what footage will cost in accuracy, and what to change. Exit code 3: do not use it as it is.

    Looks at some twenty frames, however long the footage is. Costs are radians RMS of a pixel's phase.

    Example: colorphase inspect film.mp4, or colorphase inspect film.mp4 --siting centre --json

    Parameters
    ----------
    input
        A picture, a folder of pictures, a video or a recording.
    calibration
        The rig's calibration.json; with it the costs of motion are in mm.
    json
        Print JSON instead of a table.
    """
    from pipeline.diagnosis.footage_inspection import NOT_AS_IT_IS, inspect_footage

    chosen = read_settings(settings)
    with steps() as step:
        found = inspect_footage(input, stored_as, chosen, arch, step, read_calibration(calibration))
    if json:
        for line in dumps(found.as_json(), indent=1).splitlines():
            say(line)
    else:
        _show(found, str(input))
    if found.grade == "spoils":
        sys.exit(NOT_AS_IT_IS)


def _show(found: "Inspection", title: str) -> None:
    table = Table("what", "found", "costs, rad", "what to change", title=title)
    for finding in found.findings:
        cost = "" if finding.cost_rad is None else f"{finding.cost_rad:.3f}"
        table.add_row(finding.topic, finding.found, cost, finding.advice, style=_STYLES[finding.grade])
    stdout.print(table)
    for sentence in found.unknown:
        say(f"unknown: {sentence}")
    worst = "" if found.grade == "fine" else f" ({', '.join(found.topics(found.grade))})"
    say(_VERDICTS[found.grade] + worst)
