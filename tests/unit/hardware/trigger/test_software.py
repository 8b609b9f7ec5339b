import threading
import time

from hardware.protocols import Identity
from hardware.pulses import Pulse, PulseTrain
from hardware.trigger.software import SoftwareTrigger


class SlowCamera:
    """A camera that takes a while to answer."""

    identity = Identity("slow", "camera")

    def __init__(self) -> None:
        self.asked = threading.Event()
        self.busy = False

    def trigger(self) -> None:
        """Take one frame."""
        self.busy = True
        self.asked.set()
        time.sleep(0.1)
        self.busy = False


def test_a_camera_is_not_spoken_to_once_its_trigger_is_closed():
    """It is closed next, and a camera that is being triggered meanwhile may crash in its maker's library."""
    camera = SlowCamera()
    trigger = SoftwareTrigger(camera)
    trigger.configure(PulseTrain(0.2, 3, Pulse(0, 1e-4), Pulse(0, 1e-4)))
    trigger.arm()
    trigger.fire()
    assert camera.asked.wait(5)
    trigger.close()
    assert not camera.busy
    trigger.close()
