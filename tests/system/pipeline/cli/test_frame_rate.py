"""Frames a second: of this run, from when they were done."""

import pytest

from pipeline.cli.console import FrameRate


def rate_of(*reports):
    """Return the rate after reports: seconds since the first one, and how many are done."""
    times_s = iter([100.0 + after_s for after_s, _ in reports])
    rate = FrameRate(lambda: next(times_s))
    for _, done in reports:
        rate.note(done)
    return rate.per_s()


def test_frames_that_are_reported_all_at_once_have_no_rate():
    assert rate_of() is None
    assert rate_of((0, 0)) is None
    assert rate_of(*((1e-5 * n, n) for n in range(1, 41))) is None


def test_neither_the_start_nor_what_was_done_before_counts():
    """The first report has 12 frames, whatever they took; from then on there are ten a second."""
    assert rate_of((0, 312), (0.5, 317), (1.0, 322), (2.0, 332)) == pytest.approx(10.0)
    assert rate_of((0, 312), (0.1, 317), (1.1, 327)) == pytest.approx(10 / 1.1)


@pytest.mark.parametrize("together", [1, 5])
def test_reports_that_come_together_are_one(together):
    """Two processes report every half second, each what it has done since."""
    reports = [(0.5 * k + 1e-4 * i, 5 * k + i) for k in range(40) for i in range(together)]
    assert rate_of(*reports) == pytest.approx(10.0, rel=0.06)


def test_it_follows_the_last_half_minute():
    slow = [(s, s) for s in range(100)]
    fast = [(100 + s, 100 + 5 * s) for s in range(40)]
    assert rate_of(*slow, *fast) == pytest.approx(5.0)
