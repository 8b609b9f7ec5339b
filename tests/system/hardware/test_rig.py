import math
import re
import time
from dataclasses import replace
from itertools import count, islice

import pytest
from support.faulty_rigs import FRAMES, PERIOD_S, Bench, Faulty, settings

from hardware import rig as rig_module
from hardware.errors import BurstError, CameraError, TriggerError
from hardware.rig import Burst
from hardware.run_start import Start

one = frozenset({2})


def burst_of(bench: Bench, **kwargs: bool) -> Burst:
    with bench.rig() as rig:
        return next(rig.bursts(**kwargs))


def test_the_order_of_calls():
    """The camera waits before the first pulse comes, and everything is stopped before a port is let go."""
    bench = Bench(settings(alternating=False))
    with bench.rig() as rig:
        for _ in islice(rig.bursts(), 1):
            pass
    calls = [call for i, call in enumerate(bench.calls) if i == 0 or bench.calls[i - 1] != call]
    assert calls[:2] == ["trigger.configure", "camera.arm"]
    started = len(calls) - calls[::-1].index("camera.arm")  # a start in doubt, on a busy machine, is repeated
    assert calls[started:] == [
        "trigger.arm",
        "trigger.status",
        "trigger.fire",
        "camera.frame",
        "trigger.status",
        "camera.frame",
        "trigger.strobes",
        "camera.disarm",
        "trigger.abort",
        "camera.disarm",
        "trigger.close",
        "camera.close",
    ]


@pytest.mark.parametrize("endless", [False, True])
@pytest.mark.parametrize("alternating", [False, True])
def test_bursts_are_whole_and_numbered(endless, alternating):
    bench, began_s = Bench(settings(alternating=alternating)), time.monotonic()
    with bench.rig() as rig:
        bursts = list(islice(rig.bursts(endless=endless), 4))
        wrong = [bench.mispaired(burst) for burst in bursts] if endless else [bench.mispaired(bursts[-1])]
    assert not any(wrong)
    assert not bench.rejected
    pulses = [paired.pulse for burst in bursts for paired in burst.frames]
    assert pulses == list(range(4 * FRAMES)) if endless else pulses == 4 * list(range(FRAMES))
    assert [burst.number for burst in bursts] == ([0] * 4 if endless else [0, 1, 2, 3])
    for burst in bursts:
        for paired in burst.frames:
            assert paired.strobe_s == pytest.approx(paired.pulse * PERIOD_S + 2e-4, abs=1e-9)
            # Pulses began somewhere in the start command, on a busy machine late in it.
            assert began_s < paired.exposed_at_s < paired.frame.host_time_s + max(rig._starts_s) / 2 + 5e-3


# A machine that is busy while these tests run takes other frames late, too.
LOST = "(check the camera's data cable|let nothing else keep this machine busy)"
FAULTS = {
    "lost trigger": (Faulty(lost_trigger=one), r"pulse 2: 5 exposures to 6 pulses: the camera's trigger cable lost it"),
    "noise": (Faulty(noise=one), r"exposures, and not one to every one of 6 pulses: no pulse made it"),
    "late noise": (Faulty(late_noise=one), r"pulse 3: 6 exposures, and not one to every one of 6 pulses"),
    "lost and noise": (Faulty(lost_trigger=one, noise=frozenset({4})), r"pulse 2: 6 exposures, and not one to every"),
    "lost picture": (Faulty(lost_picture=one), r"pulse 2: its frame shows the picture before.*projector's trigger"),
    "first picture lost": (Faulty(lost_picture=frozenset({0})), r"pulse 0: its frame shows the picture before"),
    "extra picture": (Faulty(extra_picture=one), r"pulse 2: its frame shows the picture before"),
    "lost strobe": (Faulty(lost_strobe=one), r"pulse 2: 5 exposures were counted for 6 frames: check the strobe cable"),
    "extra strobe": (Faulty(extra_strobe=one), r"7 exposures, and not one to every one of 6 pulses"),
    "lost frame": (Faulty(lost_frame=one), rf"pulse 2: .*{LOST}"),
    "last frame lost": (Faulty(lost_frame=frozenset({5})), rf"pulse 5: .*{LOST}"),
    "broken frame": (Faulty(broken_frame=one), r"pulse 2: its frame is not whole \(missing packets\)"),
    "cloned frame": (Faulty(cloned_frame=one), r"pulse 3: its frame is the one before once more"),
    "restart": (Faulty(restart=3), r"the trigger source restarted in mid-burst: check its power"),
    "trigger unplugged": (Faulty(unplugged_trigger=2), r"the cable is out"),
    "camera unplugged": (Faulty(unplugged_camera=2), r"the cable is out"),
}


