"""InFocus's commands against an emulator written from their manuals."""

import os
import time

import pytest

pytest.importorskip("termios", reason="this system has no pseudo-terminals")

from support.emulators.emulated_infocus import InFocusProjector

from hardware.errors import ProjectorError
from hardware.projector import infocus, open_projector, switching
from hardware.projector.infocus import InFocus
from hardware.protocols import ProjectorStatus
from hardware.settings import ProjectorSettings

PAUSE_S = 0.03


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    assert infocus.PAUSE_S == 3.0  # what the manuals ask for
    monkeypatch.setattr(infocus, "PAUSE_S", PAUSE_S)
    monkeypatch.setattr(infocus, "ANSWER_S", 0.2)
    monkeypatch.setattr(switching, "POLL_S", 0.02)


def test_what_it_says_of_itself_never_asked_too_soon():
    with InFocusProjector(pause_s=PAUSE_S) as device:
        projector = open_projector(ProjectorSettings(control="infocus", port=device.url))
        assert projector.identity.maker == "InFocus"
        assert projector.status() == ProjectorStatus("off", None, None, None, (42,))
        device.settings.update(PWR=1, SRC=3, BLK=1)
        assert projector.status() == ProjectorStatus("on", "3", True, None, (42,))
        assert device.too_soon == 0
        projector.close()
        projector.close()


@pytest.mark.parametrize(
    ("answer", "echo"),
    [("(0-1,{})", True), ("( 0 - 1 , {} )", False), ("(PWR{})", False), ("(PWR!{})", True), ("> (0-1,00{})", False)],
)
def test_power_however_it_is_told(answer, echo):
    """No manual shows the answer to (PWR?)."""
    with InFocusProjector(echo=echo, power_answer=answer) as device:
        device.switching_s = 0.1
        projector = InFocus(device.url)
        said = []
        device.lost_answers = 1 + echo  # it is busy
        assert projector.power(True, said.append) is True
        assert device.settings["PWR"] == 1
        assert said
        projector.power(False)
        assert device.settings["PWR"] == 0
        assert [line for line in device.received if line in ("(PWR1", "(PWR0")] == ["(PWR1", "(PWR0"]  # each once
        projector.close()


def test_power_has_a_deadline(monkeypatch):
    monkeypatch.setattr(switching, "DEADLINE_S", 0.3)
    with InFocusProjector() as device:
        device.obeys = False
        projector = InFocus(device.url)
        with pytest.raises(ProjectorError, match=r"not on after 0\.3 s but off"):
            projector.power(True)
        projector.close()


def test_a_power_state_of_its_own_is_not_guessed():
    with InFocusProjector(power_answer="(0-3,2)") as device:
        projector = InFocus(device.url)
        assert projector.status().power is None
        assert projector.power(True) is False  # nothing tells when it is, so it only is sent
        assert projector.status().blank is False  # by now it has obeyed
        assert device.settings["PWR"] == 1
        projector.close()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"silent": True}, r"does not answer \(PWR\?\) at 19200, 38400, 115200 baud"),
        ({"power_answer": "ACK"}, r"does not answer \(PWR\?\)"),
        ({"write_only": {"PWR"}}, r"does not answer \(PWR\?\)"),
        ({"babbling": True}, "sends without a pause"),
    ],
)
def test_what_is_no_projector(change, message):
    with InFocusProjector() as device:
        for name, value in change.items():
            setattr(device, name, value)
        start_s = time.monotonic()
        with pytest.raises(ProjectorError, match=message) as fault:
            InFocus(device.url)
        assert "\n" not in str(fault.value)
        assert time.monotonic() - start_s < 20  # deadlines, not a benchmark


def test_the_cable_is_pulled():
    with InFocusProjector() as device:
        projector = InFocus(device.url, 38400)
        device.unplug()
        with pytest.raises(ProjectorError, match="is gone"):
            projector.status()
        projector.close()


def test_there_is_no_port():
    with pytest.raises(ProjectorError, match="there is no port"):
        InFocus(os.path.join(os.sep, "dev", "ttyNONE"))
