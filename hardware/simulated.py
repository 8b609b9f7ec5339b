"""A rig on a laptop with nothing attached: trigger source, projector and camera that react to pulses.

They are wired by calls: the trigger source's outputs call the projector and the camera, whose exposure output calls the
trigger source back. To see what a broken cable does, put something between the ends of its wire.
"""

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hardware.alternating_pictures import DIM
from hardware.errors import CameraError, TriggerError
from hardware.protocols import (
    CameraFrame,
    CameraLimits,
    FrameFormat,
    Identity,
    Levels,
    Strobe,
    TriggerStatus,
)
from hardware.pulses import PulseTrain, TriggerLimits, fitted
from hardware.settings import RigSettings

#: What a pulse calls, with its time by the trigger source's clock, from when it was switched on.
Wire = Callable[[float], None]

# As our trigger box.
_TRIGGER_LIMITS = TriggerLimits(
    tick_s=0.5e-6,
    min_period_s=100e-6,
    max_period_s=2000.0,
    min_width_s=50e-6,
    min_gap_s=50e-6,
    max_count=2**32 - 1,
    counts_strobes=True,
    counts_vsyncs=True,
)
# Of a camera with a global shutter that reads out 480 rows.
_READOUT_S = 2e-3
# Frames that wait in the camera's driver to be taken; those that find it full are lost, as they are in real ones.
_BUFFERS = 128
_NOTHING_SET_UP = "the simulated trigger has no burst to make: configure it first"
# How long a thread may take to stop.
_STOP_S = 5.0


# What is seen where nobody renders a scene: fringes of this many px per cycle, dimmer in picture 1.
_SIZE_PX = (640, 480)
_PERIOD_PX = 16.0


class SimulatedTrigger:
    """A trigger source whose pulses are calls, at the right time; a `Trigger`."""

    def __init__(self) -> None:
        self.identity = Identity("colorphase", "simulated trigger")
        self.limits = _TRIGGER_LIMITS
        self.projector: Wire = lambda time_s: None
        self.camera: Wire = lambda time_s: None
        self._switched_on_s = time.monotonic()
        self._train: PulseTrain | None = None
        self._thread: threading.Thread | None = None
        self._stopped = threading.Event()
        self._pulses = 0
        self._started_s = 0.0  # of the burst, by its own clock
        self._log: deque[Strobe] = deque()
        self._strobes = self._vsyncs = 0

    def configure(self, train: PulseTrain) -> PulseTrain:
        """Set a burst up; see `Trigger`."""
        self._stop()
        self._train = fitted(train, self.limits)
        return self._train

    def arm(self) -> None:
        """Get ready; see `Trigger`."""
        if self._train is None:
            raise TriggerError(_NOTHING_SET_UP)
        self._stop()
        self._pulses = 0
        self._log.clear()
        self._strobes = self._vsyncs = 0

    def fire(self) -> None:
        """Start the burst; see `Trigger`."""
        if self._train is None:
            raise TriggerError(_NOTHING_SET_UP)
        self._stopped.clear()
        self._started_s = time.monotonic() - self._switched_on_s
        self._thread = threading.Thread(target=self._run, args=(self._train,), name="simulated trigger", daemon=True)
        self._thread.start()

    def status(self) -> TriggerStatus:
        """Return what became of the burst; see `Trigger`."""
        running = self._thread is not None and self._thread.is_alive()
        return TriggerStatus(running, self._pulses, self._strobes, self._vsyncs, boot=1)

    def strobes(self) -> tuple[Strobe, ...]:
        """Return the exposures of the last burst; see `Trigger`."""
        found = []
        while self._log:
            found.append(self._log.popleft())
        return tuple(found)

    def abort(self) -> None:
        """Stop; see `Trigger`."""
        self._stop()

    def close(self) -> None:
        """Stop; see `Trigger`."""
        self._stop()

    def _stop(self) -> None:
        if self._thread is not None:
            self._stopped.set()
            self._thread.join(_STOP_S)
            self._thread = None

    def strobe(self, time_s: float) -> None:
        """Take an exposure that the camera reports."""
        self._strobes += 1
        self._log.append(Strobe(self._pulses - 1, time_s - self._started_s))

    def vsync(self, time_s: float) -> None:
        """Take a picture that the projector reports."""
        self._vsyncs += 1

    def _run(self, train: PulseTrain) -> None:
        pulse = 0
        outputs = sorted(((train.projector.delay_s, "projector"), (train.camera.delay_s, "camera")), reverse=True)
        while train.count is None or pulse < train.count:
            waiting = list(outputs)
            while waiting:
                delay_s, name = waiting.pop()
                # The times are those of a clock that keeps them; only the calls come as late as this machine is busy.
                time_s = self._started_s + pulse * train.period_s + delay_s
                if self._stopped.wait(max(0.0, time_s + self._switched_on_s - time.monotonic())):
                    return
                if name == "camera":
                    self._pulses = pulse + 1
                getattr(self, name)(time_s)
            pulse += 1


class SimulatedProjector:
    """A projector that shows the other of two pictures at every pulse."""

    def __init__(self) -> None:
        self.picture = 0
        self.sync: Wire = lambda time_s: None

    def pulse(self, time_s: float) -> None:
        """Show the other picture."""
        self.picture = 1 - self.picture
        self.sync(time_s)


