"""Switching a projector takes minutes, in which it may be busy, silent, or never get there."""

import pytest

from hardware.errors import ProjectorError, RigError
from hardware.projector import switching
from hardware.projector.switching import port_of, switch_power
from hardware.settings import ProjectorSettings


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(switching, "POLL_S", 0.001)


def test_the_command_is_sent_until_it_is_taken_and_then_no_more():
    states = iter(["off", None, "off", "warming up", None, "on"])
    sent, said = [], []

    def command():
        sent.append(len(said))
        return len(sent) == 3

    switch_power(True, lambda: next(states), command, said.append)
    assert sent == [0, 1, 2]
    assert said == [
        "waiting to switch it on",
        "waiting to switch it on",
        "off",
        "warming up",
        "waiting to switch it on",
    ]


def test_what_is_on_already_is_left_alone():
    switch_power(True, lambda: "on", lambda: pytest.fail("it is sent"), lambda text: pytest.fail("it is told"))


@pytest.mark.parametrize("state, said", [("cooling down", "but cooling down"), (None, "but silent")])
def test_it_has_a_deadline(monkeypatch, state, said):
    monkeypatch.setattr(switching, "DEADLINE_S", 0.02)
    with pytest.raises(ProjectorError, match=rf"is not off after 0\.02 s {said}"):
        switch_power(False, lambda: state, lambda: True, lambda text: None)


def test_where_it_is_must_be_written():
    assert port_of(ProjectorSettings(port="COM3"), "COM4") == "COM3"
    with pytest.raises(RigError, match=r'write where it is connected, as port = "COM4"'):
        port_of(ProjectorSettings(), "COM4")
