import errno
import grp
import os
import socket
import termios
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial
from support.emulators.emulated_line import Emulator

from hardware.errors import ProjectorError, TriggerError
from hardware.link import LONGEST_LINE, Link

pytestmark = pytest.mark.timeout(30)


class Parrot(Emulator):
    """Says every line again."""

    def answer(self, line: str) -> list[str]:
        """Return it."""
        return [line]

    def restart(self) -> None:
        """Know nothing, as before."""


@pytest.fixture
def parrot(request: pytest.FixtureRequest) -> Iterator[Parrot]:
    with Parrot(network=getattr(request, "param", False)) as parrot:
        yield parrot


over_tcp_too = pytest.mark.parametrize("parrot", [False, True], ids=["pty", "tcp"], indirect=True)


@pytest.fixture
def link(parrot: Parrot) -> Iterator[Link]:
    link = Link(parrot.url, timeout_s=0.3)
    yield link
    link.close()


def ask(link: Link, text: str) -> str | None:
    link.send(text)
    return link.receive()


@over_tcp_too
def test_lines_come_back_without_their_ends(link):
    assert ask(link, "A 1") == "A 1"
    assert ask(link, "") == ""
    assert link.receive(0) is None


@over_tcp_too
def test_part_of_a_line_waits_for_its_rest(link, parrot):
    ask(link, "x")  # the network's other side is there
    parrot.say(b"OK 12")
    assert link.receive(0.1) is None
    parrot.say(b"34\r\nOK")
    assert link.receive() == "OK 1234"
    assert link.receive(0.1) is None
    parrot.say(b"\r\n")
    assert link.receive() == "OK"
    assert link.damaged == 0


@pytest.mark.parametrize("noise", [b"\xffOK\n", b"O\x00K\n", b"x" * 5 * LONGEST_LINE + b"\n", b"\x1b[2J\n"])
def test_damaged_lines_are_dropped_and_counted(link, parrot, noise):
    ask(link, "x")
    parrot.say(noise + b"OK\n")
    assert link.receive() == "OK"
    assert link.damaged == 1


def test_a_line_as_long_as_allowed_is_whole(link):
    assert ask(link, "x" * LONGEST_LINE) == "x" * LONGEST_LINE
    assert link.damaged == 0


def test_settling_throws_away_what_came_and_what_still_comes(link, parrot):
    parrot.late_answers = [0.05, 0.05]
    link.send("first")
    link.send("second")
    parrot.say(b"half a line")
    link.settle(quiet_s=0.2)
    assert link.receive(0.1) is None
    assert ask(link, "third") == "third"


@over_tcp_too
def test_what_never_stops_sending_is_an_error_and_no_trap(link, parrot):
    ask(link, "x")
    parrot.babbling = True
    assert link.receive(0.1) is None
    with pytest.raises(TriggerError, match=r"sends without a pause: .*baud"):
        link.settle()


@over_tcp_too
def test_every_use_of_an_unplugged_port_is_one_error(link, parrot):
    ask(link, "x")
    parrot.unplug()
    for use in (link.receive, link.settle, lambda: ask(link, "x")):
        with pytest.raises(TriggerError, match=r"is gone: the cable is out"):
            use()
    link.close()
    link.close()
    with pytest.raises(TriggerError, match=r"is closed"):
        link.send("x")


@pytest.mark.parametrize(
    "failure", [serial.SerialException("read failed"), OSError(errno.EIO, "I/O"), termios.error(5, "I/O")], ids=repr
)
@pytest.mark.parametrize("method", ["in_waiting", "read", "write"])
def test_the_three_exceptions_of_an_unplugged_port_are_one(failure, method):
    class Unplugged:
        is_open = True

        def fail(self, *_: object) -> int:
            raise failure

        in_waiting = property(fail) if method == "in_waiting" else 3
        read = write = fail

    link = Link("loop://", error=ProjectorError)
    link.close()
    link._port = Unplugged()
    with pytest.raises(ProjectorError, match=r"loop:// is gone") as caught:
        link.send("x") if method == "write" else link.receive()
    assert caught.value.__cause__ is failure


@over_tcp_too
def test_a_port_that_takes_nothing_is_told_and_can_be_closed(parrot):
    parrot.stuck = True
    link = Link(parrot.url, timeout_s=0.3)
    with pytest.raises(TriggerError, match=r"took nothing for 0.3 s"):
        for _ in range(10_000):
            link.send("x" * 10_000)
    link.close()


def test_closing_drops_what_a_port_does_not_take():
    """Else the kernel waits for it, for up to half a minute."""
    calls = []

    class Full:
        is_open = True
        out_waiting = 17

        def reset_output_buffer(self) -> None:
            calls.append("dropped")

        def close(self) -> None:
            calls.append("closed")
            self.is_open = False

    link = Link("loop://")
    link.close()
    link._port = Full()
    link.close()
    link.close()
    assert calls == ["dropped", "closed"]


