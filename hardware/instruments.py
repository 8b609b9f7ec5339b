"""Open what a rig's file names."""

from hardware.camera import open_camera
from hardware.errors import RigError
from hardware.protocols import Camera, Trigger
from hardware.settings import RigSettings
from hardware.trigger import open_trigger
from hardware.trigger.software import SoftwareTrigger


def open_instruments(settings: RigSettings) -> tuple[Trigger, Camera]:
    """Open a rig's trigger source and its camera, or neither.

    Raises
    ------
    RigError
        The settings contradict each other.
    TriggerError, CameraError
        One of them cannot be reached, or is another one.
    """
    if "simulated" in (settings.trigger.driver, settings.camera.driver):
        raise RigError(
            'a simulated trigger source and a simulated camera go together: set driver = "simulated" for both'
        )
    if settings.trigger.driver == "software":
        camera = open_camera(settings.camera)
        return SoftwareTrigger(camera), camera
    # The trigger source first: a wrong port is told at once, while cameras take seconds.
    trigger = open_trigger(settings.trigger)
    try:
        return trigger, open_camera(settings.camera)
    except BaseException:
        trigger.close()
        raise
