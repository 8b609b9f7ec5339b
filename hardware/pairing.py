"""Pair every frame with its pulse: count AND identity are checked, and what is ambiguous is refused.

A frame's pulse is its place in the burst, never the order of its arrival alone: as many frames as pulses, every one
whole, numbered without a gap by the camera, a period apart by the camera's clock, none like the one before; and, where
the camera's exposures are wired back, one of them to every pulse. The time of arrival shows least, and is used last.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from hardware.protocols import CameraFrame, Levels, Strobe, TriggerStatus
from hardware.pulses import PulseTrain
from hardware.run_start import Lateness, Start, lateness, start_of

# How far two frames' distance may be off the period, as a fraction of it: clocks are off by about 0.0001, timestamps by
# some microseconds, and what is further off was exposed by something else, or under the light of another period.
_TOLERANCE = 0.05
# However much pulses jitter, a lost one is a whole period.
_MOST_TOLERANCE = 0.45
# Where only the times of arrival are known, which are late by whatever the computer was doing.
_ARRIVAL_TOLERANCE = 0.5
# At least three missed pulses, two pulses apart or more, all as far apart: a camera that is still busy when they come.
# A cable that is out misses every pulse.
_REGULAR_MISSES, _CLOSEST_MISSES = 3, 2
# What to check; of two that a burst does not distinguish, what does.
_TRIGGER = "the camera's trigger cable lost it, or the camera was not ready, which a longer period cures"
_LINE = "check the camera's trigger cable, and that its trigger line is the one in use"
_NOISE = "no pulse made it: there is noise on the trigger cable, or the camera runs free, which goes on with it out"
_SOFTWARE = "the camera or this machine is too slow; make the period longer"
_DATA = "check the camera's data cable and its bandwidth"
_BUSY = "let nothing else keep this machine busy, or make the period longer"
_WRAPPED = "it has 32 bits and began again at 0; nothing is wrong, capture the burst again"
_UNLIT = "it has one level throughout; take the cap off the lens, and look whether the exposure sees light at all"
_TWICE = "the camera or its driver delivers frames twice; switch it off and on"
_SET_BACK = "do not set or synchronise it, or restart the camera, during a capture"
# Ticks of cameras' clocks of 32 bits, s.
_TICKS_S = (1e-6, 1e-7, 1e-8, 8e-9, 1e-9)
_IGNORED = "the period is too short, which a longer one cures, or noise on the trigger cable came between pulses"


#: All faults; the tests have bursts with each of them, and with nothing else.
FaultKey = Literal[
    "before its exposure", "camera busy", "clock set back", "clock wrapped", "computer behind", "computer busy",
    "exposure off its pulse", "exposures missing", "frame early", "frame late", "frame not whole", "frames lost",
    "frames missing", "frames shifted", "instrument failed", "light changed", "no alternating pictures", "no frame",
    "no frame, no picture", "one level", "picture missing", "pictures missing", "pulses missing", "same frame",
    "slow start", "strobe", "too many exposures", "too many frames", "trigger complains", "trigger ignored",
    "trigger restarted", "uneven latency",
]  # fmt: skip


@dataclass(frozen=True)
class Fault:
    """A fault of a burst: a key and one line, with the pulse that it begins at where that is known."""

    key: FaultKey
    reason: str
    pulse: int | None = None
    may_pass: bool = False  # what comes after may show that the computer was busy, and no more

    def __str__(self) -> str:
        return self.reason if self.pulse is None else f"pulse {self.pulse}: {self.reason}"


@dataclass(frozen=True)
class Evidence:
    """All that is known of a run of pulses that has ended, or of a part of one that continues."""

    train: PulseTrain
    by_software: bool  # whether this program triggers the camera, and no cable does
    first_pulse: int  # its number, where the run is part of a longer one
    count: int  # pulses it has
    exposure_s: float
    jitter_s: float  # of the pulses
    fired_at_s: tuple[float, float]  # time.monotonic() before and after the start command, as far as clocks keep pace
    quickest_s: float  # the least time that a start command has taken
    clock: float  # how far the clocks of trigger source and this machine may be off each other, as a fraction
    counted: Start | None  # of a burst just before that was counted up; None: so is this one
    frames: Sequence[CameraFrame]  # in the order of arrival
    ahead: Sequence[CameraFrame]  # those of the pulses after these, as far as they were waited for
    previous: CameraFrame | None  # the frame of the pulse before the first
    least_arrival_s: float | None  # from a pulse to its frame, in bursts before that were whole; None: not known yet
    armed: TriggerStatus  # before the burst
    ended: TriggerStatus  # now
    strobe_wired: bool  # whether the trigger source sees exposures
    strobes: Sequence[Strobe] | None  # of these pulses; None: not wired, or too many to be remembered one by one
    strobe_delay_s: float | None  # from a pulse's period to its exposure, in bursts before; None: not known yet
    picture_a_pulse: bool  # whether the projector reports every picture that a pulse made it show

    @property
    def tolerance(self) -> float:
        """Largest error of two frames' distance, in periods."""
        return min(_TOLERANCE + 2 * self.jitter_s / self.train.period_s, _MOST_TOLERANCE)

    @property
    def lateness(self) -> Lateness:
        """By how much frames come later than in the burst that was counted up before, if there was one."""
        if self.counted is None or not self.frames:
            return Lateness(0.0)
        now = start_of((*self.frames, *self.ahead), self.first_pulse, self.train.period_s, self.fired_at_s)
        return lateness(
            now, self.counted, self.train.period_s, self.quickest_s, exposures_counted=self.exposures_counted
        )

    @property
    def exposures_counted(self) -> bool:
        """True if one exposure to every pulse was reported."""
        pulses = list(range(self.first_pulse, self.first_pulse + self.count))
        return self.strobes is not None and [strobe.pulse for strobe in self.strobes] == pulses

    def is_next(self, frame: CameraFrame, before: CameraFrame) -> bool:
        """Return whether nothing speaks against a frame being the next pulse's after another's."""
        if frame.device_time_s is not None and before.device_time_s is not None:
            step = (frame.device_time_s - before.device_time_s) / self.train.period_s
            return abs(step - 1) <= self.tolerance
        if frame.frame_id is not None and before.frame_id is not None:
            return frame.frame_id == before.frame_id + 1
        return not is_same_image(frame.image, before.image)

    @property
    def numbered(self) -> bool:
        """True if the camera's numbers and its counted exposures show that none is missing between two frames."""
        frames = self.frames if self.previous is None else (self.previous, *self.frames)
        return self.exposures_counted and all(frame.frame_id is not None for frame in frames)


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
        reason = "neither a frame nor a picture came: check both trigger cables and their ground"
        return [Fault("no frame, no picture", reason)]
    return []


