"""Questions and answers by bytes: an answer is never given to another question than its own."""

import pytest
from support.byte_script import scripted

from hardware.errors import TriggerError
from hardware.trigger import _dialogue
from hardware.trigger._dialogue import Dialogue

NAME = r"(?P<maker>\w+),(?P<model>\w+),(?P<serial>\d+),(?P<firmware>[\d.]+)"
IDN = (b"*IDN?\n", b"ACME,P1,17,2.0\r\n")


@pytest.fixture(autouse=True)
def impatient(monkeypatch):
    monkeypatch.setattr(_dialogue, "NAME_S", 0.05)
    monkeypatch.setattr(_dialogue, "QUIET_S", 0.01)


def test_a_name_is_taken_apart():
    with scripted(b"\n", IDN) as link:
        identity = Dialogue(link, NAME, "generator").identity
    assert (identity.maker, identity.model, identity.serial, identity.firmware) == ("ACME", "P1", "17", "2.0")


def test_a_first_question_may_be_swallowed():
    with scripted(b"\n", (b"*IDN?\n", b""), (b"*IDN?\n", b"?\r\n"), IDN) as link:
        assert Dialogue(link, NAME, "generator").identity.model == "P1"


def test_something_else_answers():
    with (
        scripted(b"\n", (b"*IDN?\n", b"Other,Thing,x,y\r\n")) as link,
        pytest.raises(TriggerError, match="this is 'Other,Thing,x,y', not a generator"),
    ):
        Dialogue(link, NAME, "generator")


def test_an_echo_is_no_answer():
    with scripted(b"\n", IDN, (b"STATE?\n", b"STATE?\r\n1\r\n")) as link:
        assert Dialogue(link, NAME, "generator").ask("STATE?", r"\d") == "1"


def test_after_an_answer_that_makes_no_sense_the_name_is_asked_first():
    with scripted(b"\n", IDN, (b"STATE?\n", b"x\r\n"), IDN, (b"STATE?\n", b"0\r\n")) as link:
        assert Dialogue(link, NAME, "generator").ask("STATE?", r"\d") == "0"


def test_a_question_that_must_not_be_repeated_is_asked_once():
    with scripted(b"\n", IDN, (b"STATE?\n", b"x\r\n")) as link:
        dialogue = Dialogue(link, NAME, "generator")
        with pytest.raises(TriggerError, match=r"answers 'STATE\?' with 'x', which makes no sense"):
            dialogue.ask("STATE?", r"\d", once=True)


def test_what_is_left_over_is_thrown_away():
    with scripted(b"\n", (b"*IDN?\n", b"ACME,P1,17,2.0\r\n9\r\n"), (b"STATE?\n", b"1\r\n")) as link:
        assert Dialogue(link, NAME, "generator").ask("STATE?", r"\d") == "1"
