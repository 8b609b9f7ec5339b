"""Interfaces of the rig's instruments: whatever has these methods can take part."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
import numpy.typing as npt

from hardware.pulses import PulseTrain, TriggerLimits

Levels = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]


@dataclass(frozen=True)
class Identity:
    """Maker, model, serial number and firmware that an instrument reports."""

    maker: str
    model: str
    serial: str = ""
    firmware: str = ""

    def __str__(self) -> str:
        return " ".join(part for part in (self.maker, self.model, self.serial, self.firmware) if part)


@dataclass(frozen=True)
class TriggerStatus:
    """A trigger source's report on the burst that was fired last; None: it does not count that."""

    running: bool
    pulses: int | None = None  # camera pulses that were begun
    strobes: int | None = None  # exposures that the camera reported back
    vsyncs: int | None = None  # pictures that the projector reported back
    boot: int | None = None  # another number after every restart
    complaints: tuple[str, ...] = ()  # what it found wrong since it was armed, one sentence each
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
        """Identity found when it was opened."""

    @property
    def limits(self) -> TriggerLimits:
        """Limits of its pulses."""

    def configure(self, train: PulseTrain) -> PulseTrain:
        """Set the burst up, outputs low; return it as it will be, rounded to the tick. RigError: it is impossible."""

    def arm(self) -> None:
        """Get ready: counters at zero, and what was configured still there."""

    def fire(self) -> None:
        """Start the burst. Never sent twice: where the answer is lost, the status shows whether it started."""

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
    """Format of a camera's frames: RGB as (H, W, 3), or a Bayer mosaic as (H, W); uint8 up to 8 bits, else uint16."""

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
    """Limits of a camera as it is set up."""

    size_px: tuple[int, int]
    format: FrameFormat
    exposure_s: tuple[float, float]  # shortest and longest
    min_period_s: float  # of frames at the present exposure, readout included
    triggered: bool  # False: it takes frames by software command, some time later
    sensor: SensorPart | None = None  # None: the camera does not report it


@dataclass(frozen=True)
class CameraFrame:
    """One frame as it arrived."""

    image: Levels | None  # nobody else writes to it; None: it is not whole
    host_time_s: float  # time.monotonic() when it arrived
    frame_id: int | None = None  # the camera's number, counting on where it wraps; None: it has none
    device_time_s: float | None = None  # by the camera's clock; None: it has none
    temperature_c: float | None = None  # of the sensor, where it is reported
    triggers: int | None = None  # the camera's count of triggers, also of those it ignored, from when it was armed
    fault: str | None = None  # why it is not whole


class Camera(Protocol):
    """A camera, opened and set up. Every method returns or raises CameraError within a deadline of seconds."""

    @property
    def identity(self) -> Identity:
        """Identity found when it was opened."""

    @property
    def limits(self) -> CameraLimits:
        """Limits as it is set up."""

    @property
    def exposure_s(self) -> float:
        """The exposure as read back."""

    @property
    def unlocked(self) -> tuple[str, ...]:
        """Settings that it may still change by itself, or that could not be read back, one sentence each."""

    def arm(self, count: int | None) -> None:
        """Get ready for `count` triggers (None: until disarmed), queues empty; return when it takes them."""

    def frame(self, timeout_s: float) -> CameraFrame | None:
        """Return the next frame in the order of their arrival, whole or not; None: none came in time."""

    def trigger(self) -> None:
        """Take one frame now; only with trigger = "software" in the settings."""

    def disarm(self) -> None:
        """Stop; harmless at any time."""

    def close(self) -> None:
        """Stop and let go of the camera; idempotent, and never raises."""


PowerState = Literal["off", "warming up", "on", "cooling down"]


@dataclass(frozen=True)
class ProjectorStatus:
    """State that a projector reports; None: it does not report it, or not while it is off."""

    power: PowerState | None
    input: str | None = None  # as its manual numbers them
    blank: bool | None = None
    faults: tuple[str, ...] | None = None  # as "lamp: warning"
    lamp_hours: tuple[int, ...] | None = None  # one per lamp; empty: it has none


class Projector(Protocol):
    """A projector's remote control. Every method but `power` returns or raises ProjectorError within seconds."""

    @property
    def identity(self) -> Identity:
        """Identity found when it was opened."""

    def power(self, on: bool, notify: Callable[[str], None]) -> bool:
        """Switch it on or off and wait until it is, which may take minutes; `notify` is called with what it is doing.

        False: the command is sent, but this projector does not report whether it is on.
        """

    def input(self, source: str) -> None:
        """Choose what it shows, as its manual numbers them."""

    def blank(self, on: bool) -> None:
        """Show black, or the picture again."""

    def status(self) -> ProjectorStatus:
        """Ask it how it is."""

    def close(self) -> None:
        """Let go of it and leave it as it is; idempotent, and never raises."""