def _trigger_faults(seen: Evidence) -> list[Fault]:
    found = []
    restarted = seen.armed.boot != seen.ended.boot
    if restarted:
        found.append(Fault("trigger restarted", "the trigger source restarted in mid-burst: check its power supply"))
    # It is the cause; missing pulses are the consequence.
    found += [Fault("trigger complains", f"the trigger source says: {line}") for line in seen.ended.complaints]
    n, asked, vsyncs = seen.ended.pulses, seen.train.count, seen.ended.vsyncs
    if not restarted and asked is not None and n not in (None, asked):
        found.append(Fault("pulses missing", f"the trigger source made {n} pulses instead of {asked}"))
    if seen.picture_a_pulse and n is not None and vsyncs is not None and vsyncs != n:
        reason = f"the projector reported {vsyncs} pictures to {n} pulses: check its trigger cable"
        found.append(Fault("pictures missing", reason))
    return found


def _count_faults(seen: Evidence) -> list[Fault]:
    pulses, strobes = seen.ended.pulses or 0, seen.ended.strobes or 0
    key: FaultKey
    if seen.strobes is not None:
        if found := _strobe_faults(seen, len(seen.strobes)):
            return found
    elif seen.strobe_wired and strobes != pulses:
        key, look = ("exposures missing", _TRIGGER) if strobes < pulses else ("too many exposures", _NOISE)
        return [Fault(key, f"{strobes} exposures to {pulses} pulses: {look}")]
    n = len(seen.frames)
    if n > seen.count:
        return [Fault("too many frames", f"{n} frames to {seen.count} pulses: {_NOISE}")]
    if n == seen.count:
        return []
    if seen.strobes is not None:
        came = f"only {n} frames" if n else "no frame"
        key, look = _lost_by(seen)
        return [Fault(key, f"{came} of {seen.count} exposures arrived: {look}", _first_gap(seen))]
    if n == 0:
        look = _DATA if seen.by_software else _LINE
        return [Fault("no frame", f"no frame came: {look}", seen.first_pulse)]
    look = _SOFTWARE if seen.by_software else f"{_TRIGGER}; or its data cable did"
    return [Fault("frames missing", f"{n} frames to {seen.count} pulses: {look}", _first_gap(seen))]


