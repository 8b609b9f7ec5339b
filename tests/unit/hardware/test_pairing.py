"""Which pulse a frame belongs to, from evidence written down by hand."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest

from hardware.alternating_pictures import Alternation
from hardware.pairing import Evidence, FaultKey, find_faults
from hardware.protocols import CameraFrame, Strobe, TriggerStatus
from hardware.pulses import Pulse, PulseTrain
from hardware.run_start import start_of

PERIOD_S, COUNT, EXPOSURE_S = 0.02, 5, 5e-3
TRAIN = PulseTrain(PERIOD_S, COUNT, Pulse(0.0, 1e-4), Pulse(1e-3, 1e-4))


def frame_of(number, **changed):
    """Return the frame of a pulse: exposed 1 ms after it, there 10 ms later."""
    exposed_s = number * PERIOD_S + 1e-3
    image = np.random.default_rng(number).integers(90, 110, (4, 4, 3), np.uint8)
    return replace(CameraFrame(image, 100.0 + exposed_s + 0.01, 40 + number, 7.0 + exposed_s), **changed)


FRAMES = [frame_of(number) for number in range(COUNT)]
STROBES = [Strobe(number, number * PERIOD_S + 1e-3) for number in range(COUNT)]


def evidence(frames=FRAMES, strobes=STROBES, **changed):
    """Return what is known of a burst in which all went well, except for what is changed."""
    return Evidence(
        **{
            "train": TRAIN,
            "by_software": False,
            "first_pulse": 0,
            "count": COUNT,
            "exposure_s": EXPOSURE_S,
            "jitter_s": 0.0,
            "fired_at_s": (100.0, 100.001),
            "quickest_s": 0.001,
            "clock": 1e-4,
            "counted": None,
            "frames": frames,
            "ahead": [],
            "previous": None,
            "least_arrival_s": None,
            "armed": TriggerStatus(False, boot=1),
            "ended": TriggerStatus(False, COUNT, None if strobes is None else len(strobes), boot=1),
            "strobe_wired": True,
            "strobes": strobes,
            "strobe_delay_s": None,
            "picture_a_pulse": False,
            **changed,
        }
    )


def said(seen):
    return [str(fault) for fault in find_faults(seen)]


@pytest.mark.parametrize("wired", [True, False])
def test_a_whole_burst_is_beyond_doubt(wired):
    assert said(evidence(strobe_wired=wired, **({} if wired else {"strobes": None}))) == []


def test_the_missing_exposure_names_the_pulse_and_the_cable():
    frames = [frame_of(number) for number in (0, 1, 3, 4)]
    strobes = [Strobe(number, number * PERIOD_S + 1e-3) for number in (0, 1, 3, 4)]
    assert said(evidence(frames, strobes))[0].startswith(
        "pulse 2: 4 exposures to 5 pulses: the camera's trigger cable lost it"
    )


def test_an_exposure_whose_frame_is_missing_is_the_data_cables():
    (fault,) = said(evidence([frame_of(number) for number in (0, 1, 3, 4)]))[:1]
    assert fault.startswith("pulse 2: only 4 frames of 5 exposures arrived: check the camera's data cable")


def test_an_exposure_between_two_pulses_was_made_by_something_else():
    strobes = [Strobe(number, number * PERIOD_S + 1e-3 + 0.4 * PERIOD_S * (number == 3)) for number in range(COUNT)]
    (fault,) = said(evidence(strobes=strobes))
    assert fault.startswith("pulse 3: its exposure is off by 0.40 periods: no pulse made it")


def test_a_frame_by_another_clock_than_its_neighbours_is_named():
    frames = [frame_of(number) for number in range(COUNT)]
    frames[2] = replace(frames[2], device_time_s=frames[2].device_time_s + 0.2 * PERIOD_S)
    assert any(fault.startswith("pulse 2: its frame is 1.20 periods after") for fault in said(evidence(frames)))


def keys(frames, **changed):
    return {fault.key for fault in find_faults(evidence(frames, **changed))}


@pytest.mark.parametrize("tick_s", [1e-6, 1e-7, 8e-9])
def test_a_clock_that_goes_back_is_not_blamed_on_a_cable(tick_s):
    """By 2^32 of its ticks it has wrapped; by anything else it was set."""
    frames = [frame_of(number) for number in range(COUNT)]
    back = [replace(frame, device_time_s=frame.device_time_s - 2**32 * tick_s) for frame in frames[2:]]
    assert keys([*frames[:2], *back]) == {"clock wrapped"}
    back = [replace(frame, device_time_s=frame.device_time_s - 3.0) for frame in frames[2:]]
    assert keys([*frames[:2], *back]) == {"clock set back"}
    assert keys(frames) == set()


def test_frames_that_are_broken_skipped_or_shown_twice():
    frames = [frame_of(number) for number in range(COUNT)]
    frames[1] = replace(frames[1], image=None, fault="missing packets")
    frames[3] = replace(frames[3], frame_id=50)
    frames[4] = replace(frames[4], image=frames[3].image, frame_id=51)
    assert said(evidence(frames)) == [
        "pulse 1: its frame is not whole (missing packets): check the camera's data cable and its bandwidth",
        "pulse 3: frame 50 follows frame 42: check the camera's data cable and its bandwidth",
        "pulse 4: its frame is the one before once more, to the last bit: the camera or its driver delivers frames "
        "twice; switch it off and on",
    ]
    assert "one level" not in keys(frames)
    dark = [frame_of(number, image=np.zeros((4, 4, 3), np.uint8)) for number in range(COUNT)]
    assert keys(dark) == {"one level"}


def test_a_trigger_source_that_restarted_or_complains_comes_first():
    status = TriggerStatus(False, 3, COUNT, boot=2, complaints=("an output did not follow",))
    assert said(evidence(ended=status))[:2] == [
        "the trigger source restarted in mid-burst: check its power supply",
        "the trigger source says: an output did not follow",
    ]


def test_pictures_that_were_not_shown():
    status = TriggerStatus(False, COUNT, COUNT, 3, boot=1)
    assert "the projector reported 3 pictures to 5 pulses: check its trigger cable" in said(
        evidence(ended=status, picture_a_pulse=True)
    )


def test_jitter_widens_what_is_allowed_but_not_to_a_period():
    assert evidence().tolerance == pytest.approx(0.05)
    assert evidence(jitter_s=1e-3).tolerance == pytest.approx(0.15)
    assert evidence(jitter_s=1.0).tolerance == pytest.approx(0.45)


@pytest.mark.parametrize("count", [1, 5])
def test_exposures_without_a_single_frame_name_the_data_cable(count):
    """Bursts of one frame are the default."""
    strobes = [Strobe(number, number * PERIOD_S + 1e-3) for number in range(count)]
    seen = evidence([], strobes, train=replace(TRAIN, count=count), count=count)
    seen = replace(seen, ended=TriggerStatus(False, count, count, boot=1))
    assert said(seen) == [
        f"pulse 0: no frame of {count} exposures arrived: check the camera's data cable and its bandwidth"
    ]


def test_a_single_exposure_that_comes_later_than_in_bursts_before():
    seen = evidence([frame_of(0)], [Strobe(0, 1e-3 + 0.4 * PERIOD_S)], train=replace(TRAIN, count=1), count=1)
    seen = replace(seen, ended=TriggerStatus(False, 1, 1, boot=1))
    assert said(seen) == []
    (fault,) = said(replace(seen, strobe_delay_s=1e-3))
    assert fault.startswith("pulse 0: its exposure is off by 0.40 periods: no pulse made it")


def test_triggers_that_the_camera_ignored():
    frames = [frame_of(number, triggers=1 + number + 2 * (number > 2)) for number in range(COUNT)]
    (fault,) = said(evidence(frames))
    assert fault.startswith("pulse 3: the camera ignored 2 triggers before it: the period is too short")


@pytest.mark.parametrize("strobes", [True, False])
def test_frames_that_arrive_late_are_followed_by_their_numbers_where_exposures_are_counted(strobes):
    """Pulses run on, the camera has no clock, and the last two frames come a period late."""
    frames = [
        frame_of(number, device_time_s=None, host_time_s=frame_of(number).host_time_s + PERIOD_S * (number > 2))
        for number in range(COUNT)
    ]
    seen = evidence(frames, train=replace(TRAIN, count=None), **({} if strobes else {"strobe_wired": False}))
    seen = seen if strobes else replace(seen, strobes=None)
    faults = find_faults(seen)
    assert [fault.may_pass for fault in faults] == ([] if strobes else [True])
    # Frames that come after in their time show that nothing was lost.
    ahead = [frame_of(COUNT, device_time_s=None)]
    assert find_faults(replace(seen, ahead=ahead)) == []


ENDED = TriggerStatus(False, COUNT, COUNT, boot=1)
LATE = [replace(frame, host_time_s=frame.host_time_s + 0.03 * (number > 1)) for number, frame in enumerate(FRAMES)]
UNWIRED = {"strobe_wired": False, "strobes": None}


def but(items, number, **changes):
    """Return all items, one of them changed or left out."""
    return [*items[:number], *([replace(items[number], **changes)] if changes else []), *items[number + 1 :]]


def clock(number, change_s):
    """Return frames whose camera's clock is set by a time, s, before one of them."""
    times = [frame.device_time_s + change_s * (n >= number) for n, frame in enumerate(FRAMES)]
    return [replace(frame, device_time_s=time_s) for frame, time_s in zip(FRAMES, times, strict=True)]


