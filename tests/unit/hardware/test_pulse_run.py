"""How far a run's frames were taken, and which frames came twice."""

from dataclasses import replace

import numpy as np
import pytest

from hardware.protocols import CameraFrame, TriggerStatus
from hardware.pulse_run import Run, is_left_over, repeats
from hardware.pulses import Pulse, PulseTrain
from hardware.run_start import start_of

PERIOD_S = 0.02
TRAIN = PulseTrain(PERIOD_S, None, Pulse(0.0, 1e-4), Pulse(0.0, 1e-4))


def frame_of(number, late_s=0.0, seed=None):
    image = np.random.default_rng(number if seed is None else seed).integers(90, 110, (4, 4, 3), np.uint8)
    return CameraFrame(image, 100.0 + number * PERIOD_S + 0.01 + late_s, number, 7.0 + number * PERIOD_S)


def test_the_start_keeps_pace_with_this_machines_clock():
    """By 1 % of the time at most, however late frames come: that much two clocks differ."""
    counted = start_of([frame_of(0)], 0, PERIOD_S, (100.0, 100.001))
    run = Run(TRAIN, TriggerStatus(False), (100.0, 100.001), counted)
    run.take([frame_of(number, late_s=1e-4) for number in range(10)])
    assert run.fired_at_s == pytest.approx((100.0001, 100.0011))
    run.take([frame_of(number, late_s=5.0) for number in range(10, 20)])
    assert run.fired_at_s == pytest.approx((100.0021, 100.0031))
    assert run.next_pulse == 20 and run.previous.frame_id == 19


def test_a_frame_comes_twice_under_one_number():
    frame = frame_of(3)
    assert repeats(replace(frame, host_time_s=0.0), frame)
    assert repeats(replace(frame, image=None), frame)
    assert not repeats(frame_of(4), frame)
    assert not repeats(replace(frame, frame_id=None), replace(frame, frame_id=None))
    assert not repeats(frame, None)


def test_numbers_that_begin_anew_are_no_frame_that_comes_twice():
    frame = frame_of(0)
    assert not repeats(replace(frame, device_time_s=9.0), frame)
    assert not repeats(frame_of(0, seed=5), frame)


def test_a_frame_of_the_run_before():
    frame = replace(frame_of(0), device_time_s=None)
    assert is_left_over(replace(frame, host_time_s=0.0), frame)
    assert not is_left_over(replace(frame_of(0, seed=5), device_time_s=None), frame)
    assert not is_left_over(frame, replace(frame, frame_id=4))
    assert not is_left_over(frame, None)
