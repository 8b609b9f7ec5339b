"""Projectors that can be switched from here."""

from hardware.drivers import open_driver
from hardware.errors import RigError
from hardware.protocols import Projector
from hardware.settings import ProjectorSettings

__all__ = ["open_projector"]


def open_projector(settings: ProjectorSettings) -> Projector:
    """Connect to the rig's projector.

    Raises
    ------
    RigError
        The settings do not specify how, or the driver is not there.
    ProjectorError
        It does not answer, or something else does.
    """
    if settings.control is None:
        raise RigError('nothing switches this projector: write control = "pjlink" or "infocus" under [projector]')
    projector: Projector = open_driver(
        "projector.control", settings.control, "colorphase.projectors", settings, Projector
    )
    return projector
