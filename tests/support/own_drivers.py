"""Drivers as users write them: a camera and a trigger source that are wired to each other, and a projector."""

#: The text of their module.
DRIVERS = """
from hardware.errors import CameraError
from hardware.protocols import FrameFormat
from hardware.simulated import MemoryCamera, SimulatedTrigger
import numpy as np

WIRES = []

class OwnCamera(MemoryCamera):
    def __init__(self, settings):
        if settings.serial == "absent":
            raise CameraError("no camera of that number: connect it")
        noise = np.random.default_rng(0)
        def expose(time_s):
            return noise.integers(0, 255, (4, 6, 3), np.uint8)
        super().__init__(expose, (6, 4), FrameFormat("rgb"), settings.exposure_s)
        WIRES[-1].camera = self.pulse

def open_own_trigger(settings):
    trigger = SimulatedTrigger()
    WIRES.append(trigger)
    return trigger

class OwnProjector:
    identity = None
    def __init__(self, settings): pass
    def power(self, on, notify): return True
    def input(self, source): pass
    def blank(self, on): pass
    def status(self): raise RuntimeError
    def close(self): pass
"""
