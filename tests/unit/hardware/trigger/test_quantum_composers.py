from collections.abc import Iterator

import pytest
from support.byte_script import scripted
from support.emulators.emulated_quantum_composers import QuantumComposersEmulator
from support.pulse_generators import TRAIN, impatient, little_noise, run

from hardware.errors import RigError, TriggerError
from hardware.link import Link
from hardware.protocols import Identity, Trigger, TriggerStatus
from hardware.pulses import Pulse, PulseTrain
from hardware.trigger.quantum_composers import TERMINATOR, QuantumComposers

__all__ = ["little_noise"]
pytestmark = pytest.mark.timeout(30)

NAME = (b"*IDN?\r\n", b"QC,9528,06312,2.4.3-2.0.11\r\n")
STOP = (b":PULS0:STATE 0\r\n", b"ok\r\n")


def settings(*pairs: tuple[str, str], kept: bool = False) -> list[tuple[bytes, bytes]]:
    """Return the bytes for settings that are not yet as they should be, or already are."""
    exchanges = []
    for keyword, value in pairs:
        if kept:
            exchanges.append((f"{keyword}?\r\n".encode(), f"{value}\r\n".encode()))
            continue
        other = "0.001000000" if "." in value else "0" if value.isdigit() else "NONE"
        exchanges += [
            (f"{keyword}?\r\n".encode(), f"{other}\r\n".encode()),
            (f"{keyword} {value}\r\n".encode(), b"ok\r\n"),
            (f"{keyword}?\r\n".encode(), f"{value}\r\n".encode()),
        ]
    return exchanges


BURST = [
    (":PULS0:MOD", "BURS"),
    (":PULS0:PER", "0.005000000"),
    (":PULS0:BCO", "6"),
    (":PULS1:SYNC", "T0"),
    (":PULS1:CMOD", "NORM"),
    (":PULS1:POL", "NORM"),
    (":PULS1:WIDT", "0.000100000"),
    (":PULS1:DEL", "0.000000000"),
    (":PULS1:STATE", "1"),
    (":PULS2:SYNC", "T0"),
    (":PULS2:CMOD", "NORM"),
    (":PULS2:POL", "NORM"),
    (":PULS2:WIDT", "0.000250000"),
    (":PULS2:DEL", "0.002000000"),
    (":PULS2:STATE", "1"),
]


def test_a_burst_byte_by_byte():
    train = PulseTrain(0.005, 6, Pulse(0.0, 0.0001), Pulse(0.002, 0.00025))
    with scripted(
        TERMINATOR,
        NAME,
        STOP,
        (b"*RST\r\n", b"ok\r\n"),
        (b":PULS0:TRIG:MOD DIS\r\n", b"ok\r\n"),
        *settings(*BURST),
        STOP,
        *settings(*BURST, kept=True),
        (b":PULS0:STATE 1\r\n", b"ok\r\n"),
        (b":PULS0:STATE?\r\n", b"1\r\n"),
        STOP,
        STOP,
    ) as link:
        generator = QuantumComposers(link)
        assert generator.identity == Identity("QC", "9528", "06312", "2.4.3-2.0.11")
        assert generator.configure(train) == train
        generator.arm()
        generator.fire()
        assert generator.status() == TriggerStatus(running=True)
        generator.abort()
        generator.close()
        generator.close()


def test_older_models_name_the_external_trigger_otherwise():
    one = [(keyword.replace("PULS2", "PULS3"), value) for keyword, value in BURST]
    one[one.index((":PULS0:MOD", "BURS"))] = (":PULS0:MOD", "NORM")
    one[one.index((":PULS0:BCO", "6"))] = (":PULS0:BCO", "1")
    with scripted(
        TERMINATOR,
        (b"*IDN?\r\n", b"BNC,525-6,123,1.0\r\n"),
        STOP,
        (b"*RST\r\n", b"ok\r\n"),
        (b":PULS0:TRIG:MOD DIS\r\n", b"?3\r\n"),
        (b":PULS0:EXT:MOD DIS\r\n", b"ok\r\n"),
        *settings(*one, kept=True),
    ) as link:
        endless = PulseTrain(0.005, None, Pulse(0.0, 0.0001), Pulse(0.002, 0.00025))
        QuantumComposers(link, camera_output="C").configure(endless)


def test_answers_in_the_long_form_and_in_other_numbers_are_the_same_settings():
    spelled = {"BURS": b"BURST", "0.005000000": b"5.000e-3", "1": b"1"}
    exchanges = [
        (question, spelled.get(answer.decode().strip(), answer.strip()) + b"\r\n")
        for question, answer in settings(*BURST, kept=True)
    ]
    with scripted(
        TERMINATOR,
        NAME,
        STOP,
        (b"*RST\r\n", b"ok\r\n"),
        (b":PULS0:TRIG:MOD DIS\r\n", b"ok\r\n"),
        *exchanges,
    ) as link:
        QuantumComposers(link).configure(PulseTrain(0.005, 6, Pulse(0.0, 0.0001), Pulse(0.002, 0.00025)))


