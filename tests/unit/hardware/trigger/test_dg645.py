from collections.abc import Iterator

import pytest
from support.byte_script import scripted
from support.emulators.emulated_dg645 import DG645Emulator
from support.pulse_generators import TRAIN, impatient, little_noise, run, wait

from hardware.errors import RigError, TriggerError
from hardware.link import Link
from hardware.protocols import Identity, Trigger, TriggerStatus
from hardware.pulses import Pulse, PulseTrain
from hardware.trigger.dg645 import DG645, TERMINATOR

__all__ = ["little_noise"]
pytestmark = pytest.mark.timeout(30)

OPENED = [
    (b"*IDN?\n", b"Stanford Research Systems,DG645,s/n003458,ver1.16.116\r\n"),
    (b"*CLS\n", b""),
    (b"LERR?\n", b"0\r\n"),
]
IDLE = [(b"*STB?\n", b"0\r\n"), (b"INSR?\n", b"0\r\n"), (b"*ESR?\n", b"0\r\n")]
BURST = [
    (b"TSRC?\n", b"5\r\n"),
    (b"ADVT?\n", b"0\r\n"),
    (b"BURM?\n", b"1\r\n"),
    (b"BURT?\n", b"0\r\n"),
    (b"BURD?\n", b"0\r\n"),
    (b"BURC?\n", b"6\r\n"),
    (b"BURP?\n", b"0.005\r\n"),
    (b"DLAY? 2\n", b"0,+0.000000000000\r\n"),
    (b"DLAY? 4\n", b"0,+0.001000000000\r\n"),
    (b"DLAY? 6\n", b"0,+0.000000000000\r\n"),
    (b"DLAY? 8\n", b"0,+0.000000000000\r\n"),
    (b"DLAY? 3\n", b"2,+0.000100000000\r\n"),
    (b"DLAY? 5\n", b"4,+0.000250000000\r\n"),
    (b"DLAY? 7\n", b"6,+0.000000000000\r\n"),
    (b"DLAY? 9\n", b"8,+0.000000000000\r\n"),
    (b"LPOL? 1\n", b"1\r\n"),
    (b"LPOL? 2\n", b"1\r\n"),
]


def test_a_burst_byte_by_byte():
    """Set commands are not answered, so each is read back, and the queue of errors after what starts pulses."""
    with scripted(
        TERMINATOR,
        *OPENED,
        *IDLE,
        *BURST,
        *IDLE,
        *BURST,
        *IDLE,
        (b"*TRG\n", b""),
        (b"LERR?\n", b"0\r\n"),
        (b"*STB?\n", b"4\r\n"),
        (b"INSR?\n", b"5\r\n"),
        (b"*ESR?\n", b"0\r\n"),
        (b"*STB?\n", b"0\r\n"),
        (b"INSR?\n", b"8\r\n"),
        (b"*ESR?\n", b"0\r\n"),
        *IDLE,
    ) as link:
        generator = DG645(link)
        assert generator.identity == Identity("Stanford Research Systems", "DG645", "003458", "1.16.116")
        assert generator.configure(TRAIN) == TRAIN
        generator.arm()
        generator.fire()
        assert generator.status() == TriggerStatus(running=True, boot=1)
        assert generator.status() == TriggerStatus(running=False, boot=1)
        generator.close()
        generator.close()


@pytest.mark.parametrize(
    "place, found, command",
    [
        (0, b"0", b"TSRC 5"),
        (2, b"0", b"BURM 1"),
        (5, b"5", b"BURC 6"),
        (6, b"0.004999980000", b"BURP 0.005000000"),
        (8, b"2,+0.001000000000", b"DLAY 4,0,0.001000000"),
        (12, b"4,+0.000249980000", b"DLAY 5,4,0.000250000"),
        (15, b"0", b"LPOL 1,1"),
    ],
)
def test_what_is_not_as_it_should_be_is_set_and_read_back(place, found, command):
    exchanges = [*BURST]
    exchanges[place : place + 1] = [(BURST[place][0], found + b"\r\n"), (command + b"\n", b""), BURST[place]]
    with scripted(TERMINATOR, *OPENED, *IDLE, *exchanges) as link:
        DG645(link).configure(TRAIN)


def test_what_is_not_taken_is_told_with_the_reasons_in_its_queue():
    exchanges = [
        *BURST[:5],
        (b"BURC?\n", b"5\r\n"),
        (b"BURC 6\n", b""),
        (b"BURC?\n", b"5\r\n"),
        (b"LERR?\n", b"10\r\n"),
        (b"LERR?\n", b"171\r\n"),
        (b"LERR?\n", b"0\r\n"),
    ]
    with (
        scripted(TERMINATOR, *OPENED, *IDLE, *exchanges) as link,
        pytest.raises(
            TriggerError, match=r"does not take 'BURC 6': the value .* \(10\), characters came too fast \(171\)"
        ),
    ):
        DG645(link).configure(TRAIN)


