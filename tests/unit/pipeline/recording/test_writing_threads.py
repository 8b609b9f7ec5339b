"""Threads that write frames: numbers, commits and errors, with a writer that keeps them in memory."""

import threading

import numpy as np
import pytest

from pipeline.recording.writing_threads import WritingThreads

LIKE = np.zeros((2, 3), np.uint8)


class Kept:
    """A writer that keeps frames by their numbers; `gate` holds it up, `broken` is a number it cannot write."""

    most_threads = 3

    def __init__(self, broken=None):
        self.frames, self.n_frames, self.closed = {}, 0, False
        self.gate = threading.Event()
        self.gate.set()
        self._broken = broken

    def write(self, number, frame):
        """Keep a copy of a frame."""
        self.gate.wait(20)
        if number == self._broken:
            raise OSError(28, "No space left on device")
        self.frames[number] = frame.copy()
        return frame.nbytes

    def commit(self, n_frames):
        """Note how many frames are to stay, all of which must be there."""
        assert set(range(n_frames)) <= set(self.frames)
        self.n_frames = n_frames

    def close(self):
        """Note that it was called."""
        self.closed = True


def started(writer):
    threads = WritingThreads(lambda: writer, writer.most_threads, LIKE)
    threads.start()
    return threads


def test_frames_are_numbered_in_the_order_in_which_they_are_added():
    writer = Kept()
    threads = started(writer)
    for value in range(200):  # more than are in hand at once
        threads.add(np.full_like(LIKE, value))
    threads.commit()
    assert {number: int(frame[0, 0]) for number, frame in writer.frames.items()} == {n: n for n in range(200)}
    assert (threads.n_added, threads.n_committed, threads.n_bytes) == (200, 200, 200 * LIKE.nbytes)
    threads.stop()
    assert writer.closed


def test_the_caller_may_change_a_frame_that_it_has_added():
    writer = Kept()
    writer.gate.clear()
    threads = started(writer)
    frame = np.full_like(LIKE, 7)
    threads.add(frame)
    frame[:] = 9
    writer.gate.set()
    threads.commit()
    assert (writer.frames[0] == 7).all()
    threads.stop()


def test_what_goes_wrong_is_raised_by_the_next_call():
    writer = Kept(broken=3)
    threads = started(writer)
    for _ in range(3):
        threads.add(LIKE)
    threads.commit()
    with pytest.raises(OSError, match="No space left"):
        threads.add(LIKE)
        threads.commit()
    assert threads.n_committed == 3
    threads.stop()
    assert writer.closed


def test_a_writer_that_cannot_be_made():
    def refuse():
        raise PermissionError(13, "Permission denied")

    threads = WritingThreads(refuse, 1, LIKE)
    with pytest.raises(PermissionError):
        threads.start()
    threads.stop()
    assert threads.n_committed == 0
