"""The real firmware, in an emulated ATmega328P: what its pins do, and what becomes of every fault."""

import random
import time
from collections.abc import Callable

import numpy as np
import pytest
from support.simavr import CYCLES, Board

from hardware.errors import RigError, TriggerError
from hardware.link import Link
from hardware.protocols import Trigger, TriggerStatus
from hardware.pulses import Pulse, PulseTrain
from hardware.trigger.box import TriggerBox, crc8

pytestmark = pytest.mark.timeout(30)

Start = Callable[..., Board]
#: Of the emulated board's time: longer than its watchdog and than the boot that follows.
WATCHDOG_S = 0.14


def train(
    period_us: float, count: int | None, projector: tuple[float, float], camera: tuple[float, float]
) -> PulseTrain:
    """Return a train from microseconds: period, and delay and width of each pulse."""
    pulses = (Pulse(delay_us / 1e6, width_us / 1e6) for delay_us, width_us in (projector, camera))
    return PulseTrain(period_us / 1e6, count, *pulses)


SHORT = train(500, 40, (0, 60), (100, 80))


def finish(box: TriggerBox, timeout_s: float = 150.0) -> TriggerStatus:
    """Wait for the end of the burst."""
    deadline_s = time.monotonic() + timeout_s
    while (status := box.status()).running:
        assert time.monotonic() < deadline_s, status
    return status


def wait_for_pulses(box: TriggerBox, pulses: int) -> TriggerStatus:
    """Wait until this many pulses have begun."""
    deadline_s = time.monotonic() + 150
    while (status := box.status()).pulses < pulses:
        assert time.monotonic() < deadline_s, status
    return status


def assert_exact(board: Board, asked: PulseTrain, count: int) -> None:
    """Compare every edge of a board's first burst with the times that were reported, within one clock cycle."""
    start = board.edges("projector")[0][0] - asked.projector.delay_s * CYCLES
    for pin, pulse in (("projector", asked.projector), ("camera", asked.camera)):
        rises, falls = (np.array(edges) for edges in board.edges(pin))
        assert len(rises) == len(falls) == count, pin
        expected = start + (np.arange(count) * asked.period_s + pulse.delay_s) * CYCLES
        assert np.abs(rises - expected).max() < 1.001, pin
        assert np.abs(falls - expected - pulse.width_s * CYCLES).max() < 1.001, pin


def raw(link: Link, request: str) -> str:
    """Send a request as the number 900 and return what is answered to it."""
    link.send(f"900 {request}*{crc8(f'900 {request}'):02X}")
    while line := link.receive():
        text, _, crc = line.rpartition("*")
        if text.startswith("900 ") and crc == f"{crc8(text):02X}":
            return text[4:]
    raise AssertionError(f"no answer to {request!r}")


def test_it_says_who_it_is_and_what_it_can_do(simavr_board: Start):
    box: Trigger = TriggerBox(simavr_board().link(), strobe=True)
    assert str(box.identity) == "colorphase trigger box 1.0.0 atmega328p"
    limits = box.limits
    assert (limits.tick_s, limits.min_width_s, limits.min_gap_s) == (0.5e-6, 50e-6, 50e-6)
    assert (limits.min_period_s, limits.max_period_s, limits.max_count) == (200e-6, 1000.0, 2**32 - 1)
    assert (limits.counts_strobes, limits.counts_vsyncs) == (True, False)
    status = box.status()
    assert not status.running
    assert status.complaints == ()
    box.close()
    box.close()
    with pytest.raises(TriggerError, match="closed"):
        box.status()


def test_a_thousand_pulses_within_one_clock_cycle(simavr_board: Start):
    board = simavr_board()
    board.tell("strobe 30 200")
    board.tell("vsync 2500")
    box = TriggerBox(board.link(), strobe=True, vsync=True)
    # Nothing here is a whole number of ticks.
    asked = box.configure(train(833.3333, 1000, (12.3, 100.1), (250.2, 75.4)))
    assert asked == train(833.5, 1000, (12.5, 100.0), (250.0, 75.5))
    box.arm()
    box.fire()
    status = finish(box)
    assert status.complaints == ()
    assert (status.pulses, status.strobes) == (1000, 1000)
    assert_exact(board, asked, 1000)

    start = board.edges("projector")[0][0] / CYCLES - asked.projector.delay_s
    seen = np.array(board.edges("strobe")[0]) / CYCLES - start
    strobes = box.strobes()  # it is asked too late for some
    assert len(strobes) >= 128
    np.testing.assert_allclose(
        [strobe.time_s for strobe in strobes], seen[[strobe.pulse for strobe in strobes]], atol=box.limits.tick_s
    )
    pictures = np.array(board.edges("vsync")[0]) / CYCLES - start
    expected = np.count_nonzero((pictures >= 0) & (pictures < 1000 * asked.period_s))
    assert abs(status.vsyncs - expected) <= 1  # it looks at its counter every 128 us


