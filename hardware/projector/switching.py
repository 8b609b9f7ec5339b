"""Common parts of all projectors: they need a port, and take minutes to switch on or off."""

import time
from collections.abc import Callable

from hardware.errors import ProjectorError, RigError
from hardware.protocols import PowerState
from hardware.settings import ProjectorSettings

#: Lamps take up to a minute and a half to light and two to cool, and one that was just switched off does both.
DEADLINE_S = 240.0
#: How often it is queried; its network part is slow, and busy with the change.
POLL_S = 2.0


def switch_power(
    on: bool, state: Callable[[], PowerState | None], command: Callable[[], bool], notify: Callable[[str], None]
) -> None:
    """Send a command until it is taken, and wait until it is carried out.

    Parameters
    ----------
    on : bool
        True to switch it on, False to switch it off.
    state : callable
        Queries what it does now; None: it is busy, and silent.
    command : callable
        Sends the command; False: it cannot be taken now.
    notify : callable
        Called with what the projector is doing.

    Raises
    ------
    ProjectorError
        It does not get there in time.
    """
    wanted: PowerState = "on" if on else "off"
    deadline_s = time.monotonic() + DEADLINE_S
    taken = False
    while (now := state()) != wanted:
        if time.monotonic() >= deadline_s:
            raise ProjectorError(
                f"the projector is not {wanted} after {DEADLINE_S:g} s but {now or 'silent'}: `colorphase projector "
                "status` may say why; look at its lamps"
            )
        if not taken:
            taken = command()
        notify(now if taken and now is not None else f"waiting to switch it {wanted}")
        time.sleep(POLL_S)


def port_of(settings: ProjectorSettings, example: str) -> str:
    """Return where the projector is.

    Raises
    ------
    RigError
        The settings do not specify it.
    """
    if settings.port is None:
        raise RigError(f'projector.port is missing: write where it is connected, as port = "{example}"')
    return settings.port
