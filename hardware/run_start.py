"""Check that the first frame of pulses that run on is the first pulse's: if not, none is missing between the others.

A burst just before, counted up frame by frame, shows how frames follow pulses. What is compared with it, best first:
the camera's count of triggers, the camera's clock, the camera's numbers where exposures are counted besides, and only
then when frames arrive, which is late by whatever the computer was doing.

A clock shows a lost trigger as one period more between the start command and the first frame. Both commands took some
time, and pulses began somewhere in it: where the counted burst may itself have begun a period later than its command, a
lost trigger could hide, and both are fired again.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from hardware.protocols import CameraFrame

# A period is lost, or none is.
_HALF = 0.5
# Of numbers that are further off nobody knows how they count.
_MOST_LOST = 1000
# What clocks and timestamps may be off besides, in periods.
_MARGIN = 0.05


@dataclass(frozen=True)
class Start:
    """Times at which the frames of a run follow its pulses; the camera's clock has an origin of its own."""

    arrival_s: float  # the shortest time from a pulse to its frame's arrival, from before the start command
    device_s: float | None  # the same by the camera's clock; None: it has none
    frame_ids: tuple[int, int] | None  # of the first frame and the last one; None: they have no numbers
    triggers: int | None  # the camera's count at the first pulse's frame; None: it does not report it
    fire_s: float  # how long the start command took: pulses began somewhere in it


@dataclass(frozen=True)
class Lateness:
    """By how many periods frames come later than those of the burst that was counted up; 0: the first is the first."""

    periods: float
    in_doubt: bool = False  # slow start commands may be all there is to it, or hide a lost trigger
    by_arrival: bool = False  # there is no other evidence: this machine may have been slow to take them
    clock_restarted: bool = False  # the camera's clock was set to zero since, and shows nothing


def start_of(
    frames: Sequence[CameraFrame], first_pulse: int, period_s: float, fired_at_s: tuple[float, float]
) -> Start:
    """Return how frames, at least one, follow the pulses from the first one on, fired between two times."""
    since_s = [fired_at_s[0] + pulse * period_s for pulse in range(first_pulse, first_pulse + len(frames))]
    by_camera = [
        frame.device_time_s - pulse_s
        for frame, pulse_s in zip(frames, since_s, strict=True)
        if frame.device_time_s is not None
    ]
    first, last = frames[0].frame_id, frames[-1].frame_id
    return Start(
        arrival_s=min(frame.host_time_s - pulse_s for frame, pulse_s in zip(frames, since_s, strict=True)),
        device_s=min(by_camera) if len(by_camera) == len(frames) else None,
        frame_ids=None if first is None or last is None else (first, last),
        triggers=None if frames[0].triggers is None else frames[0].triggers - first_pulse,
        fire_s=fired_at_s[1] - fired_at_s[0],
    )


def lateness(now: Start, counted: Start, period_s: float, quickest_s: float, *, exposures_counted: bool) -> Lateness:
    """Return by how many periods the frames of a run are late.

    Parameters
    ----------
    now, counted : Start
        Of the run, and of the burst before it, which had as many frames as pulses.
    period_s : float
        Of both.
    quickest_s : float
        The least time that a start command has taken.
    exposures_counted : bool
        True if every pulse is known to have made one exposure, and only frames may be missing.
    """
    if now.triggers is not None and counted.triggers is not None:
        if now.triggers != counted.triggers:
            return Lateness(now.triggers - counted.triggers)
        if exposures_counted:
            return Lateness(0.0)
    # What every start command takes on its line and in the instrument is the same for both.
    alike_s = quickest_s if quickest_s > _HALF * period_s else 0.0
    held_up, held_up_before = ((start.fire_s - alike_s) / period_s for start in (now, counted))
    clock_restarted = False
    if now.device_s is not None and counted.device_s is not None:
        periods = (now.device_s - counted.device_s) / period_s
        # No start can have been that slow.
        clock_restarted = periods < -max(held_up_before, _HALF) - _HALF
        if not clock_restarted:
            return _judged(periods, held_up, held_up_before)
    numbered = False
    if exposures_counted and now.frame_ids is not None and counted.frame_ids is not None:
        numbered = True
        # Numbers begin anew whenever a camera is armed, or count on; what is between was lost on its way.
        lost = [now.frame_ids[0] - expected for expected in (counted.frame_ids[0], counted.frame_ids[1] + 1)]
        likely = [n_lost for n_lost in lost if 0 <= n_lost < _MOST_LOST]
        if likely:
            return Lateness(float(min(likely)), clock_restarted=clock_restarted)
    judged = _judged((now.arrival_s - counted.arrival_s) / period_s, held_up, held_up_before)
    return replace(judged, by_arrival=not numbered, clock_restarted=clock_restarted)


def _judged(periods: float, held_up: float, held_up_before: float) -> Lateness:
    """Return what a lateness is worth where both start commands may have been held up, by so many periods at most."""
    if periods < -max(held_up_before, _HALF) - _MARGIN:
        return Lateness(periods)
    # The least that one lost trigger can look like.
    if periods < min(1 - held_up_before - _MARGIN, _HALF):
        return Lateness(0.0)
    return Lateness(periods, in_doubt=periods <= held_up + _MARGIN)