@pytest.mark.parametrize(
    "asked",
    [
        train(200, 500, (0, 50), (0, 50)),  # all limits at once, and all edges in the same cycle
        train(200, 500, (0, 150), (100, 50)),
        train(200, 500, (100, 50), (50, 50)),  # one falls as the other rises
        train(200, 500, (0.5, 50), (0, 50.5)),
        train(250_000, 4, (1000, 100_000), (120_000, 70_000)),  # over several rounds of the timer
        train(99_999.5, 5, (0, 32_767.5), (33_000, 32_768)),  # as long as it counts, and a tick more or less
        train(98_304, 5, (0, 32_768.5), (16_384, 65_536)),
        train(2_000_000, 1, (0, 50), (1_500_000, 50)),
    ],
    ids=str,
)
def test_every_edge_is_where_it_was_said_to_be(simavr_board: Start, asked: PulseTrain):
    board = simavr_board()
    box = TriggerBox(board.link())
    assert box.configure(asked) == asked
    box.arm()
    box.fire()
    status = finish(box)
    assert (status.pulses, status.strobes, status.vsyncs, status.complaints) == (asked.count, None, None, ())
    assert_exact(board, asked, asked.count)


def test_trains_at_random(simavr_board: Start):
    board = simavr_board()
    box = TriggerBox(board.link())
    draw = random.Random(3)
    for _ in range(12):
        width_us, other_us = draw.randint(100, 400) / 2, draw.randint(100, 400) / 2
        delay_us, later_us = draw.randint(0, 200) / 2, draw.randint(0, 200) / 2
        period_us = max(200, max(delay_us + width_us, later_us + other_us) + 50 + draw.randint(0, 3) / 2)
        asked = box.configure(train(period_us, 25, (delay_us, width_us), (later_us, other_us)))
        before = [len(board.edges(pin)[0]) for pin in ("projector", "camera")]
        box.arm()
        box.fire()
        assert finish(box).pulses == 25
        for pin, first, pulse in zip(("projector", "camera"), before, (asked.projector, asked.camera), strict=True):
            rises, falls = (np.array(edges[first:]) / CYCLES for edges in board.edges(pin))
            assert np.all(np.abs(np.diff(rises) - asked.period_s) < 1.01 / CYCLES)
            assert np.all(np.abs(falls - rises - pulse.width_s) < 1.01 / CYCLES)


def test_under_load_it_has_time_to_spare(simavr_board: Start):
    """Shortest period, coinciding edges, an exposure with each, pictures, and a host that never stops asking."""
    board = simavr_board()
    board.tell("strobe 0 20")
    board.tell("vsync 101")
    link = board.link()
    box = TriggerBox(link, strobe=True, vsync=True)
    asked = box.configure(train(200, 3000, (0, 50), (0, 50)))
    box.arm()
    box.fire()
    status = finish(box)
    assert (status.pulses, status.strobes, status.complaints) == (3000, 3000, ())
    assert_exact(board, asked, 3000)
    worst_ticks = int(raw(link, "STATUS").partition(" worst=")[2].split()[0])
    assert 40 < worst_ticks < 90, "of 100, the shortest width"


