"""The trigger box's driver, byte for byte."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from support.byte_script import ScriptedPort, scripted

from hardware.errors import RigError, TriggerError
from hardware.link import Link
from hardware.protocols import Identity, Strobe, TriggerStatus
from hardware.pulses import Pulse, PulseTrain, TriggerLimits
from hardware.trigger import box as module
from hardware.trigger.box import TriggerBox, clock_ppm, crc8

pytestmark = pytest.mark.timeout(30)

LIMITS = (
    "OK tick_ns=500 min_period=400 max_period=2000000000 min_width=100 min_gap=100 max_count=4294967295 log=128 "
    "silence_ms=5000"
)
NAME = "OK colorphase-trigger-box firmware=1.0.0 board=atmega328p protocol=1"
OPENING = [("ID", NAME), ("LIMITS", LIMITS)]
TRAIN = PulseTrain(0.001, 3, Pulse(0.0, 0.0001), Pulse(0.0002, 0.00005))
TICKS = "period=2000 count=3 projector=0,200 camera=400,100 strobe=1 vsync=1"
SET = "SET 2000 3 0 200 400 100 3"
SETTING = [("STOP", "OK state=IDLE"), (SET, f"OK boot=7 cause=2 {TICKS}")]
ARMING = [("ARM", f"OK boot=7 cause=2 {TICKS}")]


def line(text: str) -> str:
    """Return a line with its CRC."""
    return f"{text}*{crc8(text):02X}\n"


def exchanges(*conversation: tuple[str, str]) -> Iterator[tuple[bytes, bytes]]:
    """Give requests and answers their number and CRC; an answer that is empty or ends a line is sent as it is."""
    for number, (request, answer) in enumerate(conversation, start=1):
        if answer and not answer.endswith("\n"):
            answer = line(f"{number:03d} {answer}")
        yield line(f"{number:03d} {request}").encode(), answer.encode()


@contextmanager
def conversation(*asked: tuple[str, str], timeout_s: float = 0.05) -> Iterator[Link]:
    with scripted(b"\n", *exchanges(*asked), timeout_s=timeout_s) as link:
        yield link


def status(**words: object) -> tuple[str, str]:
    """Return the question for the status and an answer."""
    said = {
        "state": "DONE",
        "boot": 7,
        "cause": 2,
        "up": 5,
        "tick": 9,
        "pulses": 3,
        "projector": 3,
        "strobes": 3,
        "strays": 0,
        "vsyncs": 3,
        "noise": 0,
        "worst": 30,
        "garbled": 0,
    }
    return "STATUS", "OK " + " ".join(f"{name}={value}" for name, value in {**said, **words}.items())


def ready(link: Link) -> TriggerBox:
    """Return a box that was set and armed."""
    box = TriggerBox(link, strobe=True, vsync=True)
    box.configure(TRAIN)
    box.arm()
    return box


def test_the_crc_is_the_documented_one():
    assert crc8("123456789") == 0xF4  # the catalogue's check value of CRC-8/SMBUS
    assert crc8("") == 0


def test_a_burst_byte_by_byte():
    with conversation(
        *OPENING,
        *SETTING,
        *ARMING,
        ("FIRE", "OK start=123"),
        status(state="RUNNING", pulses=2, strobes=1, vsyncs=2),
        status(),
        status(),
        ("LOG 0", "OK strobes=3 from=0 0,401 1,402 2,401"),
        ("STOP", "OK state=DONE"),
    ) as link:
        box = TriggerBox(link, strobe=True, vsync=True)
        assert box.identity == Identity("colorphase", "trigger box", "", "1.0.0 atmega328p")
        assert box.limits == TriggerLimits(5e-7, 2e-4, 1000.0, 5e-5, 5e-5, 4294967295, True, True)
        assert box.configure(TRAIN) == TRAIN
        box.arm()
        box.fire()
        assert box.status() == TriggerStatus(True, 2, 1, 2, 7)
        assert box.status() == TriggerStatus(False, 3, 3, 3, 7)
        assert box.strobes() == (Strobe(0, 401 * 5e-7), Strobe(1, 2402 * 5e-7), Strobe(2, 4401 * 5e-7))
        box.close()
        assert not link._port.is_open


@pytest.mark.parametrize("ppm", [-1500.0, 0.0, 40.0])
def test_clocks_are_compared_by_prompt_answers(ppm):
    """A minute of questions, every seventh held up by half a second on its way back, the tick running over."""
    random = np.random.default_rng(0)
    samples = []
    for i in range(100):
        asked_s = 100.0 + 0.6 * i
        there_s, back_s = random.uniform(1e-3, 1.2e-3, 2)
        tick = 2**32 - 10_000_000 + (asked_s + there_s) * (1 + 1e-6 * ppm) / 5e-7
        samples.append((asked_s, asked_s + there_s + back_s + 0.5 * (i % 7 == 0), int(tick) % 2**32))
    found = clock_ppm(samples, 5e-7)
    assert found is not None
    assert abs(found - ppm) < 2
    assert clock_ppm(samples[:15], 5e-7) is None  # eight seconds
    assert clock_ppm([], 5e-7) is None


def test_later_firmware_may_say_more():
    more = "OK boot=7 cause=2 " + TICKS + " phase=0"
    with conversation(*OPENING, SETTING[0], (SET, more), ("ARM", more)) as link:
        ready(link)


def test_a_box_that_restarts_while_it_is_read_out():
    with conversation(*OPENING, *SETTING, *ARMING, status(), ("LOG 0", "OK strobes=0 from=0")) as link:
        assert ready(link).strobes() == ()


def test_what_is_impossible_is_not_even_asked():
    with conversation(*OPENING) as link:
        box = TriggerBox(link)
        with pytest.raises(RigError, match=r"the camera's pulse is 4.9e-05 s wide: make it 5e-05 s or more"):
            box.configure(PulseTrain(0.001, 3, Pulse(0.0, 0.0001), Pulse(0.0, 0.000049)))


def test_what_it_boots_with_is_waited_for():
    """An Uno restarts when its port is opened, and its boot loader throws away what it hears."""
    with conversation(("ID", ""), ("ID", "e=0*8C\n" + line("! BOOT boot=7 cause=2")), *OPENING) as link:
        TriggerBox(link)


def test_answers_to_others_are_not_taken():
    """Late, damaged, for people, cut, or meant for another number."""
    noise = (
        "01 OK\n" + line("! END state=DONE pulses=9") + line("001 OK state=DONE") + "\x07\n" + "003 OK tick_ns=1*00\n"
    )
    with conversation(("ID", NAME), ("LIMITS", noise + line(f"002 {LIMITS}")), status()) as link:
        box = TriggerBox(link)
        assert box.limits.tick_s == 5e-7
        assert box.status().complaints == ()  # a few damaged lines are asked for again, and no reason to complain


def test_a_lost_answer_is_asked_for_once_more():
    with conversation(
        *OPENING,
        ("STATUS", ""),
        status(),
        ("STATUS", line("? ERR LINE damaged")),
        status(),
        ("STATUS", ""),
        ("STATUS", ""),
    ) as link:
        box = TriggerBox(link)
        assert box.status().pulses == 3
        assert box.status().pulses == 3
        started_s = time.monotonic()
        with pytest.raises(TriggerError, match="does not answer 'STATUS': check its power"):
            box.status()
        assert time.monotonic() - started_s < 1


@pytest.mark.parametrize(
    "opening, message",
    [
        (
            [("ID", NAME.replace("protocol=1", "protocol=2"))],
            "speaks protocol 2, and this program 1: flash the firmware",
        ),
        ([("ID", "OK some-other-box protocol=1")], "this is 'some-other-box protocol=1', not a colorphase-trigger-box"),
        ([("ID", "OK colorphase-trigger-box firmware=1.0.0")], "instead of protocol: flash its firmware anew"),
        ([("ID", NAME), ("LIMITS", LIMITS.replace("=500", "=0"))], "its tick is nothing: flash its firmware anew"),
        ([("ID", NAME), ("LIMITS", LIMITS.replace("=400", "=" + "9" * 400))], "instead of min_period: flash its"),
        ([("ID", NAME), ("LIMITS", LIMITS.replace("100 ", "x "))], "instead of min_width: flash its firmware anew"),
        ([("ID", "ERR COMMAND unknown")], "refuses 'ID': COMMAND unknown"),
        ([("ID", "")], "no trigger box answers: check its cable"),
        ([("ID", "?1\r\n")], r"no trigger box answers, but hears '\?1': check its cable"),
        ([("ID", line("001 ID"))], "no trigger box answers"),  # an echo
    ],
)
def test_what_is_not_a_trigger_box_is_refused(monkeypatch, opening, message):
    monkeypatch.setattr(module, "IDENTIFY_S", 0.0)
    with conversation(*opening) as link, pytest.raises(TriggerError, match=message):
        TriggerBox(link)


def test_a_silent_port_is_given_up(monkeypatch):
    monkeypatch.setattr(module, "IDENTIFY_S", 0.5)
    link = Link("loop://")
    link._port.close()
    link._port = port = ScriptedPort([])
    port.write = len
    started_s = time.monotonic()
    with pytest.raises(TriggerError, match="no trigger box answers"):
        TriggerBox(link)
    assert 0.5 < time.monotonic() - started_s < 2.5


@pytest.mark.parametrize("state", ["RUNNING", "DONE"])
def test_a_lost_answer_to_fire_is_looked_up(state):
    with conversation(*OPENING, *SETTING, *ARMING, ("FIRE", ""), status(state=state)) as link:
        ready(link).fire()


def test_a_lost_fire_is_not_repeated():
    unread = line("? ERR LINE damaged")
    with conversation(
        *OPENING, *SETTING, *ARMING, ("FIRE", unread), status(state="ARMED"), ("STOP", "OK state=READY")
    ) as link:
        box = ready(link)
        with pytest.raises(TriggerError, match="nothing was fired: look at its cable, then arm and fire again"):
            box.fire()


def test_a_box_that_restarted_must_be_configured_again():
    new = status(state="IDLE", boot=8, cause=4)
    idle = "ERR STATE state=IDLE"
    with conversation(
        *OPENING, *SETTING, *ARMING, ("FIRE", ""), new, ("FIRE", idle), new, ("ARM", idle), new, new, new, status()
    ) as link:
        box = ready(link)
        for call in (box.fire, box.fire, box.arm):
            with pytest.raises(TriggerError, match=r"supply broke down.*: configure it again"):
                call()
        assert box.status().boot == 8
        assert box.strobes() == ()  # what it logs now is another burst's
        assert box.status().complaints == ()


def test_a_box_that_somebody_else_set_is_refused():
    other = f"OK boot=7 cause=2 {TICKS.replace('2000', '4000')}"
    with conversation(*OPENING, *SETTING, ("ARM", other)) as link:
        box = TriggerBox(link, strobe=True, vsync=True)
        box.configure(TRAIN)
        with pytest.raises(TriggerError, match="somebody else has set the trigger box"):
            box.arm()
    with conversation(*OPENING, SETTING[0], (SET, other)) as link:
        box = TriggerBox(link, strobe=True, vsync=True)
        with pytest.raises(TriggerError, match=r"makes .*period=4000"):
            box.configure(TRAIN)


@pytest.mark.parametrize(
    "words, complaint",
    [
        ({"state": "LATE"}, "could not make an edge in time"),
        ({"state": "SHORTED"}, "an output did not follow: is its cable shorted"),
        ({"state": "SILENT"}, "said nothing for too long"),
        ({"noise": 2}, "2 edges at the strobe input came too fast"),
        ({"strays": 5}, "exposed 5 times before the first pulse"),
        ({"garbled": 9}, "9 lines to and from the trigger box were damaged"),
        ({"vsyncs": 0}, "the projector reported no picture"),
        ({"boot": 8, "cause": 0}, "has restarted since it was configured: its boot loader does not report why"),
        ({"boot": 8, "cause": 8}, "has restarted since it was configured: its program hung"),
    ],
)
def test_every_complaint_is_a_sentence(words, complaint):
    with conversation(*OPENING, *SETTING, *ARMING, ("FIRE", "OK start=1"), status(**words)) as link:
        box = ready(link)
        box.fire()
        (said,) = box.status().complaints
        assert complaint in said
        assert said.isprintable()


def test_complaints_are_of_the_last_burst():
    bad = "spoilt*00\n" * 5
    with conversation(
        *OPENING, *SETTING, *ARMING, ("STATUS", bad + line(f"006 {status()[1]}")), *ARMING, status()
    ) as link:
        box = ready(link)
        assert len(box.status().complaints) == 1
        box.arm()
        assert box.status().complaints == ()


def test_a_burst_that_does_not_end_is_stopped(monkeypatch):
    monkeypatch.setattr(module, "OVERDUE_S", 0.0)
    running = status(state="RUNNING")
    with conversation(
        *OPENING,
        *SETTING,
        *ARMING,
        ("FIRE", "OK start=1"),
        running,
        ("STOP", "OK state=STOPPED"),
        status(state="STOPPED"),
    ) as link:
        box = ready(link)
        box.fire()
        time.sleep(0.01)
        for _ in range(2):
            said = box.status()
            assert not said.running
            assert "ran on after its burst should have ended" in said.complaints[0]


def test_exposures_are_read_before_the_box_forgets_them():
    def logged(first: int, count: int, known: int) -> str:
        return f"OK strobes={known} from={first} " + " ".join(f"{pulse},400" for pulse in range(first, first + count))

    with conversation(
        *OPENING,
        *SETTING,
        *ARMING,
        status(state="RUNNING", strobes=64),
        status(state="RUNNING", strobes=65),
        *((f"LOG {first}", logged(first, 6, 65)) for first in range(0, 24, 6)),
        status(strobes=200),
        ("LOG 24", logged(72, 6, 200)),  # 24 to 71 were overwritten
        *((f"LOG {first}", logged(first, 6, 200)) for first in range(78, 96, 6)),
        status(strobes=200),
        *((f"LOG {first}", logged(first, min(6, 200 - first), 200)) for first in range(96, 200, 6)),
    ) as link:
        box = ready(link)
        for _ in range(3):
            box.status()
        assert [strobe.pulse for strobe in box.strobes()] == [*range(24), *range(72, 200)]


def test_closing_never_raises():
    with conversation(*OPENING, ("STOP", ""), ("STOP", "")) as link:
        box = TriggerBox(link)
        box.close()
        box.close()
