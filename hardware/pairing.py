"""Which pulse a frame belongs to: count AND identity are checked, and what is in doubt is refused.

A frame's pulse is its place in the burst, never the order of its arrival alone: as many frames as pulses, every one
whole, numbered without a gap by the camera, a period apart by the camera's clock, none like the one before; and, where
the camera's exposures are wired back, one of them to every pulse.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hardware.protocols import CameraFrame, Levels, Strobe, TriggerStatus
from hardware.pulses import PulseTrain

# How far two frames' distance may be off the period, as a fraction of it: clocks are off by some 0.0001, timestamps by
# some microseconds, and what is further off was exposed by something else, or under the light of another period.
_TOLERANCE = 0.05
# However much pulses jitter, a lost one is a whole period.
_MOST_TOLERANCE = 0.45
# Where only the times of arrival are known, which are late by whatever the computer was doing.
_ARRIVAL_TOLERANCE = 0.5
# What to look at, the likeliest first.
_TRIGGER = "check the camera's trigger cable"
_NOISE = "check the shields of the camera's cables"
_SOFTWARE = "the camera or this machine is too slow: make the period longer"
_DATA = "check the camera's data cable and its bandwidth"


@dataclass(frozen=True)
class Fault:
    """What is wrong with a burst: one line, with the pulse that it begins at where that is known."""

    reason: str
    pulse: int | None = None

    def __str__(self) -> str:
        return self.reason if self.pulse is None else f"pulse {self.pulse}: {self.reason}"


@dataclass(frozen=True)
class Evidence:
    """All that is known of a run of pulses that has ended, or of a part of one that goes on."""

    train: PulseTrain
    by_software: bool  # whether this program triggers the camera, and no cable does
    first_pulse: int  # its number, where the run is part of a longer one
    count: int  # pulses it has
    exposure_s: float
    jitter_s: float  # of the pulses
    fired_at_s: float  # time.monotonic() before the burst was started: no pulse came before that
    frames: Sequence[CameraFrame]  # in the order of arrival
    previous: CameraFrame | None  # the frame of the pulse before the first
    armed: TriggerStatus  # before the burst
    ended: TriggerStatus  # now
    strobe_wired: bool  # whether the trigger source sees exposures
    strobes: Sequence[Strobe] | None  # of these pulses; None: not wired, or too many to be remembered one by one
    picture_a_pulse: bool  # whether the projector reports every picture that a pulse made it show

    @property
    def tolerance(self) -> float:
        """How far two frames' distance may be off the period, in periods."""
        return min(_TOLERANCE + 2 * self.jitter_s / self.train.period_s, _MOST_TOLERANCE)


def find_faults(seen: Evidence) -> list[Fault]:
    """Return all that keeps frame i from being pulse i's beyond doubt, the likeliest cause first; none: it is."""
    return [
        *_cable_faults(seen),
        *_trigger_faults(seen),
        *_count_faults(seen),
        *_frame_faults(seen),
        *_time_faults(seen),
    ]


def _cable_faults(seen: Evidence) -> list[Fault]:
    """Say where neither camera nor projector is heard of, whose cables have the trigger source in common."""
    whole = seen.ended.pulses == seen.train.count or seen.train.count is None
    if seen.picture_a_pulse and whole and not (seen.frames or seen.ended.strobes or seen.ended.vsyncs):
        return [Fault("neither a frame nor a picture came: check both trigger cables and their ground")]
    return []


def _trigger_faults(seen: Evidence) -> list[Fault]:
    found = []
    restarted = seen.armed.boot != seen.ended.boot
    if restarted:
        found.append(Fault("the trigger source restarted in mid-burst: check its power supply"))
    # It says why; that pulses are missing is what comes of it.
    found += [Fault(f"the trigger source says: {complaint}") for complaint in seen.ended.complaints]
    if not restarted and seen.train.count is not None and seen.ended.pulses not in (None, seen.train.count):
        found.append(Fault(f"the trigger source made only {seen.ended.pulses} pulses", seen.ended.pulses))
    # While pulses run on, the projector may not have answered the last one yet.
    n, vsyncs, running = seen.ended.pulses, seen.ended.vsyncs, seen.train.count is None
    if seen.picture_a_pulse and n is not None and vsyncs is not None and not n - running <= vsyncs <= n + running:
        found.append(Fault(f"the projector reported {vsyncs} pictures to {n} pulses: check its trigger cable"))
    return found


def _count_faults(seen: Evidence) -> list[Fault]:
    if seen.strobes is not None:
        found = _strobe_faults(seen, len(seen.strobes))
        if found:
            return found
    elif seen.strobe_wired:
        found = _strobe_count_faults(seen)
        if found:
            return found
    n = len(seen.frames)
    if n > seen.count:
        return [Fault(f"{n} frames to {seen.count} pulses: {_NOISE}")]
    if n == seen.count:
        return []
    if seen.strobes is not None:
        return [Fault(f"only {n} frames of {seen.count} exposures arrived: {_DATA}", _first_gap(seen))]
    if n == 0:
        look = _DATA if seen.by_software else f"{_TRIGGER}, and that its trigger line is the one in use"
        return [Fault(f"no frame came: {look}", seen.first_pulse)]
    look = _SOFTWARE if seen.by_software else f"{_TRIGGER}, then its data cable"
    return [Fault(f"{n} frames to {seen.count} pulses: {look}", _first_gap(seen))]