def test_what_it_cannot_keep_is_refused_and_changes_nothing(simavr_board: Start):
    board = simavr_board()
    link = board.link()
    TriggerBox(link)
    kept = raw(link, "SET 1000 3 0 100 200 300 0")
    for numbers, answer in (
        ("399 1 0 100 0 100 0", "LIMIT period"),
        ("2000000001 1 0 100 0 100 0", "LIMIT period"),
        ("1000 1 0 99 0 100 0", "LIMIT projector_width"),
        ("1000 1 0 100 0 0 0", "LIMIT camera_width"),
        ("1000 1 0 901 0 100 0", "LIMIT projector_gap"),
        ("1000 1 801 100 0 100 0", "LIMIT projector_gap"),
        ("1000 1 0 100 4294967295 100 0", "LIMIT camera_gap"),
        ("1000 1 0 100 1 4294967295 0", "LIMIT camera_gap"),
        ("1000 1 0 100 0 100 4", "LIMIT inputs"),
        ("1000 4294967296 0 100 0 100 0", "ARGUMENT seven numbers expected"),
        ("1000 1 0 100 0 100", "ARGUMENT seven numbers expected"),
        ("1000 1 0 100 0 -100 0", "ARGUMENT seven numbers expected"),
        ("1000 1 0 100 0 0x64 0", "ARGUMENT seven numbers expected"),
        ("1000 1  0 100 0 100 0", "ARGUMENT seven numbers expected"),
        ("1000 1 0 100 0 100 0 0", "ARGUMENT none expected"),
    ):
        assert raw(link, f"SET {numbers}") == f"ERR {answer}", numbers
    assert raw(link, "ARM") == kept
    assert raw(link, "FIRE").startswith("OK start=")
    while " state=RUNNING " in raw(link, "STATUS"):
        pass
    assert len(board.edges("camera")[0]) == 3


def test_the_limits_themselves_are_kept(simavr_board: Start):
    box = TriggerBox(simavr_board().link())
    for asked in (train(200, 1, (0, 50), (0, 150)), train(1e9, 2**32 - 1, (0, 50), (9.9e8, 9_999_950))):
        assert box.configure(asked) == asked
        box.arm()
    for impossible in (
        train(199, 1, (0, 50), (0, 50)),
        train(200, 1, (0, 49), (0, 50)),
        train(200, 1, (0, 50), (0, 151)),
        train(1.1e9, 1, (0, 50), (0, 50)),
    ):
        with pytest.raises(RigError):
            box.configure(impossible)


def test_commands_out_of_turn_are_refused(simavr_board: Start):
    board = simavr_board()
    link = board.link()
    box = TriggerBox(link)
    assert raw(link, "ARM") == "ERR STATE state=IDLE"
    assert raw(link, "FIRE") == "ERR STATE state=IDLE"
    assert raw(link, "STOP") == "OK state=IDLE"
    for request in ("HELLO", "", "ID 1", "ARM 1", "STATUS x", "LOG", "LOG x", "LIMITS 2"):
        assert raw(link, request).startswith("ERR "), request
    with pytest.raises(TriggerError, match="configure it first"):
        box.arm()
    with pytest.raises(TriggerError, match="configure and arm it first"):
        box.fire()
    box.configure(SHORT)
    with pytest.raises(TriggerError, match="refuses 'FIRE': STATE state=READY"):
        box.fire()
    box.arm()
    assert raw(link, "SET 1000 1 0 100 0 100 0") == "ERR STATE state=ARMED"
    box.fire()
    with pytest.raises(TriggerError, match="refuses 'FIRE': STATE state="):
        box.fire()
    assert finish(box).pulses == 40
    assert len(board.edges("camera")[0]) == 40


@pytest.mark.parametrize("period_us", [300, 2_000])
def test_an_edge_that_would_be_late_ends_the_burst(simavr_board: Start, period_us: int):
    """What its limits rule out: the program is kept from preparing an edge."""
    board = simavr_board()
    box = TriggerBox(board.link())
    box.configure(train(period_us, None, (0, 60), (10, 60)))
    box.arm()
    box.fire()
    while (status := box.status()).running:
        board.tell("block 150")  # until one hits a pulse
    assert "could not make an edge in time" in status.complaints[0]
    assert board.outputs() == (False, False)
    for pin in ("projector", "camera"):
        rises, falls = (np.array(edges) for edges in board.edges(pin))
        assert len(rises) == len(falls)
        assert np.all(np.abs(np.diff(rises) - period_us * 1e-6 * CYCLES) < 1.001)
        assert np.all(np.abs(falls - rises - 60e-6 * CYCLES)[:-1] < 1.001)
        assert falls[-1] - rises[-1] < 250e-6 * CYCLES  # and not for another round of the timer
    assert status.pulses == len(board.edges("camera")[0])


