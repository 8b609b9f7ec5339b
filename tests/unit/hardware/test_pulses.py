import math
from fractions import Fraction

import pytest

from hardware.errors import RigError
from hardware.pulses import Pulse, PulseTrain, TriggerLimits, fitted

#: Ticks of instruments here and elsewhere: the DG645's, the box's, one clock of 16 MHz, of 12 MHz.
TICKS_S = [10e-9, 0.5e-6, 62.5e-9, 1 / 12e6, 5e-9, 1e-3]


def limits(tick_s: float, **other: float) -> TriggerLimits:
    times = {"min_period_s": 10 * tick_s, "max_period_s": 1e9 * tick_s, "min_width_s": tick_s, "min_gap_s": 2 * tick_s}
    return TriggerLimits(tick_s=tick_s, **{**times, **other}, max_count=1000, counts_strobes=False, counts_vsyncs=False)


def train(period_s: float, delay_s: float, width_s: float, count: int | None = 3) -> PulseTrain:
    return PulseTrain(period_s, count, Pulse(0.0, width_s), Pulse(delay_s, width_s))


@pytest.mark.parametrize("tick_s", TICKS_S)
def test_whole_ticks_are_kept_whichever_way_they_are_computed(tick_s):
    exact = Fraction(repr(tick_s))
    for period in (10, 11, 33, 3333, 123_457, 33_333_333, 999_999_999):
        for delay in (0, 1, 3, 7):
            width = period - delay - 2  # no room left: one tick more is refused
            if width < 1:
                continue
            right = train(float(period * exact), float(delay * exact), float(width * exact))
            for computed in (
                train(period * tick_s, delay * tick_s, width * tick_s),
                train(period / (1 / tick_s), delay / (1 / tick_s), width / (1 / tick_s)),
                train((period - delay) * tick_s + delay * tick_s, delay * tick_s, width * tick_s),
            ):
                assert fitted(computed, limits(tick_s)) == right
            assert fitted(right, limits(tick_s)) == right
            with pytest.raises(RigError, match=r"ends .* s before the period does: leave"):
                fitted(train(period * tick_s, delay * tick_s, (width + 1) * tick_s), limits(tick_s))


@pytest.mark.parametrize("tick_s", TICKS_S)
def test_limits_belong_to_what_is_allowed(tick_s):
    exact = Fraction(repr(tick_s))
    lowest, highest, narrowest = 300, 30_000, 7
    bounds = limits(
        tick_s,
        min_period_s=float(lowest * exact),
        max_period_s=float(highest * exact),
        min_width_s=float(narrowest * exact),
    )
    for period in (lowest, highest):
        assert fitted(train(period * tick_s, 0.0, narrowest * tick_s), bounds).period_s == float(period * exact)
    for period in (lowest - 1, highest + 1):
        with pytest.raises(RigError, match=r"a period of .* s: this trigger source makes"):
            fitted(train(period * tick_s, 0.0, narrowest * tick_s), bounds)
    with pytest.raises(RigError, match=r"the projector's pulse is .* s wide: make it .* s or more"):
        fitted(train(lowest * tick_s, 0.0, (narrowest - 1) * tick_s), bounds)


def test_what_is_written_as_a_decimal_is_that_decimal():
    """In floats, 3e-7 / 1e-8 is under 30 and 1.1e-6 / 1e-7 over 11."""
    assert 3e-7 / 1e-8 < 30
    asked = train(1e-6, 3e-7, 6.8e-7)
    assert fitted(asked, limits(1e-8)) == asked


def test_times_between_ticks_go_to_the_nearest():
    made = fitted(train(1 / 60, 1e-3, 1.23456e-3), limits(0.5e-6))
    assert made.period_s == 0.0166665
    assert made.camera == Pulse(1e-3, 1.2345e-3)
    for asked, kept in ((1 / 60, made.period_s), (1.23456e-3, made.camera.width_s)):
        assert abs(asked - kept) <= 0.25e-6 + 1e-12


@pytest.mark.parametrize(
    "count, right", [(1, True), (1000, True), (None, True), (0, False), (-1, False), (1001, False)]
)
def test_pulses_a_burst(count, right):
    asked = train(1e-3, 0.0, 1e-4, count)
    if right:
        assert fitted(asked, limits(1e-6)).count == count
    else:
        with pytest.raises(RigError, match=rf"{count} pulses a burst: this trigger source makes 1 to 1000"):
            fitted(asked, limits(1e-6))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("place", range(3))
def test_what_is_no_time_is_refused(bad, place):
    times = [1e-3, 0.0, 1e-4]
    times[place] = bad
    with pytest.raises(RigError, match=r"is .* s: give a number of seconds"):
        fitted(train(*times), limits(1e-6))


def test_a_delay_below_nothing_is_refused_and_a_float_that_means_zero_is_not():
    with pytest.raises(RigError, match=r"the camera's delay is -0.001 s: it must not be negative"):
        fitted(train(1e-2, -1e-3, 1e-4), limits(1e-6))
    assert fitted(train(1e-2, -1e-18, 1e-4), limits(1e-6)).camera.delay_s == 0.0
