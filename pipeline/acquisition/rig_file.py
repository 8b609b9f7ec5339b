"""Read ``rig.toml``."""

import tomllib
from pathlib import Path

from hardware.errors import RigError
from hardware.settings import RigSettings
from pipeline.models import read_file


def read_rig(path: str | Path) -> RigSettings:
    """Read what is wired to what.

    Parameters
    ----------
    path : str or Path
        The TOML file.

    Returns
    -------
    RigSettings
        What it says; a calibration named relative to its folder is found from here.

    Raises
    ------
    RigError
        It cannot be read, or a key is missing, unknown or wrong; the message names it.
    """
    settings = read_file(path, RigSettings, tomllib.loads, RigError)
    if settings.calibration is None:
        return settings
    return settings.model_copy(update={"calibration": str(Path(path).parent / settings.calibration)})
