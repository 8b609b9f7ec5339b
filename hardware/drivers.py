"""The drivers: what each is called in ``rig.toml``, and where it is.

A new driver is a file of its own and a row here; the names that settings accept, opening, and the listing of cameras
follow from the row. A place is ``module:name``, and names what is called with its section of the settings and returns
the opened instrument: the class itself, or a function. It is imported when the instrument is opened. A driver of the
user's own needs no row: ``rig.toml`` names it as ``module:Class``, or as its package announces it in a group of entry
points, which are the keys of `DRIVERS`.
"""

import logging
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from hardware.errors import RigError
from hardware.plugins import Plugin, described, load, plugin_of
from tikernels.errors import Error

_log = logging.getLogger("colorphase.drivers")


@dataclass(frozen=True)
class Driver:
    """Location of a driver."""

    place: str
    listing: str | None = None  # what returns the `Identity` of each one that can be seen; None: it cannot look


CAMERAS: Mapping[str, Driver] = {
    "basler": Driver("hardware.camera.basler:BaslerCamera", "hardware.camera.basler:list_basler_cameras"),
    "aravis": Driver("hardware.camera.aravis:AravisCamera", "hardware.camera.aravis:list_aravis_cameras"),
    "opencv": Driver("hardware.camera.opencv:OpenCVCamera", "hardware.camera.opencv:list_webcams"),
}
TRIGGERS: Mapping[str, Driver] = {
    "box": Driver("hardware.trigger.box:open_box"),
    "quantum-composers": Driver("hardware.trigger.quantum_composers:open_quantum_composers"),
    "dg645": Driver("hardware.trigger.dg645:open_dg645"),
}
PROJECTORS: Mapping[str, Driver] = {
    "pjlink": Driver("hardware.projector.pjlink:open_pjlink"),
    "infocus": Driver("hardware.projector.infocus:open_infocus"),
}
DRIVERS: Mapping[str, Mapping[str, Driver]] = {
    "colorphase.cameras": CAMERAS,
    "colorphase.triggers": TRIGGERS,
    "colorphase.projectors": PROJECTORS,
}
#: The driver of a trigger that is no instrument: this program triggers the camera.
SOFTWARE = "software"
#: The driver of trigger and camera of a rig of which nothing is there.
SIMULATED = "simulated"


def open_driver(key: str, name: str, group: str, settings: object, protocol: type) -> Any:
    """Open an instrument by its driver's name.

    Parameters
    ----------
    key : str
        Place in the settings that names it, as ``camera.driver``, for messages.
    name : str
        A name in the group's table, one that a package announces, or ``module:Class``.
    group : str
        A key of `DRIVERS`.
    settings : object
        The section of the settings that the driver is called with.
    protocol : type
        Methods that the instrument must have, from `hardware.protocols`.

    Raises
    ------
    RigError
        There is no such module or class, several packages announce the name, it lacks what the protocol requires, or,
        if it is the user's, fails.
    TriggerError, CameraError, ProjectorError
        By the driver: the instrument cannot be reached, or is another one.
    """
    table = DRIVERS[group]
    own = Plugin(table[name].place if name in table else name)
    place = plugin_of(group, name, table, RigError) or own
    driver = load(key, place, RigError)
    members = {member: vars(protocol)[member] for member in vars(protocol) if not member.startswith("_")}
    if isinstance(driver, type):  # what a class lacks is reported before anything is opened
        methods = [member for member, value in members.items() if callable(value)]
        _refuse_lacking(key, place, driver, methods, protocol)
    elif not callable(driver):
        what = protocol.__name__.lower()
        raise RigError(f"{key}: {place} cannot be called: name a class, or a function that opens a {what}")
    try:
        instrument = driver(settings)
    except Exception as error:
        if name in table or isinstance(error, Error):
            raise
        raise RigError(f"{key}: {place} cannot be opened ({described(error)}): correct it") from error
    _refuse_lacking(key, place, instrument, members, protocol)
    _log.info("%s: %s opens %s", key, place, instrument.identity)
    return instrument


def _refuse_lacking(key: str, place: Plugin, what: object, members: Collection[str], protocol: type) -> None:
    lacking = [member for member in members if not hasattr(what, member)]
    if lacking:
        raise RigError(
            f"{key}: {place} lacks {', '.join(lacking)}: give it what hardware.protocols.{protocol.__name__} asks for"
        )
