"""Pulses made by this program: for cameras without a trigger line, and to try a camera without a trigger source."""

import threading
import time
from contextlib import suppress

from hardware.errors import CameraError, TriggerError
from hardware.protocols import Camera, Identity, Strobe, TriggerStatus
from hardware.pulses import PulseTrain, TriggerLimits, fitted

_LIMITS = TriggerLimits(
    tick_s=1e-6,
    min_period_s=1e-3,
    max_period_s=2000.0,
    min_width_s=1e-6,
    min_gap_s=0.0,
    max_count=2**31 - 1,
    counts_strobes=False,
    counts_vsyncs=False,
    jitter_s=10e-3,  # what an operating system and a camera's driver take, mostly
)
# A camera answers a command within this; see `Camera`.
_STOP_S = 5.0


class SoftwareTrigger:
    """Trigger a camera by software, once per period; a `Trigger`. Nothing reaches the projector.

    Its times are those of the command, some milliseconds before the camera exposes.

    Parameters
    ----------
    camera : Camera
        One that is set to be triggered by software.
    """

    def __init__(self, camera: Camera) -> None:
        self.identity = Identity("colorphase", "software trigger")
        self.limits = _LIMITS
        self._camera = camera
        self._train: PulseTrain | None = None
        self._thread: threading.Thread | None = None
        self._stopped = threading.Event()
        self._pulses = 0
        self._complaints: tuple[str, ...] = ()

    def configure(self, train: PulseTrain) -> PulseTrain:
        """Set a burst up; see `Trigger`."""
        self._stop()
        self._train = fitted(train, self.limits)
        return self._train

    def arm(self) -> None:
        """Get ready; see `Trigger`."""
        self._stop()
        self._pulses = 0
        self._complaints = ()

    def fire(self) -> None:
        """Start the burst; see `Trigger`."""
        if self._train is None:
            raise TriggerError("the software trigger has no burst to make: configure it first")
        self._stopped.clear()
        self._thread = threading.Thread(target=self._run, args=(self._train,), name="software trigger", daemon=True)
        self._thread.start()

    def status(self) -> TriggerStatus:
        """Return what became of the burst; see `Trigger`."""
        running = self._thread is not None and self._thread.is_alive()
        return TriggerStatus(running, self._pulses, complaints=self._complaints)

    def strobes(self) -> tuple[Strobe, ...]:
        """Return nothing: no exposure output is wired to a program."""
        return ()

    def abort(self) -> None:
        """Stop; see `Trigger`."""
        self._stop()

    def close(self) -> None:
        """Stop; see `Trigger`."""
        with suppress(TriggerError):
            self._stop()  # and wait: the camera may be closed next

    def _stop(self) -> None:
        if self._thread is not None:
            self._stopped.set()
            self._thread.join(_STOP_S)
            if self._thread.is_alive():
                raise TriggerError(f"{self._camera.identity} does not answer: connect it again")
            self._thread = None

    def _run(self, train: PulseTrain) -> None:
        started_s = time.monotonic()
        pulse = 0
        while train.count is None or pulse < train.count:
            wait_s = started_s + pulse * train.period_s + train.camera.delay_s - time.monotonic()
            if self._stopped.wait(max(0.0, wait_s)):
                return
            if wait_s < -train.period_s / 2:
                late = f"pulse {pulse} came {-wait_s:.3f} s late"
                self._complaints = (f"{late}: the machine or the camera is too slow; make the period longer",)
                return
            try:
                self._camera.trigger()
            except CameraError as error:
                self._complaints = (str(error),)
                return
            pulse += 1
            self._pulses = pulse