def test_old_errors_are_not_taken_for_new_ones():
    with scripted(TERMINATOR, *OPENED[:2], (b"LERR?\n", b"111\r\n"), (b"LERR?\n", b"0\r\n")) as link:
        DG645(link)


def test_another_instrument_is_named():
    with (
        scripted(TERMINATOR, (b"*IDN?\n", b"QC,9528,06312,2.4.3-2.0.11\r\n")) as link,
        pytest.raises(TriggerError, match=r"this is 'QC,9528,06312,2.4.3-2.0.11', not a Stanford DG645: correct"),
    ):
        DG645(link)


@pytest.mark.parametrize(
    "train",
    [
        PulseTrain(2000.0, 6, TRAIN.projector, TRAIN.camera),
        PulseTrain(0.005, 2**31, TRAIN.projector, TRAIN.camera),
        PulseTrain(0.005, 6, TRAIN.projector, Pulse(0.004, 0.001)),
    ],
)
def test_what_is_impossible_is_refused_before_anything_is_sent(train):
    with scripted(TERMINATOR, *OPENED) as link, pytest.raises(RigError):
        DG645(link).configure(train)


# What follows speaks to the emulator.


@pytest.fixture
def device(request: pytest.FixtureRequest) -> Iterator[DG645Emulator]:
    with DG645Emulator(network=getattr(request, "param", False)) as device:
        yield device


@pytest.fixture
def generator(device: DG645Emulator) -> Iterator[Trigger]:
    generator = DG645(Link(device.url, terminator=TERMINATOR))
    yield generator
    generator.close()


over_tcp_too = pytest.mark.parametrize("device", [False, True], ids=["serial", "tcp"], indirect=True)


@over_tcp_too
def test_it_makes_the_burst(generator, device):
    assert generator.configure(TRAIN) == TRAIN
    for number in range(2):
        assert run(generator) == TriggerStatus(running=False, boot=1)
        burst = device.bursts[number]
        assert (burst.period_s, burst.count) == (0.005, 6)
        assert burst.outputs["AB"] == pytest.approx((0.0, 0.0001), abs=1e-12)
        assert burst.outputs["CD"] == pytest.approx((0.001, 0.00025), abs=1e-12)
        assert burst.pulses("CD", device.now) == 6
    assert generator.strobes() == ()


@pytest.mark.parametrize("count", [1, 2])
def test_short_bursts_come_to_their_end(generator, device, count):
    generator.configure(PulseTrain(0.005, count, TRAIN.projector, TRAIN.camera))
    assert run(generator) == TriggerStatus(running=False, boot=1)
    assert device.bursts[-1].pulses("CD", device.now) == count


@pytest.mark.parametrize(
    "left",
    [
        "TSRC 0",
        "DLAY 4,0,30;TSRC 0",
        "DLAY 2,0,3;DLAY 3,2,4",
        "DLAY 6,0,1;DLAY 4,6,0",
        "BURD 5",
        "ADVT 1",
        "LPOL 1,0;LPOL 2,0",
    ],
)
def test_whatever_it_was_set_to_before(device, left):
    link = Link(device.url, terminator=TERMINATOR)
    link.send(left)
    generator = DG645(link)
    generator.configure(TRAIN)
    assert run(generator) == TriggerStatus(running=False, boot=1)
    assert device.bursts[-1].outputs["CD"] == pytest.approx((0.001, 0.00025), abs=1e-12)
    assert device._outputs["LPOL"][1:3] == [1, 1]
    generator.close()


def test_a_trigger_while_it_is_busy_is_told(generator, device):
    generator.configure(PulseTrain(0.1, 50, TRAIN.projector, TRAIN.camera))
    generator.arm()
    generator.fire()
    generator.fire()
    status = generator.status()
    assert status.running
    assert status.complaints == ("a trigger came while the DG645 was busy, and was lost: make the period longer",)
    assert len(device.bursts) == 1
    generator.configure(TRAIN)
    assert run(generator).complaints == ()


def test_an_inhibited_trigger_is_told(generator, device):
    generator.configure(TRAIN)
    device.inhibited = True
    status = run(generator)
    assert not status.running
    assert "inhibit input held a trigger back" in status.complaints[0]
    assert "did not come to the end of a burst" in status.complaints[1]


def test_a_burst_that_somebody_ends_is_told(generator, device):
    generator.configure(PulseTrain(0.1, 50, TRAIN.projector, TRAIN.camera))
    generator.arm()
    generator.fire()
    device.answer("BURM 0")  # at its panel
    wait(lambda: not generator.status().running)
    assert "did not come to the end of a burst" in generator.status().complaints[-1]