@pytest.mark.parametrize("pin", ["P", "C"])
def test_an_output_that_does_not_follow_ends_the_burst(simavr_board: Start, pin: str):
    """Otherwise all edges after it would be upside down."""
    board = simavr_board()
    box = TriggerBox(board.link())
    box.configure(train(1_000, None, (0, 60), (10, 900)))
    box.arm()
    box.fire()
    wait_for_pulses(box, 2)
    board.tell(f"short {pin}")
    status = finish(box)
    assert "an output did not follow" in status.complaints[0]
    assert board.outputs() == (False, False)
    for name, width_us in (("projector", 60), ("camera", 900)):
        rises, falls = (np.array(edges) for edges in board.edges(name))
        assert max(falls - rises) < (width_us + 50) * 1e-6 * CYCLES


def test_an_endless_burst_ends_when_told_to(simavr_board: Start):
    board = simavr_board()
    box = TriggerBox(board.link())
    box.configure(train(300, None, (0, 100), (0, 150)))
    for cut in range(6):  # at different moments of the period
        before = len(board.edges("camera")[0])
        box.arm()
        box.fire()
        wait_for_pulses(box, 20 + cut)
        box.abort()
        assert board.outputs() == (False, False)
        status = box.status()
        assert not status.running
        assert status.complaints == ()
        assert status.pulses == len(board.edges("camera")[0]) - before
        assert len(board.edges("camera")[1]) == len(board.edges("camera")[0])


def test_a_burst_for_nobody_ends_by_itself(simavr_board: Start):
    board = simavr_board(speed=0)
    link = board.link()
    box = TriggerBox(link)
    box.configure(train(2000, None, (0, 1000), (0, 1900)))
    box.arm()
    box.fire()
    while len(board.edges("camera")[0]) < 1_500:  # 3 s
        time.sleep(0.05)
    assert box.status().running  # that it was asked for its status counts
    asked = board.cycle()
    while board.cycle() < asked + 5.5 * CYCLES:
        time.sleep(0.05)
    last = board.edges("camera")[1][-1]
    assert last - asked == pytest.approx(5 * CYCLES, rel=0.05)
    assert board.outputs() == (False, False)
    status = box.status()
    assert not status.running
    assert any("said nothing" in complaint for complaint in status.complaints)


def test_lost_exposures_are_counted_and_named(simavr_board: Start):
    board = simavr_board()
    board.tell("strobe 20 100")
    box = TriggerBox(board.link(), strobe=True)
    box.configure(train(5_000, 60, (0, 60), (100, 80)))
    box.arm()
    box.fire()
    wait_for_pulses(box, 10)
    board.tell("drop 2")
    status = finish(box)
    assert (status.pulses, status.strobes, status.complaints) == (60, 58, ())
    strobes = box.strobes()
    (first, second) = sorted(set(range(60)) - {strobe.pulse for strobe in strobes})
    assert second == first + 1
    assert {round(1e6 * (strobe.time_s - 0.005 * strobe.pulse), 1) for strobe in strobes} == {120.0}


def test_exposures_that_nothing_triggered(simavr_board: Start):
    board = simavr_board()
    box = TriggerBox(board.link(), strobe=True)
    box.configure(train(300_000, 1, (0, 60), (250_000, 80)))
    box.arm()
    box.fire()
    board.tell("noise S 16000 6")  # three, 2 ms apart
    status = finish(box)
    assert (status.pulses, status.strobes) == (1, 0)
    (complaint,) = status.complaints
    assert "exposed 3 times before the first pulse" in complaint


def test_cables_that_are_out(simavr_board: Start):
    box = TriggerBox(simavr_board().link(), strobe=True, vsync=True)
    box.configure(SHORT)
    box.arm()
    box.fire()
    status = finish(box)
    assert (status.pulses, status.strobes, status.vsyncs) == (40, 0, 0)
    (complaint,) = status.complaints
    assert complaint.startswith("the projector reported no picture:")


@pytest.mark.parametrize("period_cycles", [10, 100, 700])
def test_a_loose_strobe_wire_moves_no_edge(simavr_board: Start, period_cycles: int):
    board = simavr_board()
    box = TriggerBox(board.link(), strobe=True)
    asked = box.configure(train(200, 300, (0, 50), (0, 50)))
    box.arm()
    board.tell(f"noise S {period_cycles} {1_600_000 // period_cycles}")
    box.fire()
    status = finish(box)
    assert status.pulses == 300
    assert "came too fast for exposures" in status.complaints[0]
    assert_exact(board, asked, 300)