@pytest.mark.parametrize("endless", [False, True])
@pytest.mark.parametrize("name", FAULTS)
def test_every_fault_is_seen_and_the_burst_repeated(name, endless):
    """The first burst suffers the fault, the second is whole."""
    fault, message = FAULTS[name]
    bench = Bench(settings(), [Faulty(), fault])  # the first run is the one by which the pictures are learned
    with bench.rig() as rig:
        burst = next(rig.bursts(endless=endless))
        assert bench.mispaired(burst) == []
    (rejected,) = bench.rejected
    assert rejected.attempt == 1
    assert re.search(message, str(rejected.faults[0])), str(rejected.faults[0])
    assert bench.n_opened == (2 if "unplugged" in name else 1)
    assert (rejected.faults[0].key == "instrument failed") == ("unplugged" in name)


@pytest.mark.parametrize("endless", [False, True])
@pytest.mark.parametrize(
    "fault, surplus", [(Faulty(lost_picture=frozenset({1, 3})), -2), (Faulty(extra_picture=frozenset({1, 3})), 2)]
)
def test_pictures_that_are_reported_tell_of_a_lost_pulse(fault, surplus, endless):
    bench = Bench(settings(alternating=False, vsync="per-pulse"), [*endless * [Faulty()], fault])
    with bench.rig() as rig:
        assert bench.mispaired(next(rig.bursts(endless=endless))) == []
    told = re.search(r"the projector reported (\d+) pictures to (\d+) pulses", str(bench.rejected[0].faults[0]))
    pictures, pulses = map(int, told.groups())
    assert pulses == 6 or (endless and pulses > 6)  # pulses that run on are counted on until they are asked for
    assert pictures - pulses == surplus


@pytest.mark.parametrize("endless", [False, True])
def test_exposures_too_many_to_be_remembered_are_counted(endless):
    """The trigger source forgets every other one; one that the camera did not make is noticed all the same."""
    plan = [*endless * [Faulty()], Faulty(lost_trigger=frozenset({4}))]
    bench = Bench(settings(alternating=False), plan)
    with bench.rig() as rig:
        trigger = bench.devices.trigger
        remembered = trigger.strobes
        trigger.strobes = lambda: remembered()[::2]
        bursts = list(islice(rig.bursts(endless=endless), 2))
        assert bench.mispaired(bursts[-1]) == []
    assert len(bench.rejected) == 1
    assert re.search("exposures to|2.00 periods after", str(bench.rejected[0].faults[0]))
    assert {paired.strobe_s for burst in bursts for paired in burst.frames} == {None}


def test_a_camera_that_is_triggered_too_fast_is_told_so():
    """It takes every other pulse, as real ones do, which the period's check could not know."""
    bench = Bench(settings(alternating=False), [Faulty(lost_trigger=frozenset({1, 3, 5}))])
    assert bench.mispaired(burst_of(bench)) == []
    assert "misses pulses regularly (3 exposures to 6)" in str(bench.rejected[0].faults[0])


def test_a_cable_that_is_not_there_is_named():
    bench = Bench(settings(alternating=False), [Faulty(lost_trigger=frozenset(range(9)))])
    assert bench.mispaired(burst_of(bench)) == []
    assert "no exposure was seen, and no frame came: check the camera's trigger cable" in str(
        bench.rejected[0].faults[0]
    )