def test_a_port_is_taken_by_one_program_and_free_again_after(parrot):
    first = Link(parrot.url)
    with pytest.raises(TriggerError, match=r"is in use: close the other program"):
        Link(parrot.url)
    first.close()
    second = Link(parrot.url, timeout_s=0.3)
    assert ask(second, "x") == "x"
    second.close()


def test_boards_are_not_restarted(monkeypatch):
    """DTR is low before the port is opened."""
    opened = []

    class Port:
        is_open = False
        dtr = True

        def open(self) -> None:
            opened.append(self.dtr)

    monkeypatch.setattr(serial, "serial_for_url", lambda *_, **__: Port())
    Link("/dev/ttyUSB0")
    assert opened == [False]


def test_other_ends_and_errors():
    link = Link("loop://", terminator=b")", timeout_s=0.1, error=ProjectorError)
    assert ask(link, "(PWR1") == "(PWR1"
    assert ask(link, "\x00") is None
    link.close()


def test_the_last_byte_of_a_longer_end_is_enough():
    link = Link("loop://", terminator=b"\r\n", timeout_s=0.1)
    link._port.write(b"one\ntwo\r\n\r\nthree\r\r\n")
    assert [link.receive() for _ in range(5)] == ["one", "two", "", "three", None]
    link.close()


@pytest.mark.parametrize(
    "url, message",
    [
        ("/dev/nonesuch", r"there is no port /dev/nonesuch: `colorphase devices` lists"),
        ("", r"there is no port : `colorphase devices`"),
        ("/dev/null", r"/dev/null is not a serial port that works \(.*\): `colorphase devices`"),
        ("/tmp", r"/tmp is not a serial port that works"),
        ("file:///dev/ttyUSB0", r"file:// is not spoken; write a serial device, .*socket://, rfc2217://, loop://"),
        ("hwgrep://.*", r"hwgrep:// is not spoken"),
        ("socket://127.0.0.1", r"write host and port, as socket://10.0.0.5:5025"),
        ("socket://:5025", r"write host and port"),
        ("rfc2217://127.0.0.1:999999", r"write host and port, as rfc2217://"),
        ("socket://127.0.0.1:1", r"does not answer \(.*refused\): check its power and the address"),
        ("rfc2217://127.0.0.1:1", r"does not answer"),
    ],
)
def test_bad_ports_are_told_in_one_line(url, message):
    with pytest.raises(TriggerError, match=message) as caught:
        Link(url)
    assert "\n" not in str(caught.value)


def test_handlers_that_write_files_are_not_called(tmp_path):
    with pytest.raises(TriggerError, match=r"spy:// is not spoken"):
        Link(f"spy:///dev/null?file={tmp_path}/log")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("baud", [0, -1, 10**12])
def test_a_baud_rate_that_no_port_has(baud):
    with Parrot() as parrot, pytest.raises(TriggerError, match=rf"cannot be set to {baud} baud"):
        Link(parrot.url, baud=baud)


def test_a_port_without_the_right_to_it_names_its_group(monkeypatch, tmp_path):
    port = tmp_path / "ttyUSB0"
    port.touch()
    group = next(entry for entry in grp.getgrall() if entry.gr_name not in ("root", "wheel"))
    real = Path.stat

    def stat(self: Path, **kinds: bool) -> os.stat_result:
        known = list(real(self, **kinds))
        known[5] = group.gr_gid
        return os.stat_result(known)

    def refuse(*_: object) -> int:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "stat", stat)
    monkeypatch.setattr(os, "open", refuse)
    monkeypatch.setenv("USER", "ada")
    with pytest.raises(
        TriggerError, match=rf"may not be opened: .*`sudo usermod -aG {group.gr_name} ada`, then log in"
    ):
        Link(str(port))


@pytest.mark.parametrize(
    "text, message",
    [
        ("could not open port 'COM3': PermissionError(13, 'Access is denied.', None, 5)", r"COM3 is in use"),
        ("could not open port 'COM3': FileNotFoundError(2, 'cannot find', None, 2)", r"there is no port COM3"),
    ],
)
def test_windows_says_it_in_words_only(monkeypatch, text, message):
    class Port:
        def open(self) -> None:
            raise serial.SerialException(text)

    monkeypatch.setattr(serial, "serial_for_url", lambda *_, **__: Port())
    with pytest.raises(TriggerError, match=message):
        Link("COM3")


def test_a_network_port_that_is_closed_by_the_other_side_leaves_nothing_open():
    with socket.create_server(("127.0.0.1", 0)) as server:
        link = Link(f"socket://127.0.0.1:{server.getsockname()[1]}", timeout_s=0.3)
        kept = link._port._socket
        server.accept()[0].close()
        time.sleep(0.05)
        with pytest.raises(TriggerError, match=r"is gone"):
            link.receive()
        link.close()
        assert kept.fileno() == -1
