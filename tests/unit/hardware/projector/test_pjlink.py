"""PJLink against an emulator written from its standard."""

import socket
import threading
import time

import pytest
from support.emulators.emulated_pjlink import PJLinkProjector

from hardware.errors import ProjectorError, RigError
from hardware.projector import open_projector, pjlink, switching
from hardware.projector.pjlink import PJLink
from hardware.protocols import ProjectorStatus
from hardware.settings import ProjectorSettings

PASSWORD = "JBMIAProjectorLink"


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(pjlink, "ANSWER_S", 0.5)
    monkeypatch.setattr(switching, "POLL_S", 0.02)


@pytest.fixture
def device():
    with PJLinkProjector() as device:
        yield device


def test_the_digest_is_the_standards_example():
    """Its section on authentication: this number and this password give this digest."""
    with PJLinkProjector(PASSWORD) as device:
        device.salt = "498e4a67"
        PJLink(device.url, PASSWORD)
        assert device.digests == ["5d8409bc1c3fa39749434aa3a5c38682"]


def test_what_it_says_of_itself(device):
    projector = PJLink(device.url)
    assert str(projector.identity) == "ACME X-1"
    assert projector.status() == ProjectorStatus("off", None, None, (), (1234,))
    device.switch(True)
    device.errors = "012001"
    device.lamps = "100 1 20 0"
    assert projector.status() == ProjectorStatus(
        "on", "11", False, ("lamp: warning", "temperature: error", "other: warning"), (100, 20)
    )
    device.mute = "11"
    assert projector.status().blank is True
    device.mute = "21"  # the sound only
    assert projector.status().blank is False
    device.fixed["LAMP"] = "ERR1"  # what one with a laser says
    assert projector.status().lamp_hours == ()
    device.fixed["LAMP"] = device.fixed["ERST"] = "???"
    assert projector.status().lamp_hours is projector.status().faults is None
    projector.close()
    projector.close()


def test_power_waits_until_it_is_carried_out(device):
    device.settling_s, device.warming_s, device.cooling_s = 0.1, 0.3, 0.3
    projector = PJLink(device.url)
    time.sleep(0.5)
    said = []
    projector.power(True, said.append)
    assert device.power == "1"
    assert "warming up" in said
    projector.power(False, said.append)
    assert device.power == "0"
    assert "cooling down" in said
    # It takes no command while it cools, so this one is repeated until it does.
    device.settling_s = 0.0
    device.switch(False)
    said.clear()
    projector.power(True, said.append)
    assert device.power == "1"
    assert said[-1] == "warming up"
    device.received.clear()
    projector.power(True)  # it is on
    assert device.received == ["%1POWR ?"]


def test_power_has_a_deadline(device, monkeypatch):
    monkeypatch.setattr(switching, "DEADLINE_S", 0.2)
    device.warming_s = 60
    with pytest.raises(ProjectorError, match=r"not on after 0\.2 s but warming up"):
        PJLink(device.url).power(True)
    device.fixed["POWR"] = "ERR4"
    with pytest.raises(ProjectorError, match="it has failed"):
        PJLink(device.url)


def test_input_and_blank(device):
    device.switch(True)
    projector = PJLink(device.url)
    projector.input("32")
    assert device.input == "32"
    with pytest.raises(ProjectorError, match="no input 33: choose one of 11 31 32"):
        projector.input("33")
    with pytest.raises(ProjectorError, match="no input 'hdmi'"):
        projector.input("hdmi")
    projector.blank(True)
    assert device.mute == "31"
    projector.blank(False)
    assert device.mute == "30"
    device.switch(False)
    for call in (lambda: projector.blank(True), lambda: projector.input("11")):
        with pytest.raises(ProjectorError, match="not while it is off"):
            call()


def test_blank_where_sound_cannot_be_muted(device, monkeypatch):
    taken = []

    def answer(command, parameter):
        taken.append(parameter)
        return "ERR2" if parameter[0] == "3" else "OK"

    projector = PJLink(device.url)
    monkeypatch.setattr(device, "answer", answer)
    projector.blank(True)
    projector.blank(False)
    assert taken == ["31", "11", "30", "10"]


