"""A rig in virtual time, written without a look at the simulated one: thousands of bursts in seconds, any fault.

Its frames carry the truth: the run of pulses and the pulse that exposed them; None: something else did.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hardware.protocols import Camera, CameraFrame, CameraLimits, FrameFormat, Identity, Strobe, Trigger, TriggerStatus
from hardware.pulses import PulseTrain, TriggerLimits, fitted
from hardware.rig import Burst
from hardware.settings import RigSettings

PERIOD_S, FRAMES = 0.02, 6
EXPOSURE_S, READOUT_S, TRANSPORT_S = 5e-3, 3e-3, 1e-3
JITTER_S = 10e-3  # of pulses that a program makes


@dataclass(frozen=True)
class Faults:
    """What goes wrong in one run of pulses."""

    lost_trigger: tuple[int, ...] = ()
    noise: tuple[tuple[int, float], ...] = ()  # pulse, and how many periods later a trigger comes that nobody sent
    lost_frame: tuple[int, ...] = ()
    repeated_frame: tuple[int, ...] = ()
    lost_strobe: tuple[int, ...] = ()
    lost_picture: tuple[int, ...] = ()  # the projector does not get its pulse
    slow_line: tuple[tuple[int, float], ...] = ()  # pulse from which on frames are late, and by how many seconds
    late_s: float = 0.0  # all frames
    slow_start: tuple[float, float] = (0.0, 0.0)  # how much longer the start command takes, and its confirmation, in s
    stale_frame: bool = False  # the last run's last frame comes once more
    cable_out: int | None = None  # the camera's trigger cable, from this pulse on
    strobe_out: bool = False

    @property
    def harmless(self) -> bool:
        """Whether every frame can still be had."""
        return replace(self, repeated_frame=(), slow_line=(), late_s=0.0, slow_start=(0.0, 0.0)) == Faults()


@dataclass(frozen=True)
class Instruments:
    """What the trigger source, the camera and the projector of a rig tell."""

    strobe: bool = True  # exposures are counted
    clock: bool = True  # the camera's frames have times
    numbers: bool = True  # and numbers
    counter: bool = False  # and the camera's count of triggers
    starts_anew: bool = False  # numbers and times begin anew whenever the camera is armed
    counts_pulses: bool = True
    by_software: bool = False
    vsync: bool = False  # the projector reports its pictures
    alternating: bool = False  # it shows two in turns
    start_s: tuple[float, float] = (5e-4, 5e-4)  # the start command takes this at least, and its confirmation


@dataclass(frozen=True)
class TrueFrame(CameraFrame):
    """A frame that knows what exposed it."""

    truth: tuple[int, int | None] = (0, None)
    is_new: bool = True  # it shows the picture of its own pulse


class VirtualRig:
    """Trigger source and camera that live in a clock of their own, which is to stand in for `hardware.rig.time`."""

    def __init__(
        self,
        next_faults: Callable[[], Faults] = Faults,
        *,
        instruments: Instruments | None = None,
        strobe: bool = True,
        clock: bool = True,
        period_s: float = PERIOD_S,
        frames: int = FRAMES,
        trigger_ppm: float = 0.0,
        seed: int = 0,
    ) -> None:
        self.has = instruments or Instruments(strobe=strobe, clock=clock)
        self.period_s = period_s
        self.exposure_s, self.readout_s = EXPOSURE_S / PERIOD_S * period_s, READOUT_S / PERIOD_S * period_s
        self.settings = RigSettings.model_validate(
            {
                "trigger": {
                    "driver": "software" if self.has.by_software else "simulated",
                    "strobe": self.has.strobe,
                    "vsync": "per-pulse" if self.has.vsync else None,
                },
                "timing": {"period_s": period_s, "frames": frames, "camera_delay_s": period_s / 20},
                "camera": {
                    "driver": "simulated",
                    "exposure_s": self.exposure_s,
                    "trigger": "software" if self.has.by_software else "Line1",
                },
                "projector": {"alternating": self.has.alternating},
            }
        )
        self.now_s = 1000.0
        self.run = -1
        self.next_faults = next_faults
        self.faults = Faults()
        self.random = np.random.default_rng(seed)
        self.slower = 1 + 1e-6 * trigger_ppm
        self.train: PulseTrain | None = None
        self.started_s: float | None = None  # None: no pulses run
        self.pulses = self.strobes = self.vsyncs = self.pictures = 0
        self.picture_is_new = False
        self.log: list[Strobe] = []
        self.queue: list[TrueFrame] = []
        self.last: TrueFrame | None = None
        self.frame_id = self.triggers = 0
        self.zero_s = 0.0  # of the camera's clock
        self.busy_until_s = self.arrived_s = 0.0

    def monotonic(self) -> float:
        """Return the time, which goes on a little."""
        self.now_s += 2e-6
        return self.now_s

    def sleep(self, seconds: float) -> None:
        """Let time pass."""
        self.now_s += seconds

    def open(self) -> tuple[Trigger, Camera]:
        """Connect both."""
        return VirtualTrigger(self), VirtualCamera(self)

    def mispaired(self, burst: Burst) -> int:
        """Return how many frames another pulse made than the one they are stored with."""
        pictures_told = self.has.vsync or self.has.alternating
        return sum(
            paired.frame.truth != (self.run, paired.pulse) or (pictures_told and not paired.frame.is_new)
            for paired in burst.frames
        )

    def next_event_s(self) -> float:
        """Return when the next pulse exposes, or the burst ends."""
        if self.started_s is None or self.train is None:
            return np.inf
        over = self.pulses == self.train.count
        return self.started_s + self.pulses * self.period_s * self.slower + (0.0 if over else self.train.camera.delay_s)

    def go_on(self) -> None:
        """Do what is due by now."""
        while (due_s := self.next_event_s()) <= self.now_s:
            assert self.train is not None
            if self.pulses == self.train.count:
                self.started_s = None
                return
            pulse = self.pulses
            self.pulses += 1
            self.picture_is_new = pulse not in self.faults.lost_picture
            self.pictures += self.picture_is_new
            self.vsyncs += self.picture_is_new
            due_s += self.random.uniform(0.0, JITTER_S) if self.has.by_software else 0.0
            is_out = self.faults.cable_out is not None and pulse >= self.faults.cable_out
            if pulse not in self.faults.lost_trigger and not is_out:
                self.expose(due_s, pulse, pulse)
            for after, periods in self.faults.noise:
                if after == pulse:
                    self.expose(due_s + periods * self.period_s, None, pulse)

    def expose(self, time_s: float, cause: int | None, after: int) -> None:
        """Do as the camera at a trigger."""
        assert self.started_s is not None
        self.triggers += 1
        if time_s < self.busy_until_s:
            return
        self.busy_until_s = time_s + self.exposure_s + self.readout_s
        if after not in self.faults.lost_strobe and not self.faults.strobe_out:
            self.strobes += 1
            self.log.append(Strobe(after, (time_s - self.started_s) / self.slower))
        arrives_s = self.busy_until_s + TRANSPORT_S + self.random.exponential(2e-4) + self.faults.late_s
        for first, wait_s in self.faults.slow_line:
            if 0 <= arrives_s - self.started_s - first * self.period_s <= wait_s:
                arrives_s = self.started_s + first * self.period_s + wait_s
        self.arrived_s = arrives_s = max(arrives_s, self.arrived_s)
        image = self.random.integers(97, 104, (8, 8, 3), dtype=np.uint8)
        image -= np.uint8(15 * (self.has.alternating and self.pictures % 2))
        self.last = TrueFrame(
            image,
            arrives_s,
            self.frame_id if self.has.numbers else None,
            time_s - self.zero_s if self.has.clock else None,
            triggers=self.triggers if self.has.counter else None,
            truth=(self.run, cause),
            is_new=self.picture_is_new,
        )
        self.frame_id += 1
        if cause is None or after not in self.faults.lost_frame:
            self.queue += [self.last] * (1 + (after in self.faults.repeated_frame))


class VirtualTrigger:
    """A `Trigger`."""

    def __init__(self, rig: VirtualRig) -> None:
        self._rig = rig
        self.identity = Identity("virtual", "trigger")
        jitter_s = JITTER_S if rig.has.by_software else 0.0
        self.limits = TriggerLimits(0.5e-6, 1e-4, 2000.0, 5e-5, 5e-5, 2**32 - 1, True, True, jitter_s)

    def configure(self, train: PulseTrain) -> PulseTrain:
        """See `Trigger`."""
        self._rig.train = fitted(train, self.limits)
        return self._rig.train

    def arm(self) -> None:
        """See `Trigger`."""
        self._rig.started_s = None
        self._rig.pulses = self._rig.strobes = self._rig.vsyncs = 0
        self._rig.log = []

    def fire(self) -> None:
        """See `Trigger`: some time before and behind it."""
        rig = self._rig
        rig.run += 1
        rig.faults = rig.next_faults()
        (command_s, confirmed_s), (held_s, held_back_s) = rig.has.start_s, rig.faults.slow_start
        rig.now_s += command_s + rig.random.uniform(0.0, 1.5e-3) + held_s
        rig.started_s = rig.now_s
        rig.now_s += confirmed_s + rig.random.uniform(0.0, 1.5e-3) + held_back_s
        if rig.faults.stale_frame and rig.last is not None:
            rig.arrived_s = rig.now_s + rig.exposure_s + rig.readout_s
            rig.queue.append(replace(rig.last, host_time_s=rig.arrived_s))

    def status(self) -> TriggerStatus:
        """See `Trigger`."""
        self._rig.now_s += 1e-3
        rig = self._rig
        rig.go_on()
        return TriggerStatus(
            rig.started_s is not None,
            rig.pulses if rig.has.counts_pulses else None,
            rig.strobes if rig.has.strobe else None,
            rig.vsyncs if rig.has.vsync else None,
        )

    def strobes(self) -> tuple[Strobe, ...]:
        """See `Trigger`."""
        self._rig.go_on()
        found, self._rig.log = tuple(self._rig.log), []
        return found

    def abort(self) -> None:
        """See `Trigger`."""
        self._rig.started_s = None

    def close(self) -> None:
        """See `Trigger`."""
        self._rig.started_s = None


class VirtualCamera:
    """A `Camera`."""

    def __init__(self, rig: VirtualRig) -> None:
        self._rig = rig
        self.identity = Identity("virtual", "camera")
        self.exposure_s = rig.exposure_s
        self.unlocked: tuple[str, ...] = ()
        min_period_s = rig.exposure_s + rig.readout_s
        self.limits = CameraLimits((8, 8), FrameFormat("rgb"), (1e-5, 1.0), min_period_s, triggered=True)

    def arm(self, count: int | None) -> None:
        """See `Camera`."""
        rig = self._rig
        rig.queue = []
        rig.busy_until_s = rig.arrived_s = 0.0
        rig.now_s += 5e-3
        rig.triggers = 0
        if rig.has.starts_anew:
            rig.frame_id, rig.zero_s = 0, rig.now_s

    def frame(self, timeout_s: float) -> CameraFrame | None:
        """See `Camera`."""
        rig = self._rig
        end_s = rig.now_s + timeout_s
        while True:
            rig.go_on()
            if rig.queue and rig.queue[0].host_time_s <= rig.now_s:
                return replace(rig.queue.pop(0), host_time_s=rig.now_s)
            if rig.now_s >= end_s:
                return None
            arrives_s = rig.queue[0].host_time_s if rig.queue else np.inf
            rig.now_s = min(end_s, max(min(arrives_s, rig.next_event_s()), rig.now_s + 1e-6))

    def trigger(self) -> None:
        """See `Camera`."""
        raise AssertionError("nobody triggers it by software")

    def disarm(self) -> None:
        """See `Camera`."""

    def close(self) -> None:
        """See `Camera`."""


def random_faults(random: np.random.Generator, n_pulses: int = FRAMES) -> Faults:
    """Return up to three faults in so many pulses, more often none."""
    found: dict[str, Any] = {}
    for _ in range(random.choice([0, 1, 2, 3], p=[0.4, 0.2, 0.2, 0.2])):
        name, pulse = str(random.choice(list(Faults.__dataclass_fields__))), int(random.integers(n_pulses))
        found[name] = {
            "noise": ((pulse, random.uniform(0.1, 0.95)),),
            "slow_line": ((pulse, random.uniform(0.02, 0.3)),),
            "late_s": random.uniform(0.2, 1.2) * PERIOD_S,
            "slow_start": (random.exponential(3e-3), random.exponential(3e-3)),
            "stale_frame": True,
            "strobe_out": True,
            "cable_out": pulse,
        }.get(name, (pulse,))
    return Faults(**found)