def test_a_long_burst_is_read_out_while_it_runs(simavr_board: Start):
    board = simavr_board(speed=1)
    board.tell("strobe 50 100")
    box = TriggerBox(board.link(), strobe=True)
    box.configure(train(8_000, 200, (0, 60), (0, 80)))  # of which the box remembers 128
    box.arm()
    box.fire()
    assert finish(box).strobes == 200
    assert [strobe.pulse for strobe in box.strobes()] == list(range(200))
    assert box.strobes() == ()  # once


def test_what_was_overwritten_is_not_made_up(simavr_board: Start):
    board = simavr_board()
    board.tell("strobe 50 100")
    box = TriggerBox(board.link(), strobe=True)
    box.configure(train(1_000, 400, (0, 60), (0, 80)))
    box.arm()
    box.fire()
    while len(board.edges("camera")[0]) < 400:
        time.sleep(0.02)
    strobes = box.strobes()
    assert [strobe.pulse for strobe in strobes] == list(range(400 - len(strobes), 400))
    assert 120 <= len(strobes) <= 128
    assert finish(box).strobes == 400


def test_exposures_that_come_faster_than_they_are_read_out(simavr_board: Start):
    board = simavr_board()
    board.tell("strobe 0 20")
    box = TriggerBox(board.link(), strobe=True)
    box.configure(train(200, None, (0, 50), (0, 50)))
    box.arm()
    box.fire()
    wait_for_pulses(box, 1_000)
    box.strobes()  # it does not read for ever
    assert box.status().running


def test_a_new_burst_begins_with_nothing_counted(simavr_board: Start):
    board = simavr_board()
    board.tell("strobe 20 100")
    box = TriggerBox(board.link(), strobe=True)
    box.configure(SHORT)
    box.arm()
    box.fire()
    finish(box)
    box.configure(train(500, 1_000, (0, 60), (100, 80)))
    status = box.status()
    assert (status.pulses, status.strobes, status.complaints) == (0, 0, ())
    assert box.strobes() == ()


@pytest.mark.parametrize(
    "cause, words", [(1, "power came on"), (2, "reset was pressed"), (4, "supply broke down"), (0, "boot loader")]
)
def test_a_restart_in_mid_burst(simavr_board: Start, cause: int, words: str):
    board = simavr_board()
    board.tell("strobe 20 100")
    box = TriggerBox(board.link(timeout_s=0.2), strobe=True)
    box.configure(train(1_000, None, (0, 900), (0, 900)))
    box.arm()
    box.fire()
    before = wait_for_pulses(box, 5)
    board.tell(f"reset {cause}")
    assert board.outputs() == (False, False)
    after = box.status()
    assert not after.running
    assert after.boot != before.boot
    assert words in after.complaints[0]
    box.strobes()
    for forgotten in (box.arm, box.fire):
        with pytest.raises(TriggerError, match=r"restarted since it was configured \(.*\): configure it again"):
            forgotten()
    count = len(board.edges("camera")[0])
    box.configure(SHORT)
    box.arm()
    box.fire()
    status = finish(box)
    assert (status.pulses, status.complaints) == (40, ())
    assert len(board.edges("camera")[0]) == count + 40


def test_every_life_has_another_number(simavr_board: Start):
    board = simavr_board()
    box = TriggerBox(board.link(timeout_s=0.2))
    boots = {box.status().boot}
    for cause in (1, 2, 8, 1, 1, 4, 2):
        board.tell(f"reset {cause}")
        boots.add(box.status().boot)
    assert len(boots) == 8


@pytest.mark.parametrize("interrupts_off", [0, 1])
def test_the_watchdog_restarts_a_program_that_hangs(simavr_board: Start, interrupts_off: int):
    board = simavr_board()
    box = TriggerBox(board.link(timeout_s=0.4))
    box.configure(train(1_000, None, (0, 900), (0, 900)))
    box.arm()
    box.fire()
    wait_for_pulses(box, 5)
    board.tell(f"hang {interrupts_off}")
    hung = board.cycle()
    status = box.status()
    assert "its program hung" in status.complaints[0]
    assert not status.running
    last = max(board.edges("camera")[1][-1], board.edges("projector")[1][-1])
    assert last < hung + WATCHDOG_S * CYCLES
    assert board.outputs() == (False, False)


