"""A burst of numbered pulses at projector and camera, and whether a trigger source can make it."""

import math
from dataclasses import dataclass, replace
from fractions import Fraction

from hardware.errors import RigError


@dataclass(frozen=True)
class Pulse:
    """One output's pulse in each period."""

    delay_s: float  # from the start of the period
    width_s: float


@dataclass(frozen=True)
class PulseTrain:
    """Pulses at both outputs, numbered from 0: pulse k starts at k period_s + delay_s after the burst's start."""

    period_s: float
    count: int | None  # None: until it is aborted
    projector: Pulse
    camera: Pulse


@dataclass(frozen=True)
class TriggerLimits:
    """Limits of a trigger source; times are rounded to its tick."""

    tick_s: float
    min_period_s: float
    max_period_s: float
    min_width_s: float
    min_gap_s: float  # between the end of an output's pulse and the start of its next
    max_count: int  # pulses per burst
    counts_strobes: bool  # whether it sees the camera's exposures
    counts_vsyncs: bool  # whether it sees the projector's pictures
    jitter_s: float = 0.0  # how far off its time a pulse may come; below 10 us it does not matter


def fitted(train: PulseTrain, limits: TriggerLimits) -> PulseTrain:
    """Return a train rounded to the tick, or refuse it: a request that cannot be kept is never adapted silently.

    Raises
    ------
    RigError
        It is impossible; the message names the time, the limit and what to change.

    Notes
    -----
    Times are compared in whole ticks, and every time counts as the decimal number that it is written as: 3e-7 s is
    thirty ticks of 1e-8 s, although their quotient as floats is less.
    """
    tick = _exact(limits.tick_s)

    def ticks(name: str, time_s: float) -> int:
        if not math.isfinite(time_s):
            raise RigError(f"the {name} is {time_s} s: give a number of seconds")
        return round(_exact(time_s) / tick)

    def seconds(ticks: int) -> float:
        return float(ticks * tick)

    if train.count is not None and not 1 <= train.count <= limits.max_count:
        raise RigError(f"{train.count} pulses a burst: this trigger source makes 1 to {limits.max_count}")
    period = ticks("period", train.period_s)
    if not limits.min_period_s <= seconds(period) <= limits.max_period_s:
        raise RigError(
            f"a period of {train.period_s:g} s: this trigger source makes {limits.min_period_s:g} to "
            f"{limits.max_period_s:g} s"
        )

    def fitted_pulse(name: str, asked: Pulse) -> Pulse:
        delay, width = ticks(f"{name}'s delay", asked.delay_s), ticks(f"{name}'s width", asked.width_s)
        if delay < 0:
            raise RigError(f"the {name}'s delay is {asked.delay_s:g} s: it must not be negative")
        if seconds(width) < limits.min_width_s:
            raise RigError(f"the {name}'s pulse is {asked.width_s:g} s wide: make it {limits.min_width_s:g} s or more")
        gap_s = seconds(period - delay - width)
        if gap_s < limits.min_gap_s:
            ends = f"{gap_s:g} s before the period does" if gap_s >= 0 else f"{-gap_s:g} s after the period has"
            raise RigError(
                f"the {name}'s pulse ends {ends}: leave {limits.min_gap_s:g} s or more, "
                "with a longer period, a shorter delay or a shorter width"
            )
        return Pulse(seconds(delay), seconds(width))

    return replace(
        train,
        period_s=seconds(period),
        projector=fitted_pulse("projector", train.projector),
        camera=fitted_pulse("camera", train.camera),
    )


def _exact(time_s: float) -> Fraction:
    """Return the decimal number that a float is written as."""
    return Fraction(repr(float(time_s)))
