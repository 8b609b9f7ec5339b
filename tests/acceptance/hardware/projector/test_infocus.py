"""InFocus's commands against an emulator written from their manuals."""

import pytest
from support.emulators.emulated_infocus import InFocusProjector

from hardware.errors import ProjectorError
from hardware.projector import infocus, switching
from hardware.projector.infocus import InFocus
from hardware.protocols import ProjectorStatus

PAUSE_S = 0.03


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    assert infocus.PAUSE_S == 3.0  # what the manuals ask for
    monkeypatch.setattr(infocus, "PAUSE_S", PAUSE_S)
    monkeypatch.setattr(infocus, "ANSWER_S", 0.2)
    monkeypatch.setattr(switching, "POLL_S", 0.02)


def test_input_and_blank():
    with InFocusProjector() as device:
        device.settings["PWR"] = 1
        projector = InFocus(device.url)
        projector.input("4")
        assert device.settings["SRC"] == 4
        with pytest.raises(ProjectorError, match=r"takes \(SRC\) from 0 to 5, not 6"):
            projector.input("6")
        with pytest.raises(ProjectorError, match="give the number in its manual"):
            projector.input("hdmi")
        projector.blank(True)
        assert device.settings["BLK"] == 1
        device.obeys = False
        with pytest.raises(ProjectorError, match=r"did not take \(BLK0\)"):
            projector.blank(False)
        device.obeys = True
        device.write_only = {"BLK"}  # as of the LP840
        projector.blank(False)
        assert device.settings["BLK"] == 0
        assert projector.status().blank is None
        projector.close()


def test_an_answer_to_an_earlier_question_is_not_taken(monkeypatch):
    monkeypatch.setattr(infocus, "PAUSE_S", 0.3)
    with InFocusProjector() as device:
        projector = InFocus(device.url)
        device.settings["PWR"] = 1
        device.late_answers = [0.3]
        device.settings["LMP"] = 7
        assert projector.status() == ProjectorStatus(None, "0", False, None, (7,))  # the power's came too late
        projector.close()
