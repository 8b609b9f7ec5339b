"""`colorphase settings`, and the settings that `colorphase decode` takes as options."""

import json
import textwrap
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from cyclopts import Parameter

from pipeline.cli.console import check_target, say
from pipeline.files import write_atomically
from pipeline.settings import DecodeSettings

_WIDTH = 118


@Parameter(name="*")
@dataclass(frozen=True)
class SettingsOptions:
    """Settings that are asked for most; they overrule those of --settings."""

    stripes: Literal["horizontal", "vertical"] | None = None
    """Horizontal where the phase changes from row to row."""
    transfer: Literal["linear", "srgb", "bt709"] | None = None
    """How the camera encoded light; left out, the calibration or the file tells."""
    period: float | None = None
    """Camera px a cycle, roughly; left out, measured from the frame."""
    code: Literal["contrast"] | None = None
    """The pattern's code; a calibration's pattern wins."""
    smoothing: int | None = None
    """Side of the window that the phase is smoothed over, px, an odd number; 0: none."""

    def applied_to(self, settings: DecodeSettings) -> DecodeSettings:
        """Return settings in which these are replaced.

        Raises
        ------
        SettingsError
            A value is wrong.
        """
        names = {"period": "camera_period_px", "smoothing": "smoothing_px"}
        given = {names.get(name, name): value for name, value in asdict(self).items() if value is not None}
        if not given:
            return settings
        return DecodeSettings.of(**{**settings.model_dump(exclude_unset=True), **given})


def settings(file: Path, /, *, force: bool = False) -> None:
    """Write a file of all settings with their defaults and what they mean, each to be uncommented where it is changed.

    Example: colorphase settings settings.toml

    Parameters
    ----------
    file
        The TOML file to make.
    force
        Replace a file that is there.
    """
    check_target(file, force=force)
    write_atomically(file, template().encode())
    say(f"wrote {file}: decode with --settings {file}")


def template() -> str:
    """Return a settings file in which every default stands as a comment, below what it means."""
    lines = ["# Settings for colorphase decode. What is commented out, or left out, has its default."]
    for name, field in DecodeSettings.model_fields.items():
        meaning = " ".join((field.description or "").split())
        lines += ["", *textwrap.wrap(meaning, _WIDTH, initial_indent="# ", subsequent_indent="# ")]
        default = "(left out)" if field.default is None else json.dumps(field.default)
        lines.append(f"# {name} = {default}")
    return "\n".join(lines) + "\n"
