"""Which pulse a frame belongs to: count AND identity are checked, and what is in doubt is refused.

A frame's pulse is its place in the burst, never the order of its arrival alone: as many frames as pulses, every one
whole, numbered without a gap by the camera, a period apart by the camera's clock, none like the one before; and, where
the camera's exposures are wired back, one of them to every pulse.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hardware.protocols import CameraFrame, Levels, Strobe, TriggerStatus
from hardware.pulses import PulseTrain

# How far two frames' distance may be off the period, as a fraction of it: clocks are off by some 0.0001, timestamps by
# some microseconds, and what is further off was exposed by something else, or under the light of another period.
_TOLERANCE = 0.05
# However much pulses jitter, a lost one is a whole period.
_MOST_TOLERANCE = 0.45
# Where only the times of arrival are known, which are late by whatever the computer was doing.
_ARRIVAL_TOLERANCE = 0.5
# At least three missed pulses, two pulses apart or more, all as far apart: a camera that is still busy when they come.
# A cable that is out misses every pulse.
_REGULAR_MISSES, _CLOSEST_MISSES = 3, 2
# What to look at, the likeliest first.
_TRIGGER = "check the camera's trigger cable"
_NOISE = "check the shields of the camera's cables"
_SOFTWARE = "the camera or this machine is too slow; make the period longer"
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
    fired_at_s: float  # time.monotonic() before the burst was started, as far as clocks keep pace: no pulse came before
    clock: float  # how far the clocks of trigger source and this machine may be off each other, as a fraction
    latencies_s: Sequence[float] | None  # of a burst just before that was counted up; None: so is this one
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
        found.append(Fault(f"the trigger source made {seen.ended.pulses} pulses instead of {seen.train.count}"))
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
        return _strobe_time_faults(seen)
    gaps = set(np.diff(without).tolist())
    if n == 0 and not seen.frames:
        reason = f"no exposure was seen, and no frame came: {_TRIGGER}, and that its trigger line is the one in use"
    elif len(seen.frames) == seen.count and not _time_faults(seen):
        reason = f"{n} exposures were counted for {seen.count} frames: check the strobe cable, and camera.strobe_line"
    elif len(without) >= _REGULAR_MISSES and len(gaps) == 1 and gaps.pop() >= _CLOSEST_MISSES:
        reason = f"the camera misses pulses regularly ({n} exposures to {seen.count}): make the period longer"
    else:
        reason = f"{n} exposures to {seen.count} pulses: {_TRIGGER}"
    return [Fault(reason, without[0])]


def _strobe_time_faults(seen: Evidence) -> list[Fault]:
    """Return which exposure did not follow its pulse as the others did theirs: something else made it."""
    delays_s = np.array([strobe.time_s - strobe.pulse * seen.train.period_s for strobe in seen.strobes or ()])
    off = np.abs(delays_s - np.median(delays_s)) / seen.train.period_s
    for strobe, periods in zip(seen.strobes or (), off, strict=True):
        if periods > seen.tolerance:
            return [Fault(f"its exposure is off by {periods:.2f} periods: {_NOISE}", strobe.pulse)]
    return []


def _first_gap(seen: Evidence) -> int | None:
    """Return the pulse whose frame is the first that is missing; None: nothing tells."""
    steps = _steps(seen)
    for i, step in enumerate(steps):
        if step is None:
            return None
        if step > 1 + seen.tolerance:
            return seen.first_pulse + i
    # None is missing between them: the first or the last. Where one came so soon that it cannot have been exposed a
    # period later, the first is there.
    if seen.previous is not None or _late_s(seen).min() < _exposed_s(seen) + seen.train.period_s:
        return seen.first_pulse + len(seen.frames)
    return None


def _late_s(seen: Evidence) -> npt.NDArray[np.float64]:
    """Return how long after its pulse was due each frame came."""
    pulses = seen.first_pulse + np.arange(len(seen.frames))
    return np.array([frame.host_time_s for frame in seen.frames]) - seen.fired_at_s - pulses * seen.train.period_s


def _exposed_s(seen: Evidence) -> float:
    """Return how long after its pulse a frame's exposure ends at the earliest."""
    return seen.train.camera.delay_s + seen.exposure_s


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
    late_s = _late_s(seen)
    # Timestamps are taken some time after the fact.
    least_s = _exposed_s(seen) - 1e-3 - seen.clock * np.arange(1, len(steps) + 1) * seen.train.period_s
    early = np.flatnonzero(late_s < least_s)
    if len(early):
        reason = f"its frame came before it can have been exposed: {_NOISE}"
        return [Fault(reason, seen.first_pulse + int(early[0]))]
    # Where exposures are counted, a burst that has ended has as many frames as exposures.
    ongoing = seen.train.count is None
    if None in steps and (ongoing or not seen.strobe_wired):
        # What is merely slow catches up again; what was lost does not.
        since = np.minimum.accumulate(late_s[::-1])[::-1][1:]
        until = np.minimum.accumulate(late_s)[:-1]
        lost = np.flatnonzero(since - until > _ARRIVAL_TOLERANCE * seen.train.period_s)
        if len(lost):
            reason = f"from here on frames are late by a period: {_likely(seen)}"
            return [Fault(reason, seen.first_pulse + int(lost[0]) + 1)]
    # Pulses that run on are never counted up against frames: only that the first frame came in its time shows that it
    # was the first. By the camera's clock the others follow it.
    if seen.latencies_s is not None and seen.frames and (seen.previous is None or None in steps):
        latencies = latencies_s(seen.frames, seen.first_pulse, seen.train.period_s, seen.fired_at_s)
        pairs = zip(latencies, seen.latencies_s, strict=False)
        # The line may have been busy, or the camera's clock have been set to zero: never does it move both by a period.
        late = min(((now_s - before_s) / seen.train.period_s for now_s, before_s in pairs), key=abs)
        if abs(late) > _ARRIVAL_TOLERANCE:
            reason = f"frames come {abs(late):.1f} periods {'later' if late > 0 else 'sooner'} than before"
            return [Fault(f"{reason}: {_likely(seen)}", seen.first_pulse)]
    return []


def latencies_s(frames: Sequence[CameraFrame], first_pulse: int, period_s: float, fired_at_s: float) -> list[float]:
    """Return the shortest time from a pulse to its frame: to its arrival; and by the camera's clock, if it has one.

    The camera's clock has an origin of its own: of two bursts, only the difference means something.
    """
    since_s = [fired_at_s + pulse * period_s for pulse in range(first_pulse, first_pulse + len(frames))]
    found = [min(frame.host_time_s - pulse_s for frame, pulse_s in zip(frames, since_s, strict=True))]
    timed = [(frame.device_time_s, pulse_s) for frame, pulse_s in zip(frames, since_s, strict=True)]
    by_camera = [time_s - pulse_s for time_s, pulse_s in timed if time_s is not None]
    if len(by_camera) == len(frames):
        found.append(min(by_camera))
    return found


def _likely(seen: Evidence) -> str:
    """Return what has lost frames of which none is missing between the others."""
    if seen.by_software:
        return _SOFTWARE
    return _DATA if seen.strobes is not None else _TRIGGER
