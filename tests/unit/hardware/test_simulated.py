"""Simulated instruments: pulses that come at their times, exposures that are too soon, frames that are too many."""

import time

import numpy as np
import pytest

from hardware.errors import CameraError, TriggerError
from hardware.protocols import FrameFormat
from hardware.pulses import Pulse, PulseTrain
from hardware.settings import RigSettings
from hardware.simulated import MemoryCamera, SimulatedInstruments, SimulatedTrigger

TRAIN = PulseTrain(0.004, 5, Pulse(0.0, 1e-4), Pulse(0.001, 1e-4))


def memory_camera(**options):
    return MemoryCamera(lambda time_s: np.zeros((4, 6, 3), np.uint8), (6, 4), FrameFormat("rgb"), 1e-3, **options)


def ended(trigger):
    deadline_s = time.monotonic() + 10
    while trigger.status().running:
        assert time.monotonic() < deadline_s
        time.sleep(0.001)
    return trigger.status()


def test_pulses_have_the_times_of_a_clock_that_keeps_them():
    """However late this machine makes the calls."""
    trigger = SimulatedTrigger()
    seen = {"projector": [], "camera": []}
    trigger.projector, trigger.camera = seen["projector"].append, seen["camera"].append
    assert trigger.configure(TRAIN) == TRAIN
    trigger.arm()
    trigger.fire()
    assert ended(trigger).pulses == 5
    for times_s, delay_s in ((seen["projector"], 0.0), (seen["camera"], 0.001)):
        np.testing.assert_allclose(np.diff(times_s), 0.004, atol=1e-9)
        assert times_s[0] - seen["projector"][0] == pytest.approx(delay_s, abs=1e-9)


def test_an_endless_train_ends_when_it_is_told_to():
    trigger = SimulatedTrigger()
    trigger.configure(PulseTrain(0.002, None, TRAIN.projector, TRAIN.camera))
    trigger.fire()
    assert trigger.status().running
    trigger.abort()
    n_pulses = trigger.status().pulses
    time.sleep(0.01)
    assert not trigger.status().running and trigger.status().pulses == n_pulses


def test_what_was_not_configured_cannot_be_fired():
    trigger = SimulatedTrigger()
    for call in (trigger.arm, trigger.fire):
        with pytest.raises(TriggerError, match="configure it first"):
            call()


def test_a_pulse_during_exposure_or_read_out_is_lost_without_a_word():
    strobes = []
    camera = memory_camera(readout_s=2e-3, strobe=strobes.append)
    camera.pulse(0.0)  # not armed
    camera.arm(3)
    for time_s in (1.0, 1.0029, 1.0031, 1.02):
        camera.pulse(time_s)
    assert strobes == [1.0, 1.0031, 1.02]
    frames = [camera.frame(1.0) for _ in range(3)]
    assert [frame.frame_id for frame in frames] == [0, 1, 2]
    assert [frame.device_time_s for frame in frames] == strobes
    assert camera.frame(0.0) is None


def test_frames_that_nobody_takes_are_lost_from_the_last_one_on():
    camera = memory_camera(readout_s=0.0)
    camera.arm(None)
    for number in range(200):
        camera.pulse(float(number))
    kept = []
    while (frame := camera.frame(0.01)) is not None:
        kept.append(frame.frame_id)
    assert kept == list(range(128))


def test_it_is_triggered_by_pulses_only():
    with pytest.raises(CameraError, match=r'set camera\.trigger to another than "software"'):
        memory_camera().trigger()


def test_a_wall_is_dimmer_in_every_other_picture_and_exposures_are_wired_back():
    settings = RigSettings.model_validate(
        {
            "trigger": {"driver": "simulated", "strobe": True, "vsync": "per-pulse"},
            "timing": {"period_s": 0.01, "frames": 4},
            "camera": {"driver": "simulated", "exposure_s": 1e-3, "size_px": [48, 32]},
        }
    )
    devices = SimulatedInstruments.before_a_wall(settings)
    devices.trigger.configure(PulseTrain(0.01, 4, TRAIN.projector, TRAIN.camera))
    devices.camera.arm(4)
    devices.trigger.arm()
    devices.trigger.fire()
    levels = [devices.camera.frame(5.0).image.mean() for _ in range(4)]
    status = ended(devices.trigger)
    assert (status.pulses, status.strobes, status.vsyncs) == (4, 4, 4)
    assert [strobe.pulse for strobe in devices.trigger.strobes()] == [0, 1, 2, 3]
    np.testing.assert_allclose(np.array(levels[::2]) / levels[1::2], 0.85, atol=0.01)