def test_two_cables_that_are_not_there_are_named():
    every = frozenset(range(9))
    bench = Bench(settings(alternating=False, vsync="per-pulse"), [Faulty(lost_trigger=every, lost_picture=every)])
    assert bench.mispaired(burst_of(bench)) == []
    assert "neither a frame nor a picture came: check both trigger cables" in str(bench.rejected[0].faults[0])


def test_what_the_trigger_source_says_comes_before_the_pulses_that_it_did_not_make(monkeypatch):
    bench = Bench(settings(alternating=False))
    with bench.rig() as rig:
        trigger = bench.devices.trigger
        status = trigger.status
        said = iter([status])  # the first is before the burst

        def shorted():
            ask = next(said, lambda: replace(status(), pulses=3, complaints=("an output did not follow",)))
            return ask()

        monkeypatch.setattr(trigger, "status", shorted)
        with pytest.raises(BurstError, match="the trigger source says: an output did not follow"):
            next(rig.bursts())


@pytest.mark.parametrize(
    "fault, message",
    [
        (Faulty(lost_trigger=one), "pulse 2: 5 frames to 6 pulses: the camera's trigger cable"),
        (
            Faulty(lost_frame=one),
            "pulse 2: 5 frames to 6 pulses: the camera's trigger cable lost it, or the camera was",
        ),
        (Faulty(noise=one), "7 frames to 6 pulses: no pulse made it"),
        (Faulty(late_noise=one), "pulse 3: its frame is 0.80 periods after the one before: no pulse made it"),
        (Faulty(lost_trigger=one, noise=frozenset({4})), "pulse 2: its frame is 2.00 periods after the one before"),
    ],
)
def test_without_strobes_the_cameras_clock_tells(fault, message):
    bench = Bench(settings(strobe=False, alternating=False), [fault])
    assert bench.mispaired(burst_of(bench)) == []
    assert message in str(bench.rejected[0].faults[0])


def test_without_clocks_their_count_tells():
    for fault, message in (
        (Faulty(lost_trigger=one), "5 frames to 6 pulses: the camera's trigger cable lost it, or the camera was"),
        (Faulty(noise=one), "7 frames to 6 pulses: no pulse made it"),
    ):
        bench = Bench(settings(strobe=False, alternating=False), [fault], clocks=False)
        assert bench.mispaired(burst_of(bench)) == []
        assert message in str(bench.rejected[0].faults[0])


@pytest.mark.parametrize("endless", [False, True])
def test_what_is_late_or_comes_twice_is_no_fault(endless):
    bench = Bench(settings(), [Faulty(), Faulty(late_frame=one, repeated_frame=frozenset({1, 4}))])
    with bench.rig() as rig:
        burst = next(rig.bursts(endless=endless))
        assert bench.mispaired(burst) == []
    assert not bench.rejected
    assert burst.n_repeated == 2


@pytest.mark.parametrize(("limit_s", "named"), [(-math.inf, ["computer behind"]), (math.inf, [])])
def test_a_machine_that_is_behind_is_named_before_what_it_lost(monkeypatch, limit_s, named):
    monkeypatch.setattr(rig_module, "_BEHIND_S", limit_s)
    bench = Bench(settings(alternating=False), [Faulty(lost_trigger=one)])
    assert bench.mispaired(burst_of(bench)) == []
    assert [fault.key for fault in bench.rejected[0].faults] == [*named, "exposures missing", "frame late"]


@pytest.mark.parametrize(("step_s", "key"), [(0.01, "uneven latency"), (0.0001, None)])
def test_a_latency_that_varies_is_refused(step_s, key):
    """Of a camera without a clock, whose frames take longer by so much from one start to the next."""
    starts = (Start(arrival_s, None, None, None, 0.0) for arrival_s in count(1.0, step_s))
    found = None
    with Bench(settings(alternating=False)).rig() as rig:
        rig._counted = lambda train: next(starts)
        try:
            rig._fire(endless=True)
        except rig_module._Refused as refused:
            found = refused.faults[0].key
    assert found == key


