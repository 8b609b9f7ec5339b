"""Sources of pulses: one file per instrument, each with the methods of `hardware.protocols.Trigger`."""

from hardware.drivers import SIMULATED, SOFTWARE, open_driver
from hardware.errors import RigError
from hardware.protocols import Trigger
from hardware.settings import TriggerSettings

__all__ = ["open_trigger"]


def open_trigger(settings: TriggerSettings) -> Trigger:
    """Open the instrument that a rig's settings name.

    Raises
    ------
    RigError
        The settings contradict each other, or the driver is not there or is none that can be opened by itself.
    TriggerError
        It cannot be reached, or something else is there.
    """
    if settings.driver == SIMULATED:
        raise RigError("trigger.driver: a file's rig is real; without one, use `colorphase capture --rig simulated`")
    if settings.driver == SOFTWARE:
        raise RigError(f"trigger.driver: {settings.driver} is no instrument with a port")
    trigger: Trigger = open_driver("trigger.driver", settings.driver, "colorphase.triggers", settings, Trigger)
    return trigger
