"""Requests to stop: the first one stops, none cuts in two what belongs together."""

import signal
from contextlib import suppress

import pytest

from pipeline.acquisition.session import Stopping


def press(number=signal.SIGINT):
    signal.raise_signal(number)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_first_request_stops_and_others_are_ignored(number):
    stopping = Stopping()
    with stopping.listening():
        with pytest.raises(KeyboardInterrupt):
            press(number)
        press(number)
    assert stopping.asked


def test_what_is_shielded_ends_first():
    stopping, done = Stopping(), []
    with stopping.listening(), pytest.raises(KeyboardInterrupt):
        with stopping.shield():
            press()
            done.append("the burst is whole")
        done.append("never")
    assert done == ["the burst is whole"]


def test_while_everything_is_closed_requests_are_ignored():
    stopping = Stopping()
    with stopping.listening():
        stopping.ignore()
        press()
        with stopping.shield():
            press()
    assert stopping.asked


def test_a_request_that_a_library_has_lost_stops_at_the_next_look():
    stopping = Stopping()
    with stopping.listening():
        stopping.check()
        with suppress(KeyboardInterrupt):
            press()
        with pytest.raises(KeyboardInterrupt):
            stopping.check()
        stopping.ignore()
        stopping.check()


def test_handlers_are_those_of_before():
    before = signal.getsignal(signal.SIGINT)
    with Stopping().listening():
        assert signal.getsignal(signal.SIGINT) != before
    assert signal.getsignal(signal.SIGINT) == before