def test_three_tries_then_an_error_that_names_pulse_and_cable():
    bench = Bench(settings(alternating=False), 3 * [Faulty(lost_trigger=one)])
    with (
        bench.rig() as rig,
        pytest.raises(BurstError, match=r"burst 0 was not whole in 3 tries; pulse 2: .*trigger cable"),
    ):
        next(rig.bursts())
    assert [rejected.attempt for rejected in bench.rejected] == [1, 2, 3]
    assert bench.calls[-2:] == ["trigger.close", "camera.close"]


def test_an_instrument_that_stays_away_is_an_error():
    bench = Bench(settings(alternating=False), 3 * [Faulty(unplugged_camera=1)])
    with bench.rig() as rig, pytest.raises(CameraError, match="the cable is out"):
        next(rig.bursts())
    assert bench.calls[-2:] == ["trigger.close", "camera.close"]


def test_an_instrument_that_cannot_be_opened_again_is_said_to_be_lost(monkeypatch):
    monkeypatch.setattr(rig_module, "_REOPEN_S", 0.0)
    bench = Bench(settings(alternating=False), [Faulty(unplugged_trigger=1)])

    def absent():
        raise TriggerError("there is no such port")

    with bench.rig() as rig:
        rig._open_instruments = absent
        with pytest.raises(TriggerError, match="the cable is out"):
            next(rig.bursts())
    assert [str(rejected.faults[0]) for rejected in bench.rejected][1:] == 2 * ["there is no such port"]


def test_a_trigger_source_that_hangs_is_opened_again(monkeypatch):
    monkeypatch.setattr(rig_module, "_TRANSPORT_S", 0.05)
    bench = Bench(settings(alternating=False))
    with bench.rig() as rig:
        trigger = bench.devices.trigger
        status = trigger.status
        monkeypatch.setattr(trigger, "status", lambda: replace(status(), running=True))
        assert bench.mispaired(next(rig.bursts())) == []
    assert bench.n_opened == 2
    assert "the trigger source does not end its burst" in str(bench.rejected[0].faults[0])


def test_a_cable_that_is_put_back_in_is_waited_for():
    bench = Bench(settings(alternating=False), [Faulty(unplugged_trigger=1)])
    with bench.rig() as rig:
        away = iter(2 * [True])

        def open_instruments():
            if next(away, False):
                raise TriggerError("there is no port /dev/ttyUSB0")
            return bench.open()

        rig._open_instruments = open_instruments
        assert bench.mispaired(next(rig.bursts())) == []
    assert len(bench.rejected) == 1


def test_another_instrument_in_its_place_is_refused():
    bench = Bench(settings(alternating=False), 3 * [Faulty(unplugged_camera=1)])
    with bench.rig() as rig:
        opened = bench.open

        def other():
            trigger, camera = opened()
            camera.identity = replace(camera.identity, serial="2")
            return trigger, camera

        rig._open_instruments = other
        with pytest.raises(CameraError, match="simulated camera 2 answers where colorphase simulated camera was"):
            next(rig.bursts())


def test_ctrl_c_leaves_outputs_low_and_the_camera_stopped(monkeypatch):
    bench = Bench(settings(alternating=False))
    with pytest.raises(KeyboardInterrupt), bench.rig() as rig:
        camera = bench.devices.camera

        def interrupted(timeout_s: float) -> None:
            raise KeyboardInterrupt

        monkeypatch.setattr(camera, "frame", interrupted)
        next(rig.bursts())
    assert bench.calls[-4:] == ["trigger.abort", "camera.disarm", "trigger.close", "camera.close"]


def test_a_projector_that_gets_no_pulse_is_an_error():
    bench = Bench(settings(), 3 * [Faulty(lost_picture=frozenset(range(9)))])
    with bench.rig() as rig, pytest.raises(BurstError, match="show no two pictures in turns: check the projector's"):
        next(rig.bursts())
