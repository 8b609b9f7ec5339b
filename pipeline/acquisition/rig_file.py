"""Change values in a rig's TOML file: its comments stay, and the file that was is kept."""

from collections.abc import Mapping
from difflib import unified_diff
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError

from hardware.errors import RigError
from pipeline.errors import OutputError
from pipeline.files import explain, write_atomically
from pipeline.limits import TEXT_BYTES, read_plain, read_text


def with_values(text: str, values: Mapping[str, float | list[float]]) -> str:
    """Return a TOML text with other values, everything else as it is.

    Parameters
    ----------
    text : str
        The file's.
    values : mapping
        Numbers, or lists of them, by section and key, as ``projector.fields.red_s``; what is missing is added.

    Raises
    ------
    RigError
        The text is no TOML, or a section is not one.

    Examples
    --------
    >>> with_values("camera = {exposure_s = 0.02}  # ours", {"camera.exposure_s": 0.016667})
    'camera = {exposure_s = 0.016667}  # ours'
    """
    try:
        document = tomlkit.parse(text)
        for name, value in values.items():
            *sections, key = name.split(".")
            table: Any = document
            for section in sections:
                if section not in table:
                    is_inline = isinstance(table, tomlkit.items.InlineTable)
                    table.add(section, tomlkit.inline_table() if is_inline else tomlkit.table())
                table = table[section]
                if not isinstance(table, Mapping):
                    raise RigError(f"{section} is not a section: write [{section}]")
            if table.get(key) != value:
                table[key] = value
    except TOMLKitError as error:
        raise RigError(f"it is no TOML: {error}") from None
    return tomlkit.dumps(document)


def change_file(path: Path, values: Mapping[str, float | list[float]]) -> tuple[Path | None, list[str]]:
    """Write other values into a file, and keep the old one next to it.

    Parameters
    ----------
    path : Path
        The TOML file.
    values : mapping
        As for `with_values`.

    Returns
    -------
    Path or None
        The file that the old text is kept in; None: nothing had to be changed, and nothing is written.
    list of str
        The lines of the difference.

    Raises
    ------
    RigError
        The file cannot be read.
    OutputError
        It cannot be written.
    """
    try:
        read_text(path)  # which refuses what is no text
        old = read_plain(path, TEXT_BYTES)
    except (OSError, ValueError) as error:
        reason = explain(error) if isinstance(error, OSError) else error
        raise RigError(f"cannot read {path}: {reason}") from None
    before = old.decode("utf-8-sig")  # line ends stay as they are
    after = with_values(before, values)
    if after == before:
        return None, []
    kept = _unused_name(path)
    write_atomically(kept, old)
    write_atomically(path, after.encode())
    lines = unified_diff(before.splitlines(), after.splitlines(), kept.name, path.name, n=0, lineterm="")
    return kept, list(lines)


def _unused_name(path: Path) -> Path:
    """Return the first of rig.toml.old, rig.toml.old-2, ... that is not there."""
    for number in range(1, 1000):
        kept = path.with_name(f"{path.name}.old" + (f"-{number}" if number > 1 else ""))
        if not kept.exists():
            return kept
    raise OutputError(f"cannot keep {path}: there are 999 old ones beside it: delete some")
