"""Projectors that can be switched from here."""

from hardware.errors import RigError
from hardware.projector.infocus import InFocus
from hardware.projector.pjlink import PJLink
from hardware.protocols import Projector
from hardware.settings import ProjectorSettings


def open_projector(settings: ProjectorSettings) -> Projector:
    """Connect to the rig's projector.

    Raises
    ------
    RigError
        The settings do not say how.
    ProjectorError
        It does not answer, or something else does.
    """
    if settings.control is None:
        raise RigError('nothing switches this projector: write control = "pjlink" or "infocus" under [projector]')
    if settings.port is None:
        example = "socket://10.0.0.6:4352" if settings.control == "pjlink" else "/dev/ttyUSB0"
        raise RigError(f'projector.port is missing: write where it is connected, as port = "{example}"')
    if settings.control == "pjlink":
        return PJLink(settings.port, settings.password)
    return InFocus(settings.port, settings.baud)