@pytest.mark.parametrize("answer, words", [(b"?8", "present state"), (b"?9", "out of its bounds"), (b"?77", "manual")])
def test_refusals_are_told_in_words(answer, words):
    with (
        scripted(TERMINATOR, NAME, (b":PULS0:STATE 0\r\n", answer + b"\r\n")) as link,
        pytest.raises(TriggerError, match=rf"the 9528 refuses ':PULS0:STATE 0': .*{words}"),
    ):
        QuantumComposers(link).abort()


def test_a_value_that_is_not_kept_is_told():
    with (
        scripted(
            TERMINATOR,
            NAME,
            STOP,
            (b"*RST\r\n", b"ok\r\n"),
            (b":PULS0:TRIG:MOD DIS\r\n", b"ok\r\n"),
            (b":PULS0:MOD?\r\n", b"BURS\r\n"),
            (b":PULS0:PER?\r\n", b"0.001000000\r\n"),
            (b":PULS0:PER 0.005000000\r\n", b"ok\r\n"),
            (b":PULS0:PER?\r\n", b"0.004999900\r\n"),
        ) as link,
        pytest.raises(TriggerError, match=r"took :PULS0:PER 0.005000000 as 0.004999900"),
    ):
        QuantumComposers(link).configure(TRAIN)


@pytest.mark.parametrize(
    "train",
    [
        PulseTrain(1e-6, 6, TRAIN.projector, TRAIN.camera),
        PulseTrain(2000.0, 6, TRAIN.projector, TRAIN.camera),
        PulseTrain(0.005, 1_000_001, TRAIN.projector, TRAIN.camera),
        PulseTrain(0.005, 6, TRAIN.projector, Pulse(0.004, 0.001)),
    ],
)
def test_what_is_impossible_is_refused_before_anything_is_sent(train):
    with scripted(TERMINATOR, NAME) as link, pytest.raises(RigError):
        QuantumComposers(link).configure(train)


def test_both_at_one_output():
    with scripted(TERMINATOR) as link, pytest.raises(RigError, match=r"both at output C"):
        QuantumComposers(link, projector_output="C", camera_output="C")


@pytest.mark.parametrize(
    "name", [b"Stanford Research Systems,DG645,s/n1,ver1", b"BNC,588B-8C,1,2", b"QC,9412,1,2", b"RIGOL,DS1054,1,2"]
)
def test_another_instrument_is_named(name):
    with (
        scripted(TERMINATOR, (b"*IDN?\r\n", name + b"\r\n")) as link,
        pytest.raises(TriggerError, match=rf"this is '{name.decode()}', not a Quantum Composers or BNC"),
    ):
        QuantumComposers(link)


@pytest.mark.parametrize(
    "name", [b"QC,9534,02311,1.2.2-1.2.0", b"QC,9214,1,2", b"BNC,575-4,31707,2.4.2-2.0.11", b"BNC,577,1,2"]
)
def test_its_relatives_are_taken(name):
    with scripted(TERMINATOR, (b"*IDN?\r\n", name + b"\r\n")) as link:
        assert QuantumComposers(link).identity.model == name.decode().split(",")[1]


# What follows speaks to the emulator.


@pytest.fixture
def device(request: pytest.FixtureRequest) -> Iterator[QuantumComposersEmulator]:
    with QuantumComposersEmulator(echo=getattr(request, "param", False)) as device:
        yield device


with_echo_too = pytest.mark.parametrize("device", [False, True], ids=["plain", "echo"], indirect=True)


@pytest.fixture
def generator(device: QuantumComposersEmulator) -> Iterator[Trigger]:
    generator = QuantumComposers(Link(device.url, terminator=TERMINATOR))
    yield generator
    generator.close()


@with_echo_too
def test_it_makes_the_burst(generator, device):
    assert generator.configure(TRAIN) == TRAIN
    for number in range(2):
        assert run(generator) == TriggerStatus(running=False)
        burst = device.bursts[number]
        assert (burst.period_s, burst.count) == (0.005, 6)
        assert burst.outputs == {"A": (0.0, 0.0001), "B": (0.001, 0.00025)}
        assert burst.pulses("B", device.now) == 6
    assert generator.strobes() == ()


def test_outputs_are_those_that_were_chosen(device):
    generator = QuantumComposers(Link(device.url, terminator=TERMINATOR), projector_output="D", camera_output="C")
    generator.configure(TRAIN)
    run(generator)
    assert device.bursts[-1].outputs == {"D": (0.0, 0.0001), "C": (0.001, 0.00025)}
    generator.close()