def _strobe_faults(seen: Evidence, n: int) -> list[Fault]:
    """Return the faults that the camera's exposures show, which are wired back."""
    with_exposure = {strobe.pulse for strobe in seen.strobes or ()}
    pulses = range(seen.first_pulse, seen.first_pulse + seen.count)
    without = [pulse for pulse in pulses if pulse not in with_exposure]
    if n >= seen.count:
        if without or n > seen.count:
            reason = f"{n} exposures, and not one to every one of {seen.count} pulses: {_NOISE}"
            return [Fault("too many exposures", reason, without[0] if without else None)]
        return _strobe_time_faults(seen)
    gaps = set(np.diff(without).tolist())
    key: FaultKey
    if n == 0 and not seen.frames:
        key, reason = "no frame", f"no exposure was seen, and no frame came: {_LINE}"
    elif len(seen.frames) == seen.count and not _time_faults(seen):
        look = "check the strobe cable, and camera.strobe_line"
        key, reason = "strobe", f"{n} exposures were counted for {seen.count} frames: {look}"
    elif len(without) >= _REGULAR_MISSES and len(gaps) == 1 and gaps.pop() >= _CLOSEST_MISSES:
        missed = f"the camera misses pulses regularly ({n} exposures to {seen.count})"
        key, reason = "camera busy", f"{missed}: make the period longer"
    else:
        key, reason = "exposures missing", f"{n} exposures to {seen.count} pulses: {_TRIGGER}"
    return [Fault(key, reason, without[0])]


def _strobe_time_faults(seen: Evidence) -> list[Fault]:
    """Return which exposure did not follow its pulse as the others did theirs: something else made it."""
    delays_s = np.array([strobe.time_s - strobe.pulse * seen.train.period_s for strobe in seen.strobes or ()])
    # A single one has no others: only bursts before show it.
    usual_s = np.median(delays_s) if seen.strobe_delay_s is None else seen.strobe_delay_s
    off = np.abs(delays_s - usual_s) / seen.train.period_s
    for strobe, periods in zip(seen.strobes or (), off, strict=True):
        if periods > seen.tolerance:
            reason = f"its exposure is off by {periods:.2f} periods: {_NOISE}"
            return [Fault("exposure off its pulse", reason, strobe.pulse)]
    return []


def _first_gap(seen: Evidence) -> int | None:
    """Return the pulse whose frame is the first that is missing; None: unknown."""
    if not seen.frames:
        return seen.first_pulse
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
    """Return how long after its pulse was due each frame came, those ahead included."""
    frames = (*seen.frames, *seen.ahead)
    pulses = seen.first_pulse + np.arange(len(frames))
    return np.array([frame.host_time_s for frame in frames]) - seen.fired_at_s[0] - pulses * seen.train.period_s


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
    key: FaultKey
    for pulse, frame in enumerate(seen.frames, seen.first_pulse):
        if frame.image is None:
            found.append(Fault("frame not whole", f"its frame is not whole ({frame.fault}): {_DATA}", pulse))
        if before is not None:
            if frame.frame_id is not None and before.frame_id is not None and frame.frame_id != before.frame_id + 1:
                key, look = _lost_by(seen)
                found.append(Fault(key, f"frame {frame.frame_id} follows frame {before.frame_id}: {look}", pulse))
            elif frame.triggers is not None and before.triggers is not None:
                ignored = frame.triggers - before.triggers - 1
                if ignored:
                    reason = f"the camera ignored {ignored} triggers before it: {_IGNORED}"
                    found.append(Fault("trigger ignored", reason, pulse))
            if frame.image is not None and is_same_image(before.image, frame.image):
                # Without light a camera may show no noise.
                one_level = frame.image.min() == frame.image.max()
                key, look = ("one level", _UNLIT) if one_level else ("same frame", _TWICE)
                found.append(Fault(key, f"its frame is the one before once more, to the last bit: {look}", pulse))
        before = frame
    return found


def is_same_image(one: Levels | None, other: Levels | None) -> bool:
    """Return whether two frames are the same to the last bit, which noise keeps exposures from being."""
    if one is None or other is None or one.shape != other.shape:
        return False
    return np.array_equal(one[::32], other[::32]) and np.array_equal(one, other)  # some rows almost always suffice


