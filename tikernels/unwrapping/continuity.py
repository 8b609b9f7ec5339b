"""Continuity of a surface from one pixel to the next, and the weight of a pixel's vote on it.

Along and across the stripes the phase usually changes by the frame's rates. A neighbour whose difference departs from
the rate, whole cycles apart, by more than `MAX_DEPARTURE` lies on another surface; one that departs by little, and is
as bright, surely lies on the same.
"""

from tikernels._taichi import F32Array2, I32Array2, f32, i32, ivec2, ti, u1
from tikernels.phase.phase_change import MEAN_QUALITY, RATE_ACROSS, RATE_ALONG
from tikernels.phase.phase_vector import PI
from tikernels.phase.smoothing import MAX_DEPARTURE

# Inside a patch neighbours depart by less than this (rad) and differ in modulation by less than this factor, along and
# across the stripes. A step that hides behind whole cycles seldom does both, and only patches are never cut again.
# Across, slopes change the phase more, and a response that is not linear lets the modulation swing three times per
# cycle.
_SURE_ALONG, _ALIKE_ALONG = 0.25, 0.75
_SURE_ACROSS, _ALIKE_ACROSS = 0.5, 0.5


@ti.func
def frame_rates(rates: F32Array2):
    """Return the usual changes along and across the stripes, rad per px, and the mean quality."""
    last = rates.shape[0] - 1
    return rates[last, RATE_ALONG], rates[last, RATE_ACROSS], rates[last, MEAN_QUALITY]


@ti.func
def cycles_and_departure(difference: f32, rate: f32):
    """Return the whole cycles between two wrapped phases, and how far the rest of their difference is off the rate.

    The cycles are those that bring the difference nearest to the usual change. What is no phase departs by far more
    than any phase.
    """
    excess = difference - rate
    cycles = ti.cast(excess < -PI, ti.i32) - ti.cast(excess > PI, ti.i32)
    return cycles, ti.abs(excess + 2.0 * PI * ti.cast(cycles, ti.f32))


@ti.func
def surely_along(departs: f32, quality: f32, quality2: f32) -> u1:
    """Return whether a pixel surely continues the one before it in the row."""
    low, high = ti.min(quality, quality2), ti.max(quality, quality2)
    differ = low < _ALIKE_ALONG * high  # false where the quality is missing
    return (departs <= _SURE_ALONG) & (not differ)


@ti.func
def surely_across(departs: f32, quality: f32, quality2: f32) -> u1:
    """Return whether a pixel surely continues the one above it."""
    low, high = ti.min(quality, quality2), ti.max(quality, quality2)
    return (departs <= _SURE_ACROSS) & (low > _ALIKE_ACROSS * high)


@ti.func
def vote_weight(departs: f32, quality: f32, quality2: f32, mean_quality: f32) -> i32:
    """Weight of one pixel's vote, 1 to 64: the phase goes on, and so does the brightness, which is not low.

    A step that hides behind whole cycles has any departure at each of its pixels and seldom joins two equally bright
    surfaces.
    """
    low, high = ti.min(quality, quality2), ti.max(quality, quality2)
    going_on = 1.0 - departs / MAX_DEPARTURE
    alike = low / ti.max(high, 1e-12)
    return 1 + ti.cast(63.0 * going_on * going_on * alike * alike * ti.min(4.0 * low / mean_quality, 1.0), ti.i32)


@ti.func
def vote_above(phase: F32Array2, quality: F32Array2, labels: I32Array2, y: i32, x: i32, order: i32, rate: f32) -> ivec2:
    """Vote for what turns this run's orders into labels, so that the pixel continues the one above; then 1 if sure.

    -1: no vote across a step. The row above holds labels already.
    """
    vote = ti.Vector([-1, 0])
    above = labels[y - 1, x]
    if above >= 0:
        difference = phase[y, x] - phase[y - 1, x]
        cycles, departs = cycles_and_departure(difference, rate)
        if departs <= MAX_DEPARTURE:
            sure = surely_across(departs, quality[y, x], quality[y - 1, x])
            vote = ti.Vector([above + cycles - order, ti.cast(sure, ti.i32)])
    return vote