def test_a_cycle_that_somebody_breaks_off_is_told(generator, device):
    generator.configure(PulseTrain(5.0, 2, TRAIN.projector, Pulse(3.0, 1.0)))
    generator.arm()
    generator.fire()
    device.answer("DLAY 9,8,1e-6")
    status = generator.status()
    assert status.running
    assert status.complaints == ("the DG645 broke a cycle off",)


@pytest.mark.parametrize("count", [1, 2, None])
def test_a_long_cycle_is_aborted_at_once(generator, device, count):
    generator.configure(PulseTrain(50.0, count, TRAIN.projector, Pulse(30.0, 10.0)))
    generator.arm()
    generator.fire()
    assert generator.status().running
    generator.abort()
    assert not device.running


@pytest.mark.parametrize("forgets", [False, True])
def test_a_power_cycle_is_told_and_made_good(generator, device, forgets):
    device.forgets = forgets
    generator.configure(PulseTrain(0.1, 50, TRAIN.projector, TRAIN.camera))
    generator.arm()
    generator.fire()
    device.restart()
    status = generator.status()
    assert (status.running, status.boot) == (False, 2)
    assert status.complaints[0] == "the DG645 was switched off and on"
    generator.configure(TRAIN)
    device.restart()
    assert run(generator) == TriggerStatus(running=False, boot=3)
    assert device.bursts[-1].pulses("CD", device.now) == 6


def test_a_start_that_is_not_confirmed_is_not_sent_again(generator, device):
    generator.configure(PulseTrain(0.1, 50, TRAIN.projector, TRAIN.camera))
    impatient(generator)
    generator.arm()
    device.silent = True
    generator.fire()
    device.silent = False
    status = generator.status()
    assert status.running
    assert status.complaints == ("the DG645 did not confirm that it started",)
    assert device.received.count("*TRG") == 1


def test_a_start_that_was_lost_is_not_sent_again(generator, device):
    generator.configure(TRAIN)
    impatient(generator)
    generator.arm()
    device.lost_commands = 1
    generator.fire()
    status = generator.status()
    assert not status.running
    assert status.complaints == ("the DG645 did not come to the end of a burst: it did not start, or was stopped",)
    assert device.bursts == []


def test_a_start_that_is_refused_is_told(generator, device):
    generator.configure(TRAIN)
    generator.arm()
    device.answer("TSRC 1")
    with pytest.raises(TriggerError, match=r"refuses to start: not in its present mode \(11\)"):
        generator.fire()


def test_a_set_command_that_is_lost_is_noticed(generator, device, monkeypatch):
    """As nothing answers it, only reading it back can tell."""
    send = Link.send
    monkeypatch.setattr(Link, "send", lambda link, text: None if text.startswith("BURC ") else send(link, text))
    with pytest.raises(TriggerError, match=r"does not take 'BURC 6': it does not say why"):
        generator.configure(TRAIN)


@over_tcp_too
def test_an_answer_that_comes_too_late_is_not_taken_for_the_next_one(generator, device):
    """The number of the one register would be believed of the other."""
    generator.configure(PulseTrain(0.1, 50, TRAIN.projector, TRAIN.camera))
    impatient(generator)
    generator.arm()
    generator.fire()
    device.late_answers = [0.2]
    for _ in range(3):
        assert generator.status() == TriggerStatus(running=True, boot=1)


@pytest.mark.parametrize("garbage", [b"\xff\xfe", b"~~\r\n", b"x" * 3000 + b"\r\n", b"\x00"])
def test_noise_is_survived(generator, device, garbage):
    generator.configure(TRAIN)
    impatient(generator)
    device.before_answer = garbage
    assert not generator.status().running
    device.say(garbage)
    assert run(generator) == TriggerStatus(running=False, boot=1)


def test_what_does_not_stop_is_told(generator, device, monkeypatch):
    monkeypatch.setattr("hardware.trigger.dg645.STOPPED_S", 0.05)
    for way in ("_stop", "_break_off", "_end_with_this_cycle"):
        monkeypatch.setattr(device, way, lambda: None)
    generator.configure(PulseTrain(0.1, 50, TRAIN.projector, TRAIN.camera))
    generator.arm()
    generator.fire()
    with pytest.raises(TriggerError, match=r"does not stop: switch it off"):
        generator.abort()


@over_tcp_too
def test_an_unplugged_port_ends_every_method(generator, device):
    generator.configure(TRAIN)
    generator.arm()
    device.unplug()
    for method in (generator.fire, generator.status, generator.abort, generator.arm):
        with pytest.raises(TriggerError, match=r"is gone"):
            for _ in range(3):  # the first thing that is sent to a closed socket is still taken
                method()
    generator.close()