def test_junk_and_lines_in_pieces(simavr_board: Start):
    board = simavr_board()
    link = board.link()
    box = TriggerBox(link)
    box.configure(SHORT)
    box.arm()
    write = link._port.write
    write(bytes(random.Random(1).randrange(256) for _ in range(256)) + b"\n")
    write(b"x" * 300 + b"\n\n\r\n")
    good = b"001 ARM"
    for bad in (good, good + b"*00", good + b"*", good + b"*g1", b"*", b"*00", good.lower() + b"*FF", b"001 ARM\0*00"):
        write(bad + b"\n")
        assert link.receive() is not None  # it says that it could not read it
    for part in (b"42 ", b"ID*", f"{crc8('42 ID'):02X}".encode(), b"\r\n"):
        write(part)
        time.sleep(0.02)
    while not link.receive().startswith("42 OK colorphase-trigger-box"):
        pass
    for number in (" ID", "12345 ID", "ID"):
        link.send(f"{number}*{crc8(number):02X}")
        assert link.receive().startswith("? ERR LINE a sequence number")
    box.fire()
    status = finish(box)
    assert status.pulses == 40
    assert "damaged" in status.complaints[0]
    box.arm()
    box.fire()
    assert finish(box).complaints == ()


def test_fire_is_never_said_twice(simavr_board: Start):
    """Its answer is lost, or itself."""
    board = simavr_board()
    link = board.link(timeout_s=0.3)
    box = TriggerBox(link)
    box.configure(SHORT)
    box.arm()
    board.tell("mute 1")
    box.fire()
    assert finish(box).pulses == 40
    box.arm()
    sent = []
    send = link.send

    def lossy(text: str) -> None:
        sent.append(text)
        send(text.replace("FIRE", "FLRE"))

    link.send = lossy
    with pytest.raises(TriggerError, match="nothing was fired"):
        box.fire()
    link.send = send
    assert sum("FIRE" in text for text in sent) == 1
    assert box.status().pulses == 0
    assert len(board.edges("camera")[0]) == 40
    box.arm()
    box.fire()
    assert finish(box).pulses == 40


def test_an_end_that_is_not_told_is_seen(simavr_board: Start):
    board = simavr_board()
    box = TriggerBox(board.link(timeout_s=0.3))
    box.configure(SHORT)
    box.arm()
    box.fire()
    board.tell("mute 2")  # the end, or the answer to the first questions
    assert finish(box).pulses == 40


def test_a_box_that_hangs_and_comes_back(simavr_board: Start):
    board = simavr_board()
    box = TriggerBox(board.link(timeout_s=0.3))
    box.configure(train(1_000, None, (0, 900), (0, 900)))
    box.arm()
    box.fire()
    board.stop()
    for call in (box.status, box.abort, box.arm):
        started_s = time.monotonic()
        with pytest.raises(TriggerError, match="does not answer"):
            call()
        assert time.monotonic() - started_s < 5
    board.go_on()
    status = box.status()  # and not one of the late answers
    assert not status.running  # it was told to stop, and heard that at last
    box.configure(SHORT)
    box.arm()
    box.fire()
    assert finish(box).pulses == 40


def test_a_box_that_is_gone(simavr_board: Start):
    board = simavr_board()
    box = TriggerBox(board.link(timeout_s=0.3), strobe=True)
    box.configure(SHORT)
    box.arm()
    box.fire()
    board.process.kill()
    board.process.wait()
    for call in (box.status, box.abort, box.arm, box.fire, box.strobes, lambda: box.configure(SHORT)):
        with pytest.raises(TriggerError):
            call()
    box.close()


def test_a_port_that_is_opened_again(simavr_board: Start):
    board = simavr_board()
    link = board.link()
    box = TriggerBox(link)
    box.configure(train(1_000, None, (0, 60), (0, 80)))
    box.arm()
    box.fire()
    with pytest.raises(TriggerError, match="in use"):
        board.link()
    link.close()
    again = TriggerBox(board.link())
    assert again.status().running
    again.close()
    assert board.outputs() == (False, False)


def test_the_emulator_ends_with_its_test(simavr_board: Start):
    board = simavr_board()
    assert board.process.stdin is not None
    board.process.stdin.close()
    assert board.process.wait(5) == 0