def _strobe_count_faults(seen: Evidence) -> list[Fault]:
    pulses, strobes = seen.ended.pulses or 0, seen.ended.strobes or 0
    # While pulses run on, the last one's exposure may be still to come.
    if pulses - (seen.train.count is None) <= strobes <= pulses:
        return []
    return [Fault(f"{strobes} exposures to {pulses} pulses: {_TRIGGER if strobes < pulses else _NOISE}")]


def _strobe_faults(seen: Evidence, n: int) -> list[Fault]:
    """Return what the camera's exposures say, which are wired back."""
    with_exposure = {strobe.pulse for strobe in seen.strobes or ()}
    pulses = range(seen.first_pulse, seen.first_pulse + seen.count)
    without = [pulse for pulse in pulses if pulse not in with_exposure]
    if n >= seen.count:
        if without or n > seen.count:
            return [Fault(f"{n} exposures, and not one to every one of {seen.count} pulses: {_NOISE}", *without[:1])]
        return []
    if n == 0 and not seen.frames:
        reason = f"no exposure was seen, and no frame came: {_TRIGGER}, and that its trigger line is the one in use"
    elif len(seen.frames) == seen.count and all(
        step is not None and step < 1 + seen.tolerance for step in _steps(seen)
    ):
        reason = f"{n} exposures were counted for {seen.count} frames: check the strobe cable"
    elif len(without) > 2 and len(set(np.diff(without))) == 1:
        reason = f"the camera misses pulses regularly ({n} exposures to {seen.count}): make the period longer"
    else:
        reason = f"{n} exposures to {seen.count} pulses: {_TRIGGER}"
    return [Fault(reason, without[0])]


def _first_gap(seen: Evidence) -> int | None:
    """Return the pulse at which the camera's own clock first misses a frame; None: it has none."""
    steps = _steps(seen)
    for i, step in enumerate(steps):
        if step is None:
            return None
        if step > 1 + seen.tolerance:
            return seen.first_pulse + i
    # None is missing between them. Of the first and the last, the last is more often late for good.
    return seen.first_pulse + len(seen.frames)


def _steps(seen: Evidence) -> list[float | None]:
    """Return the camera's time between each frame and the one before, in periods; None: not known."""
    steps: list[float | None] = []
    before = seen.previous
    for frame in seen.frames:
        if before is None:
            steps.append(1.0)
        elif before.device_time_s is None or frame.device_time_s is None:
            steps.append(None)
        else:
            steps.append((frame.device_time_s - before.device_time_s) / seen.train.period_s)
        before = frame
    return steps


def _frame_faults(seen: Evidence) -> list[Fault]:
    found = []
    before = seen.previous
    for pulse, frame in enumerate(seen.frames, seen.first_pulse):
        if frame.image is None:
            found.append(Fault(f"its frame is not whole ({frame.fault}): {_DATA}", pulse))
        if before is not None:
            if frame.frame_id is not None and before.frame_id is not None and frame.frame_id != before.frame_id + 1:
                found.append(Fault(f"frame {frame.frame_id} follows frame {before.frame_id}: {_DATA}", pulse))
            if _same(before.image, frame.image):
                found.append(
                    Fault("its frame is the one before once more, to the last bit: is the lens covered?", pulse)
                )
        before = frame
    return found


def _same(one: Levels | None, other: Levels | None) -> bool:
    """Whether two frames are the same to the last bit, which noise keeps exposures from being."""
    if one is None or other is None or one.shape != other.shape:
        return False
    return np.array_equal(one[::32], other[::32]) and np.array_equal(one, other)  # some rows tell almost always


def _time_faults(seen: Evidence) -> list[Fault]:
    steps = _steps(seen)
    for pulse, step in enumerate(steps, seen.first_pulse):
        if step is not None and abs(step - 1) > seen.tolerance:
            likely = _SOFTWARE if seen.by_software else _TRIGGER if step > 1 else _NOISE
            return [Fault(f"its frame is {step:.2f} periods after the one before: {likely}", pulse)]
    pulses = seen.first_pulse + np.arange(len(steps))
    late_s = np.array([frame.host_time_s for frame in seen.frames]) - seen.fired_at_s - pulses * seen.train.period_s
    # Clocks drift apart by up to a thousandth, and timestamps are taken some time after the fact.
    least_s = seen.train.camera.delay_s + seen.exposure_s - 1e-3 * pulses * seen.train.period_s - 1e-3
    early = np.flatnonzero(late_s < least_s)
    if len(early):
        return [Fault(f"its frame came before it can have been exposed: {_NOISE}", int(pulses[early[0]]))]
    if None in steps:
        # What is merely slow catches up again; what was lost does not.
        since = np.minimum.accumulate(late_s[::-1])[::-1][1:]
        until = np.minimum.accumulate(late_s)[:-1]
        lost = np.flatnonzero(since - until > _ARRIVAL_TOLERANCE * seen.train.period_s)
        if len(lost):
            likely = _SOFTWARE if seen.by_software else _TRIGGER
            return [Fault(f"from here on frames are late by a period: {likely}", int(pulses[lost[0] + 1]))]
    return []