def _time_faults(seen: Evidence) -> list[Fault]:
    steps = _steps(seen)
    key: FaultKey
    for pulse, step in enumerate(steps, seen.first_pulse):
        if step is not None and step < 0:
            back_s = (1 - step) * seen.train.period_s  # from where it would have been a period later
            wrapped = any(abs(back_s - 2**32 * tick_s) < 1e-3 for tick_s in _TICKS_S)
            key, look = ("clock wrapped", _WRAPPED) if wrapped else ("clock set back", _SET_BACK)
            return [Fault(key, f"the camera's clock went back by {back_s:.2f} s: {look}", pulse)]
        if step is not None and abs(step - 1) > seen.tolerance:
            key = "frame late" if step > 1 else "frame early"
            # Where pulses were lost, the next frame is whole periods later.
            lost = round(step) > 1 and abs(step - round(step)) <= seen.tolerance
            look = _SOFTWARE if seen.by_software else _TRIGGER if lost else _NOISE
            return [Fault(key, f"its frame is {step:.2f} periods after the one before: {look}", pulse)]
    return _arrival_faults(seen, steps) or _start_faults(seen, steps)


def _arrival_faults(seen: Evidence, steps: Sequence[float | None]) -> list[Fault]:
    """Return the faults that times of arrival show, where nothing better is known of a frame."""
    late_s = _late_s(seen)
    # Between pulses that run on, a frame whose distance from the one before is known needs no other proof.
    followed = [seen.previous is not None and (step is not None or seen.numbered) for step in steps]
    # Timestamps are taken some time after the fact.
    least_s = _exposed_s(seen) - 1e-3 - seen.clock * np.arange(1, len(steps) + 1) * seen.train.period_s
    early = np.flatnonzero((late_s[: len(steps)] < least_s) & ~np.array(followed, bool))
    if len(early):
        reason = f"its frame came before it can have been exposed: {_NOISE}"
        return [Fault("before its exposure", reason, seen.first_pulse + int(early[0]))]
    # Where exposures are counted, a burst that has ended has as many frames as exposures.
    ongoing = seen.train.count is None
    if None in steps and (ongoing or not seen.strobe_wired) and not seen.numbered:
        # What is merely slow catches up again; what was lost does not.
        since = np.minimum.accumulate(late_s[::-1])[::-1][1:]
        until = np.minimum.accumulate(late_s)[:-1]
        limit_s = _ARRIVAL_TOLERANCE * seen.train.period_s
        is_lost = since - until > limit_s
        if not ongoing and seen.least_arrival_s is not None:
            # All frames are there: if one was lost, one before came of a trigger too many, and too soon.
            is_lost &= until < seen.least_arrival_s - limit_s
        lost = np.flatnonzero(is_lost[: len(steps)])
        if len(lost):
            pulse = seen.first_pulse + min(int(lost[0]) + 1, len(steps) - 1)
            reason = f"from here on frames are late by a period: {_likely(seen)}"
            return [Fault("frames shifted", reason, pulse, may_pass=True)]
    return []


def _start_faults(seen: Evidence, steps: Sequence[float | None]) -> list[Fault]:
    """Say where pulses run on, and their frames are not theirs but another pulse's.

    They are never counted up against frames. Where the camera's clock or its numbers show it, it is enough to check the
    first one: the others follow it.
    """
    if seen.previous is not None and (None not in steps or seen.numbered):
        return []
    late = seen.lateness
    if late.in_doubt and seen.previous is None:
        took_s = max(seen.fired_at_s[1] - seen.fired_at_s[0], seen.counted.fire_s if seen.counted else 0.0)
        reason = f"the start took {took_s:.3f} s, which may hide a lost trigger: make the period longer"
        return [Fault("slow start", reason, seen.first_pulse, may_pass=late.by_arrival)]
    if abs(late.periods) > (0.0 if seen.previous is None else _ARRIVAL_TOLERANCE):
        reason = f"frames come {abs(late.periods):.1f} periods {'later' if late.periods > 0 else 'sooner'} than before"
        return [Fault("frames shifted", f"{reason}: {_likely(seen)}", seen.first_pulse, may_pass=late.by_arrival)]
    return []


def _likely(seen: Evidence) -> str:
    """Return what has lost frames of which none is missing between the others."""
    if seen.by_software:
        return _SOFTWARE
    return _lost_by(seen)[1] if seen.strobes is not None else _TRIGGER


def _lost_by(seen: Evidence) -> tuple[FaultKey, str]:
    """Return what has lost frames that were exposed: a busy machine took others a period late, a cable does not."""
    times_s = [(frame.host_time_s, frame.device_time_s) for frame in seen.frames]
    delays_s = [host_s - device_s for host_s, device_s in times_s if device_s is not None]
    if delays_s and max(delays_s) - min(delays_s) > seen.train.period_s:
        late_ms = 1e3 * (max(delays_s) - min(delays_s))
        return "computer busy", f"other frames arrived up to {late_ms:.0f} ms late: {_BUSY}"
    return "frames lost", _DATA
