"""Times of a rig's pulses, and checks that trigger source and camera can keep up with them."""

from hardware.colour_cycle import check_exposure
from hardware.drivers import SOFTWARE
from hardware.errors import RigError
from hardware.protocols import Camera, Trigger
from hardware.pulses import Pulse, PulseTrain
from hardware.settings import RigSettings


def train_of(settings: RigSettings) -> PulseTrain:
    """Return the burst that a rig's file specifies."""
    timing = settings.timing
    return PulseTrain(
        period_s=timing.period_s,
        count=timing.frames,
        projector=Pulse(timing.projector_delay_s, timing.projector_width_s),
        camera=Pulse(timing.camera_delay_s, timing.camera_width_s),
    )


def check_timing(settings: RigSettings, trigger: Trigger, camera: Camera) -> None:
    """Refuse what can never make whole bursts.

    Raises
    ------
    RigError
        The message names what contradicts what, and a value that would do.
    """
    timing, projector = settings.timing, settings.projector
    if projector.colour_cycle_s is not None:
        check_exposure(camera.exposure_s, projector.colour_cycle_s)
    if timing.period_s < camera.limits.min_period_s:
        raise RigError(
            f"timing.period_s is {timing.period_s:g}, but a frame takes the camera {camera.limits.min_period_s:.6g} s, "
            "exposure and readout: make the period that long, or the exposure shorter"
        )
    if (settings.trigger.driver == SOFTWARE) != (settings.camera.trigger == "software"):
        raise RigError('trigger.driver and camera.trigger must both be "software", or neither')
    if settings.trigger.strobe and not trigger.limits.counts_strobes:
        raise RigError(f"{trigger.identity} counts no exposures: leave trigger.strobe away")
    if settings.trigger.vsync and not trigger.limits.counts_vsyncs:
        raise RigError(f"{trigger.identity} counts no pictures: leave trigger.vsync away")
    if projector.alternating and timing.frames < 2:
        raise RigError("alternating pictures are distinguished by two frames or more: make timing.frames 2 or more")
    if projector.alternating and timing.camera_delay_s < timing.projector_delay_s:
        raise RigError("the camera would expose before the projector's pulse: make timing.camera_delay_s longer")
