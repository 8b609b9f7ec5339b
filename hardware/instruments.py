"""Open what a rig's file names."""

from hardware.camera import open_camera
from hardware.drivers import SIMULATED, SOFTWARE
from hardware.errors import RigError
from hardware.protocols import Camera, Trigger
from hardware.settings import RigSettings
from hardware.simulated import SimulatedInstruments
from hardware.trigger import open_trigger
from hardware.trigger.software import SoftwareTrigger


def open_instruments(settings: RigSettings) -> tuple[Trigger, Camera]:
    """Open a rig's trigger source and its camera, or neither; simulated ones see a wall under the pattern.

    Raises
    ------
    RigError
        The settings contradict each other.
    TriggerError, CameraError
        One of them cannot be reached, or is another one.

    Examples
    --------
    >>> timing = dict(period_s=0.02, frames=4, camera_delay_s=0.001)
    >>> parts = dict(trigger=dict(driver="simulated"), camera=dict(driver="simulated", exposure_s=0.008))
    >>> settings = colorphase.RigSettings(timing=timing, **parts)
    >>> trigger, camera = colorphase.open_instruments(settings)
    >>> camera.limits.size_px
    (640, 480)
    >>> camera.close(), trigger.close()
    (None, None)
    """
    simulated = [part.driver == SIMULATED for part in (settings.trigger, settings.camera)]
    if all(simulated):
        devices = SimulatedInstruments.before_a_wall(settings)
        return devices.trigger, devices.camera
    if any(simulated):
        raise RigError(
            'a simulated trigger source and a simulated camera go together: set driver = "simulated" for both'
        )
    if settings.trigger.driver == SOFTWARE:
        camera = open_camera(settings.camera)
        return SoftwareTrigger(camera), camera
    # The trigger source first: a wrong port is reported at once, while cameras take seconds.
    trigger = open_trigger(settings.trigger)
    try:
        return trigger, open_camera(settings.camera)
    except BaseException:
        trigger.close()
        raise
