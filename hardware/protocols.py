"""What the rig asks of its instruments: whatever has these methods can take part."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
import numpy.typing as npt

from hardware.pulses import PulseTrain, TriggerLimits

Levels = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]


@dataclass(frozen=True)
class Identity:
    """What an instrument says it is."""

    maker: str
    model: str
    serial: str = ""
    firmware: str = ""

    def __str__(self) -> str:
        return " ".join(part for part in (self.maker, self.model, self.serial, self.firmware) if part)


@dataclass(frozen=True)
class TriggerStatus:
    """What a trigger source says of the burst that was fired last; None: it does not count that."""

    running: bool
    pulses: int | None = None  # camera pulses that were begun
    strobes: int | None = None  # exposures that the camera reported back
    vsyncs: int | None = None  # pictures that the projector reported back
    boot: int | None = None  # another number after every restart
    complaints: tuple[str, ...] = ()  # what it found wrong since it was armed, a sentence each
    clock_ppm: float | None = None  # by how much its clock is faster than this machine's; None: not known, or not yet


@dataclass(frozen=True)
class Strobe:
    """An exposure that the camera reported back to the trigger source."""

    pulse: int  # the camera pulse that it followed, from 0
    time_s: float  # from the start of the burst, by the trigger source's clock


class Trigger(Protocol):
    """A source of numbered pulses. Every method returns or raises TriggerError within a deadline of seconds."""

    @property
    def identity(self) -> Identity:
        """What was found when it was opened."""

    @property
    def limits(self) -> TriggerLimits:
        """What it can do."""

    def configure(self, train: PulseTrain) -> PulseTrain:
        """Set the burst up, outputs low; return it as it will be, rounded to the tick. RigError: it is impossible."""

    def arm(self) -> None:
        """Get ready: counters at zero, and what was configured still there."""

    def fire(self) -> None:
        """Start the burst. Never sent twice: where the answer is lost, the status tells."""

    def status(self) -> TriggerStatus:
        """Return what became of the burst; harmless at any time."""

    def strobes(self) -> tuple[Strobe, ...]:
        """Return the exposures of the last burst that were not returned yet; what it has forgotten is missing."""

    def abort(self) -> None:
        """Stop, outputs low; harmless at any time."""

    def close(self) -> None:
        """Stop and let go of the port; idempotent, and never raises."""


@dataclass(frozen=True)
class FrameFormat:
    """How a camera's frames come: RGB as (H, W, 3), or a Bayer mosaic as (H, W); uint8 up to 8 bits, else uint16."""

    layout: Literal["rgb", "bayer"]
    bits: int = 8  # full scale is 2 ** bits - 1
    bayer: Literal["rggb", "bggr", "grbg", "gbrg"] | None = None  # the first two pixels of the first two rows


@dataclass(frozen=True)
class SensorPart:
    """The part of its sensor that a camera reads out; with its size, which is that of the frames."""

    sensor_px: tuple[int, int]  # width and height of the sensor
    offset_px: tuple[int, int]  # first column and row that are read out, of the sensor
    binning: tuple[int, int]  # columns and rows of the sensor that make one of the frame


@dataclass(frozen=True)
class CameraLimits:
    """What a camera can do as it is set up."""

    size_px: tuple[int, int]
    format: FrameFormat
    exposure_s: tuple[float, float]  # shortest and longest
    min_period_s: float  # of frames at the present exposure, readout included
    triggered: bool  # False: it takes frames when told to by software, some time later
    sensor: SensorPart | None = None  # None: the camera does not say


@dataclass(frozen=True)
class CameraFrame:
    """One frame as it arrived."""

    image: Levels | None  # nobody else writes to it; None: it is not whole
    host_time_s: float  # time.monotonic() when it arrived
    frame_id: int | None = None  # the camera's number, counting on where it wraps; None: it has none
    device_time_s: float | None = None  # by the camera's clock; None: it has none
    temperature_c: float | None = None  # of the sensor, where it is told
    triggers: int | None = None  # the camera's count of triggers, also of those it ignored, from when it was armed
    fault: str | None = None  # why it is not whole


class Camera(Protocol):
    """A camera, opened and set up. Every method returns or raises CameraError within a deadline of seconds."""

    @property
    def identity(self) -> Identity:
        """What was found when it was opened."""

    @property
    def limits(self) -> CameraLimits:
        """What it can do as it is set up."""

    @property
    def exposure_s(self) -> float:
        """The exposure as read back."""

    @property
    def unlocked(self) -> tuple[str, ...]:
        """What it may still change by itself, or what could not be read back, a sentence each."""

    def arm(self, count: int | None) -> None:
        """Get ready for `count` triggers (None: until disarmed), queues empty; return when it takes them."""

    def frame(self, timeout_s: float) -> CameraFrame | None:
        """Return the next frame in the order of their arrival, whole or not; None: none came in time."""

    def trigger(self) -> None:
        """Take one frame now; only where the settings say trigger = "software"."""

    def disarm(self) -> None:
        """Stop; harmless at any time."""

    def close(self) -> None:
        """Stop and let go of the camera; idempotent, and never raises."""


PowerState = Literal["off", "warming up", "on", "cooling down"]


@dataclass(frozen=True)
class ProjectorStatus:
    """What a projector says of itself; None: it does not tell, or not while it is off."""

    power: PowerState | None
    input: str | None = None  # as its manual numbers them
    blank: bool | None = None
    faults: tuple[str, ...] | None = None  # as "lamp: warning"
    lamp_hours: tuple[int, ...] | None = None  # one a lamp; empty: it has none


class Projector(Protocol):
    """What switches a projector. Every method but `power` returns or raises ProjectorError within seconds."""

    @property
    def identity(self) -> Identity:
        """What was found when it was opened."""

    def power(self, on: bool, tell: Callable[[str], None]) -> bool:
        """Switch it on or off and wait until it is, which may take minutes; `tell` hears what it is doing.

        False: the command is sent, but this projector does not tell whether it is on.
        """

    def input(self, source: str) -> None:
        """Choose what it shows, as its manual numbers them."""

    def blank(self, on: bool) -> None:
        """Show black, or the picture again."""

    def status(self) -> ProjectorStatus:
        """Ask it how it is."""

    def close(self) -> None:
        """Let go of it and leave it as it is; idempotent, and never raises."""
