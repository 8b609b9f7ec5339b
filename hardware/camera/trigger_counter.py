"""A camera's own count of its triggers, put into every frame as GenICam's chunk data, by the names of the SFNC.

The counter counts edges at the trigger's line, also those that the camera ignores because it is still busy: what a
frame's number does not show. An edge that never reaches the line is not counted.
"""

from contextlib import suppress

from hardware.camera.genicam import Features, each, require
from hardware.errors import CameraError

# The chunk, and the feature that it is read by: SFNC's, and older network cameras of Basler.
_CHUNKS = {"CounterValue": "ChunkCounterValue", "Triggerinputcounter": "ChunkTriggerinputcounter"}
# What Basler's cameras call the trigger of a frame, taken or ignored, where a line cannot be counted.
_FRAME_TRIGGER = "FrameTrigger"


class TriggerCounter:
    """The counter of a camera that was set up, where it has one that can be set to zero.

    Parameters
    ----------
    features : Features
        The camera's.
    line : str
        The trigger's line, or "software".
    """

    def __init__(self, features: Features, line: str) -> None:
        self._features = features
        self._counter: str | None = None
        #: The feature of a frame's chunk data that holds the count; None: there is none.
        self.chunk: str | None = None
        if line == "software" or not features.has("ChunkModeActive"):
            return
        try:
            self._count(line)
        except CameraError:  # it can do without
            self.chunk = None
        if self.chunk is None:
            with suppress(CameraError):
                features.set("ChunkModeActive", False)

    def start(self) -> None:
        """Count from zero."""
        if self.chunk is not None:
            if self._counter is not None:
                self._features.set("CounterSelector", self._counter)
            self._features.execute("CounterReset")

    def _count(self, line: str) -> None:
        features = self._features
        for counter in each(features, "CounterSelector"):
            if not features.has("CounterEventSource"):
                return
            sources = [source for source in (line, _FRAME_TRIGGER) if source in features.options("CounterEventSource")]
            if not sources:
                continue
            require(features, "CounterEventSource", sources[0])
            if features.has("CounterEventActivation") and "RisingEdge" in features.options("CounterEventActivation"):
                require(features, "CounterEventActivation", "RisingEdge")
            if features.has("CounterTriggerSource"):
                require(features, "CounterTriggerSource", "Off")
            # A counter ends after so many, and begins anew.
            if features.has("CounterDuration"):
                features.set("CounterDuration", int(features.bounds("CounterDuration")[1]))
            if features.has("CounterResetSource") and "Software" in features.options("CounterResetSource"):
                require(features, "CounterResetSource", "Software")
            if not features.has("CounterReset"):
                return
            self._counter = counter if features.has("CounterSelector") else None
            self._put_into_frames()
            return

    def _put_into_frames(self) -> None:
        features = self._features
        features.set("ChunkModeActive", True)
        if not features.has("ChunkSelector"):
            return
        chunk = next((chunk for chunk in _CHUNKS if chunk in features.options("ChunkSelector")), None)
        if chunk is None:
            return
        features.set("ChunkSelector", chunk)
        require(features, "ChunkEnable", True)
        selector = "ChunkCounterSelector"
        if self._counter is not None and features.has(selector) and self._counter in features.options(selector):
            require(features, selector, self._counter)
        self.chunk = _CHUNKS[chunk]