def test_the_password_is_asked_for_checked_and_never_told(caplog):
    caplog.set_level(0)
    with PJLinkProjector(PASSWORD) as device:
        assert PJLink(device.url, PASSWORD).status().power == "off"
        assert len(device.digests) == device.connections  # one a connection
        faults = []
        for password in (None, "", "Wrong" + PASSWORD):
            with pytest.raises(ProjectorError, match="PJLink password") as fault:
                PJLink(device.url, password)
            faults.append(str(fault.value))
        device.silent = True
        with pytest.raises(ProjectorError, match="does not answer POWR") as fault:
            PJLink(device.url, PASSWORD)
        faults.append(str(fault.value))
        for text in [*faults, caplog.text]:
            assert PASSWORD not in text
            assert not any(digest in text for digest in device.digests)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"greeting": b"SSH-2.0-OpenSSH_9.2\r\n"}, "is no PJLink projector, it greets with 'SSH-2.0-OpenSSH_9.2'"),
        ({"greeting": b"PJLINK 2 0123456789abcdef\r"}, "is no PJLink projector"),
        ({"greeting": b"\xff\xfd\x18"}, "does not greet as PJLink does"),
        ({"silent": True}, "does not answer POWR"),
        ({"rambles": True}, "does not answer POWR"),
        ({"delay_s": 1.0}, "does not answer POWR"),
        ({"hangs_up_after": 0}, "hung up"),
        ({"fixed": {"POWR": "7"}}, "answers '7' when asked for its power"),
        ({"fixed": {"POWR": "ERR1"}}, "does not have that function"),
    ],
)
def test_what_is_no_projector_or_a_broken_one(device, change, message):
    for name, value in change.items():
        setattr(device, name, value)
    start_s = time.monotonic()
    with pytest.raises(ProjectorError, match=message) as fault:
        PJLink(device.url).status()
    assert "\n" not in str(fault.value)
    assert time.monotonic() - start_s < 5  # a deadline of half a second, not a benchmark


def test_it_may_hang_up_between_two_calls_and_answer_late(device):
    projector = PJLink(device.url)
    device.before_answer = b"%1LAMP=99 0\r"  # an answer to what was asked before
    assert projector.status().power == "off"
    device.before_answer = b""
    device.hangs_up_after = 0
    with pytest.raises(ProjectorError, match="hung up"):
        projector.status()
    device.hangs_up_after = None
    assert projector.status().power == "off"


def test_nobody_there():
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with pytest.raises(ProjectorError, match="cannot be reached"):
        PJLink(f"socket://127.0.0.1:{port}")
    for host in ("a..b", "a" * 64):
        with pytest.raises(ProjectorError, match="can be no host's name"):
            PJLink(f"socket://{host}:{port}")
    with pytest.raises(ProjectorError, match="PJLink is spoken over the network"):
        PJLink("socket://127.0.0.1")


def test_open_projector_says_what_the_rig_file_lacks(device):
    with pytest.raises(RigError, match="control"):
        open_projector(ProjectorSettings())
    for control, example in (("pjlink", "4352"), ("infocus", "/dev/ttyUSB0")):
        with pytest.raises(RigError, match=rf"projector\.port is missing.*{example}"):
            open_projector(ProjectorSettings(control=control))
    found = open_projector(ProjectorSettings(control="pjlink", port=device.url))
    assert found.identity.model == "X-1"


def test_no_thread_or_connection_is_left(device):
    before = threading.active_count()
    projector = PJLink(device.url)
    for _ in range(3):
        projector.status()
    deadline = time.monotonic() + 5
    while threading.active_count() > before and time.monotonic() < deadline:
        time.sleep(0.01)  # a thread of the emulator's ends when its connection is closed
    assert threading.active_count() <= before
