"""Whether the first frame of pulses that run on is the first pulse's, from starts written down by hand."""

from dataclasses import replace

import pytest

from hardware.protocols import CameraFrame
from hardware.run_start import Lateness, Start, lateness, start_of

PERIOD_S = 0.02
COUNTED = Start(arrival_s=0.011, device_s=5.0, frame_ids=(10, 13), triggers=1, fire_s=0.002)
PLAIN = replace(COUNTED, triggers=None, frame_ids=None)


def judged(now, counted=PLAIN, quickest_s=0.0, exposures_counted=False):
    return lateness(now, counted, PERIOD_S, quickest_s, exposures_counted=exposures_counted)


def later(start, device=0.0, arrival=0.0, **others):
    """Return a start that is later by so many periods."""
    device_s = None if start.device_s is None else start.device_s + device * PERIOD_S
    return replace(start, device_s=device_s, arrival_s=start.arrival_s + arrival * PERIOD_S, **others)


def test_frames_are_followed_from_before_the_command():
    frames = [
        CameraFrame(None, 10.0 + 0.02 * k + late, 7 + k, 3.0 + 0.02 * k, triggers=4 + k)
        for k, late in enumerate((0.013, 0.009, 0.030))
    ]
    start = start_of(frames, 2, PERIOD_S, (9.95, 9.951))
    assert start.arrival_s == pytest.approx(0.05 + 0.009 - 0.04)
    assert start.device_s == pytest.approx(3.0 - 9.95 - 0.04)
    assert (start.frame_ids, start.triggers) == ((7, 9), 2)
    assert start.fire_s == pytest.approx(0.001)
    assert start_of(
        [replace(frames[0], frame_id=None, device_time_s=None, triggers=None)], 0, PERIOD_S, (9.0, 9.0)
    ) == (Start(pytest.approx(1.013), None, None, None, 0.0))


@pytest.mark.parametrize("arrival", [-1.0, 0.0, 1.0, 7.0])
def test_the_cameras_clock_decides_whenever_frames_arrive(arrival):
    assert judged(later(PLAIN, device=0.05, arrival=arrival)) == Lateness(0.0)
    late = judged(later(PLAIN, device=1.0, arrival=arrival))
    assert late.periods == pytest.approx(1.0) and not late.in_doubt


def test_a_start_that_was_held_up_is_in_doubt():
    """It took longer by a period: that the first trigger was lost would look the same."""
    assert judged(later(PLAIN, device=0.6, fire_s=0.013)).in_doubt
    assert judged(PLAIN, replace(PLAIN, fire_s=0.021)).in_doubt
    assert judged(PLAIN, replace(PLAIN, fire_s=0.010)) == Lateness(0.0)


def test_what_every_start_takes_is_no_doubt():
    """A slow line: 30 ms for every command."""
    slow = replace(PLAIN, fire_s=0.030)
    assert judged(slow, slow).in_doubt
    assert judged(slow, slow, quickest_s=0.029) == Lateness(0.0)
    assert judged(later(slow, device=1.0), slow, quickest_s=0.029).periods == pytest.approx(1.0)


def test_a_clock_that_was_set_to_zero_tells_nothing():
    now = later(PLAIN, device=-30.0, arrival=0.2)
    assert judged(now) == Lateness(0.0, by_arrival=True, clock_restarted=True)
    late = judged(later(now, arrival=0.8))
    assert late.periods == pytest.approx(1.0) and late.by_arrival


def test_without_a_clock_counted_exposures_and_numbers_tell():
    counted = replace(COUNTED, device_s=None, triggers=None)
    for first in (14, 10):  # counting on, and beginning anew
        now = later(replace(counted, frame_ids=(first, first + 5)), arrival=3.0)
        assert judged(now, counted, exposures_counted=True).periods == 0.0
        assert judged(now, counted).periods == pytest.approx(3.0)
    for first in (15, 11):  # whenever they arrive: the frames of the burst before may have been late
        now = later(replace(counted, frame_ids=(first, first + 5)), arrival=0.3)
        assert judged(now, counted, exposures_counted=True).periods == 1.0
    now = later(replace(counted, frame_ids=(9000, 9005)), arrival=1.0)
    assert judged(now, counted, exposures_counted=True).periods == pytest.approx(1.0)


def test_the_cameras_count_of_triggers_comes_first():
    assert judged(replace(COUNTED, triggers=2), COUNTED).periods == 1
    assert judged(later(COUNTED, arrival=5.0), replace(COUNTED, device_s=None), exposures_counted=True).periods == 0.0
    # A trigger that never reached the camera is in no count of its own.
    assert judged(later(COUNTED, device=1.0), COUNTED).periods == pytest.approx(1.0)