def test_an_external_trigger_left_on_does_not_hold_the_burst_back():
    with QuantumComposersEmulator(trigger_keyword="EXT") as device:
        link = Link(device.url, terminator=TERMINATOR)
        link.send(":PULSE0:EXTERNAL:MODE TRIG")
        assert link.receive() == "ok"
        generator = QuantumComposers(link)
        generator.configure(TRAIN)
        run(generator)
        assert len(device.bursts) == 1
        generator.close()


def test_a_restart_between_bursts_is_made_good(generator, device):
    generator.configure(TRAIN)
    run(generator)
    device.restart()
    assert run(generator) == TriggerStatus(running=False)
    assert device.bursts[-1].outputs == {"A": (0.0, 0.0001), "B": (0.001, 0.00025)}


@pytest.mark.parametrize("fault", ["restart", "press_stop"])
@pytest.mark.parametrize("count", [50, None])
def test_a_burst_that_was_cut_short_is_told(generator, device, fault, count):
    generator.configure(PulseTrain(0.1, count, TRAIN.projector, TRAIN.camera))
    generator.arm()
    generator.fire()
    assert generator.status().running
    getattr(device, fault)()
    for _ in range(2):
        status = generator.status()
        assert not status.running
        assert len(status.complaints) == 1
        assert "before its burst can be over" in status.complaints[0]
    generator.configure(TRAIN)
    assert run(generator).complaints == ()


@with_echo_too
def test_a_start_whose_answer_is_lost_is_not_sent_again(generator, device):
    generator.configure(PulseTrain(0.1, 50, TRAIN.projector, TRAIN.camera))
    impatient(generator)
    generator.arm()
    device.lost_answers = 2  # its echo too, where there is one
    generator.fire()
    status = generator.status()
    assert status.running
    assert status.complaints == ("the pulse generator did not confirm that it started",)
    assert len(device.bursts) == 1
    assert [line for line in device.received if line == ":PULS0:STATE 1"] == [":PULS0:STATE 1"]


def test_a_start_that_was_lost_is_not_sent_again(generator, device):
    generator.configure(PulseTrain(0.1, 50, TRAIN.projector, TRAIN.camera))
    impatient(generator)
    generator.arm()
    device.lost_commands = 1
    generator.fire()
    status = generator.status()
    assert not status.running
    assert "did not confirm" in status.complaints[0] and "it did not start" in status.complaints[1]
    assert device.bursts == []


@with_echo_too
def test_an_answer_that_comes_too_late_is_not_taken_for_the_next_one(generator, device):
    generator.configure(PulseTrain(0.1, 50, TRAIN.projector, TRAIN.camera))
    impatient(generator)
    generator.arm()
    device.late_answers = [0.2]  # 'ok', or its echo, while the state is asked for
    generator.fire()
    assert generator.status().running
    assert generator.status().running


@pytest.mark.parametrize("garbage", [b"\xff\xfe", b"~~\r\n", b"ok\r\n?8\r\n", b"x" * 3000 + b"\r\n", b"\x00"])
def test_noise_is_survived(generator, device, garbage):
    generator.configure(TRAIN)
    impatient(generator)
    for _ in range(3):
        device.before_answer = garbage
        assert not generator.status().running
    device.say(garbage)
    assert run(generator) == TriggerStatus(running=False)


@pytest.mark.parametrize("device", [True], ids=["echo"], indirect=True)
def test_slow_echoes_in_pieces_are_survived(generator, device):
    device.in_pieces = True
    device.delay_s = 0.005
    generator.configure(TRAIN)
    assert run(generator) == TriggerStatus(running=False)


def test_a_busy_instrument_says_so(generator, device):
    device.busy = True
    with pytest.raises(TriggerError, match=r"refuses ':PULS0:STATE 0': it cannot do that in its present state \(\?8\)"):
        generator.configure(TRAIN)


def test_an_output_that_is_not_there_is_told():
    with QuantumComposersEmulator(channels=2) as device:
        generator = QuantumComposers(Link(device.url, terminator=TERMINATOR), camera_output="D")
        with pytest.raises(TriggerError, match=r"refuses ':PULS4:SYNC\?': it does not know a keyword"):
            generator.configure(TRAIN)
        generator.close()


def test_an_unplugged_port_ends_every_method(generator, device):
    generator.configure(TRAIN)
    generator.arm()
    device.unplug()
    generator.fire()  # perhaps it was sent
    for method in (generator.status, generator.abort, generator.arm, lambda: generator.configure(TRAIN)):
        with pytest.raises(TriggerError, match=r"is gone"):
            method()
    generator.close()