def shown(*levels):
    """Return the keys of what speaks against the first two frames, and the others, being shown in turns."""
    frames = [frame_of(number, image=np.full((16, 16, 3), level, np.uint8)) for number, level in enumerate(levels)]
    pictures = Alternation()
    return {fault.key for fault in (*pictures.start(frames[:2]), *pictures.check(frames[2:], 2))}


#: By their keys: a burst with the fault, and what comes with it; nothing else may be said.
FAULTS = {
    "before its exposure": (lambda: keys(but(FRAMES, 0, host_time_s=100.0)), set()),
    "camera busy": (
        lambda: keys(FRAMES[::2], strobes=STROBES[::2], count=6, ended=ENDED),
        {"frame late", "frames lost"},
    ),
    "clock set back": (lambda: keys(clock(2, -3.0)), set()),
    "clock wrapped": (lambda: keys(clock(2, -(2**32) * 1e-6)), set()),
    "computer busy": (lambda: keys(but(LATE, 2)), {"frame late"}),
    "exposure off its pulse": (lambda: keys(FRAMES, strobes=but(STROBES, 3, time_s=0.07)), set()),
    "exposures missing": (lambda: keys(but(FRAMES, 2), strobes=but(STROBES, 2)), {"frame late", "frames lost"}),
    "frame early": (lambda: keys(clock(2, -0.2 * PERIOD_S)), set()),
    "frame late": (lambda: keys(clock(2, 0.2 * PERIOD_S)), set()),
    "frame not whole": (lambda: keys(but(FRAMES, 1, image=None, fault="missing packets")), set()),
    "frames lost": (lambda: keys(but(FRAMES, 2)), {"frame late"}),
    "frames missing": (lambda: keys(but(FRAMES, 2), **UNWIRED), {"frame late", "frames lost"}),
    "frames shifted": (
        lambda: keys(
            [replace(frame, device_time_s=None) for frame in LATE], train=replace(TRAIN, count=None), **UNWIRED
        ),
        set(),
    ),
    "light changed": (lambda: shown(100, 120, 100, 120, 150), set()),
    "no alternating pictures": (lambda: shown(100, 100, 100, 120), set()),
    "no frame": (lambda: keys([], **UNWIRED), set()),
    "no frame, no picture": (
        lambda: keys([], strobes=[], picture_a_pulse=True, ended=replace(ENDED, strobes=0, vsyncs=0)),
        {"no frame", "pictures missing"},
    ),
    "one level": (lambda: keys([replace(frame, image=np.zeros((4, 4, 3), np.uint8)) for frame in FRAMES]), set()),
    "picture missing": (lambda: shown(100, 120, 100, 100), set()),
    "pictures missing": (lambda: keys(FRAMES, picture_a_pulse=True, ended=replace(ENDED, vsyncs=3)), set()),
    "pulses missing": (lambda: keys(FRAMES, ended=replace(ENDED, pulses=3)), set()),
    "same frame": (lambda: keys(but(FRAMES, 3, image=FRAMES[2].image)), set()),
    "slow start": (
        lambda: keys(
            FRAMES, counted=start_of(FRAMES, 0, PERIOD_S, (100.0, 100.001)), fired_at_s=(100 - PERIOD_S, 100.0)
        ),
        set(),
    ),
    "strobe": (lambda: keys(FRAMES, strobes=but(STROBES, 2)), set()),
    "too many exposures": (lambda: keys(FRAMES, strobes=[*STROBES, Strobe(2, 0.05)]), set()),
    "too many frames": (lambda: keys([*FRAMES, frame_of(COUNT)]), set()),
    "trigger complains": (lambda: keys(FRAMES, ended=replace(ENDED, complaints=("an output did not follow",))), set()),
    "trigger ignored": (lambda: keys([replace(f, triggers=n + 2 * (n > 2)) for n, f in enumerate(FRAMES)]), set()),
    "trigger restarted": (lambda: keys(FRAMES, ended=replace(ENDED, boot=2)), set()),
}
#: What the rig says itself: `tests/system/hardware/test_rig.py`.
OF_THE_RIG = {"computer behind", "instrument failed", "uneven latency"}


@pytest.mark.parametrize("key", sorted({*get_args(FaultKey)} - OF_THE_RIG))
def test_a_fault_is_named_where_it_is_and_nowhere_else(key):
    named, with_it = FAULTS[key]
    assert named() == {key, *with_it}