class MemoryCamera:
    """A camera whose exposures are calls; a `Camera`.

    Parameters
    ----------
    expose : callable
        Return what it sees, at a time in s: the frame, which it does not write to again.
    size_px : (width, height)
        Of these frames.
    format : FrameFormat
        Theirs.
    exposure_s, readout_s : float
        Time in which it cannot be triggered again; a pulse that comes before is lost unnoticed, as with real ones.
    strobe : callable
        Its exposure output.
    """

    def __init__(
        self,
        expose: Callable[[float], Levels],
        size_px: tuple[int, int],
        format: FrameFormat,
        exposure_s: float,
        readout_s: float = _READOUT_S,
        strobe: Wire = lambda time_s: None,
    ) -> None:
        self.identity = Identity("colorphase", "simulated camera")
        self.limits = CameraLimits(size_px, format, (10e-6, 10.0), exposure_s + readout_s, triggered=True)
        self.exposure_s = exposure_s
        self.unlocked: tuple[str, ...] = ()
        self.strobe = strobe
        self._expose = expose
        self._arrived: deque[CameraFrame] = deque()
        self._changed = threading.Condition()
        self._armed = False
        self._room = _BUFFERS
        self._next_id = 0
        self._busy_until_s = 0.0

    def arm(self, count: int | None) -> None:
        """Get ready; see `Camera`."""
        with self._changed:
            self._arrived.clear()
            self._room = max(count or 0, _BUFFERS)
            self._busy_until_s = 0.0
            self._armed = True

    def pulse(self, time_s: float) -> None:
        """Expose, as a pulse at the trigger input makes it."""
        if not self._armed or time_s < self._busy_until_s:
            return
        self._busy_until_s = time_s + self.limits.min_period_s
        self.strobe(time_s)
        self.deliver(CameraFrame(self._expose(time_s), self._arrival_s(), self._next_id, time_s))
        self._next_id += 1

    def deliver(self, frame: CameraFrame) -> None:
        """Send a frame on its way to the computer."""
        with self._changed:
            if len(self._arrived) < self._room:
                self._arrived.append(frame)
                self._changed.notify()

    def frame(self, timeout_s: float) -> CameraFrame | None:
        """Return the next frame; see `Camera`."""
        deadline = time.monotonic() + timeout_s
        with self._changed:
            while (now_s := time.monotonic()) < deadline or self._arrived:
                if not self._arrived:
                    self._changed.wait(deadline - now_s)
                elif self._arrived[0].host_time_s <= now_s:
                    return self._arrived.popleft()
                elif self._arrived[0].host_time_s >= deadline:
                    return None
                else:
                    self._changed.wait(self._arrived[0].host_time_s - now_s)
        return None

    def trigger(self) -> None:
        """Refuse; see `Camera`."""
        raise CameraError('the simulated camera is triggered by pulses: set camera.trigger to another than "software"')

    def disarm(self) -> None:
        """Stop; see `Camera`."""
        self._armed = False

    def close(self) -> None:
        """Stop; see `Camera`."""
        self._armed = False

    def _arrival_s(self) -> float:
        return time.monotonic() + self.limits.min_period_s


@dataclass(frozen=True)
class SimulatedInstruments:
    """A trigger source, a projector and a camera, wired as in a real rig."""

    trigger: SimulatedTrigger
    projector: SimulatedProjector
    camera: MemoryCamera

    @classmethod
    def wired(
        cls,
        render: Callable[[int, float], Levels],
        size_px: tuple[int, int],
        format: FrameFormat,
        settings: RigSettings,
    ) -> "SimulatedInstruments":
        """Return them wired.

        Parameters
        ----------
        render : callable
            Return the frame under picture 0 or 1 at a time in s; nobody writes to it again.
        size_px : (width, height)
            Of these frames.
        format : FrameFormat
            Theirs.
        settings : RigSettings
            The exposure, and which outputs of camera and projector are wired back.
        """
        trigger, projector = SimulatedTrigger(), SimulatedProjector()
        camera = MemoryCamera(
            lambda time_s: render(projector.picture, time_s), size_px, format, settings.camera.exposure_s
        )
        trigger.projector, trigger.camera = projector.pulse, camera.pulse
        if settings.trigger.strobe:
            camera.strobe = trigger.strobe
        if settings.trigger.vsync:
            projector.sync = trigger.vsync
        return cls(trigger, projector, camera)

    @classmethod
    def before_a_wall(cls, settings: RigSettings) -> "SimulatedInstruments":
        """Return them wired, the camera seeing a flat white wall under the pattern."""
        width, height = settings.camera.size_px or _SIZE_PX
        cycles = np.arange(height)[:, None, None] / _PERIOD_PX + np.array([-1, 0, 1]) / 3
        light = np.broadcast_to(0.5 + 0.4 * np.cos(2 * np.pi * cycles), (height, width, 3))
        frames = [np.rint(255 * brightness * light).astype(np.uint8) for brightness in (1.0, DIM)]
        return cls.wired(lambda picture, time_s: frames[picture], (width, height), FrameFormat("rgb"), settings)
