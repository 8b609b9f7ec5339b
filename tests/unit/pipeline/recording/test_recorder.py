"""Our own recordings: nothing is lost, and nothing half-written looks whole."""

import errno
import signal
import threading
from contextlib import contextmanager
from fractions import Fraction

import numpy as np
import pytest
import zarr
from support.numbered_frames import RGB8, frames_of, record, rgb

from pipeline.errors import FootageError, OutputError
from pipeline.footage.opening import open_footage
from pipeline.recording.recorder import Recorder, WritingThreads
from tikernels import ShapeError
from tikernels.raw.pixel_format import PixelFormat

RGB12, RGB16 = PixelFormat("rgb", 12), PixelFormat("rgb", 16)
BAYER8, BAYER12 = PixelFormat("bayer", bayer="gbrg"), PixelFormat("bayer", 12, bayer="grbg")
FORMATS = [RGB8, RGB12, RGB16, BAYER8, BAYER12]


@pytest.mark.parametrize("format", FORMATS, ids=str)
def test_there_and_back(tmp_path, format):
    path = tmp_path / "Aufnahme 1 ä.zarr"
    frames = record(path, format, transfer="srgb", rate_hz=Fraction(30000, 1001))
    assert [left.name for left in tmp_path.iterdir()] == [path.name]
    source = open_footage(path)
    assert len(source) == 9
    assert source.transfer == "srgb"
    assert source.notes == ()
    assert source.size_px == (34, 22)
    assert (source.format.layout, source.format.bits) == (format.layout, format.bits)
    if format.layout == "bayer":
        assert source.format == format
    for start, stop, step in ((0, None, 1), (4, 5, 1), (1, None, 3)):
        got = list(source.frames(start, stop, step))
        assert [frame.number for frame in got] == list(range(9))[start:stop:step]
        for frame in got:
            np.testing.assert_array_equal(rgb(frame.planes, frame.format), frames[frame.number])
    source.close()


def test_black_frames_are_frames(tmp_path):
    black = np.zeros((22, 34, 3), np.uint8)
    with Recorder(tmp_path / "black.zarr", RGB8) as recorder:
        recorder.add(black)
    (frame,) = open_footage(tmp_path / "black.zarr").frames()
    np.testing.assert_array_equal(frame.planes[0], black)


def test_an_error_leaves_nothing(tmp_path):
    recorder = Recorder(tmp_path / "a.zarr", RGB8)
    with pytest.raises(KeyboardInterrupt), recorder:
        recorder.add(frames_of(RGB8)[0])
        assert not (tmp_path / "a.zarr").exists()
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_one_clear_error(tmp_path, monkeypatch):
    recorder = Recorder(tmp_path / "a.zarr", RGB8)
    recorder.add(frames_of(RGB8)[0])

    def full(number, frame):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(recorder._threads._writer, "write", full)
    with pytest.raises(OutputError, match="the disk is full: free some space"):
        recorder.add(frames_of(RGB8)[0])
        recorder.commit()
    assert list(tmp_path.iterdir()) == []


@contextmanager
def no_room():
    """Let no file grow beyond ten bytes: what a full disk does, with another number."""
    resource = pytest.importorskip("resource", reason="Windows has no such limits")
    before, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


@pytest.mark.parametrize("n_frames", [0, 3])
def test_a_disk_that_is_full_at_once_or_at_the_end(tmp_path, n_frames):
    recorder = Recorder(tmp_path / "a.zarr", RGB8)
    for frame in frames_of(RGB8, n_frames):
        recorder.add(frame)
    with no_room(), pytest.raises(OutputError, match=r"cannot record to .*: files may not be as large there"):
        if not n_frames:
            recorder.add(frames_of(RGB8)[0])
        recorder.close()
    assert list(tmp_path.iterdir()) == []


def test_nothing_recorded(tmp_path):
    Recorder(tmp_path / "a.zarr", RGB8).close()
    assert list(tmp_path.iterdir()) == []


def test_what_a_recorder_refuses(tmp_path):
    with pytest.raises(OutputError, match=r"must end in \.zarr"):
        Recorder(tmp_path / "a.mp4", RGB8)
    (tmp_path / "a.zarr").mkdir()
    with pytest.raises(OutputError, match="it exists"):
        Recorder(tmp_path / "a.zarr", RGB8)
    with pytest.raises(ShapeError, match="develop other frames first"):
        Recorder(tmp_path / "b.zarr", PixelFormat("yuv"))
    with pytest.raises(ShapeError, match="rate_hz is 501"):
        Recorder(tmp_path / "b.zarr", RGB8, rate_hz=501)
    with pytest.raises(ShapeError, match="transfer is 'gamma'"):
        Recorder(tmp_path / "b.zarr", RGB8, transfer="gamma")
    with pytest.raises(OutputError, match="its folder does not exist"):
        Recorder(tmp_path / "absent" / "b.zarr", RGB8).add(frames_of(RGB8)[0])
    with Recorder(tmp_path / "b.zarr", RGB8) as recorder:
        for bad in (frames_of(RGB16)[0], frames_of(BAYER8)[0], frames_of(RGB8)[0][0, 0]):
            with pytest.raises(ShapeError, match="expected"):
                recorder.add(bad)
        recorder.add(frames_of(RGB8)[0])
        with pytest.raises(ShapeError, match="frame is 34x21 but the first one is 34x22"):
            recorder.add(frames_of(RGB8)[0][:-1])


@pytest.mark.parametrize(
    "key, value, reason",
    [
        ("rate_hz", "0", "rate_hz is 0"),
        ("rate_hz", "1/0", "rate '1/0' is no fraction"),
        ("rate_hz", "1e999999999", "is no fraction"),
        ("transfer", "gamma", "transfer is 'gamma': choose linear, srgb, bt709"),
    ],
)
def test_what_no_recorder_writes(tmp_path, key, value, reason):
    path = tmp_path / "a.zarr"
    record(path, transfer="srgb")
    group = zarr.open_group(path)
    group.attrs["colorphase_recording"] = {**group.attrs["colorphase_recording"], key: value}
    with pytest.raises(FootageError, match=reason):
        open_footage(path)


def test_a_recording_of_a_later_version(tmp_path):
    record(tmp_path / "a.zarr")
    group = zarr.open_group(tmp_path / "a.zarr")
    group.attrs["colorphase_recording"] = {**group.attrs["colorphase_recording"], "version": "2"}
    with pytest.raises(FootageError, match="version 2, this program reads 1: update it"):
        open_footage(tmp_path / "a.zarr")


def test_the_user_knows_better(tmp_path):
    record(tmp_path / "a.zarr", BAYER8)
    assert open_footage(tmp_path / "a.zarr", bayer="bggr").format.bayer == "bggr"


LIKE = np.zeros((2, 3), np.uint8)


class Kept:
    """A writer that keeps frames by their numbers; `gate` holds it up, `broken` is a number it cannot write."""

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
    threads = WritingThreads(lambda: writer, 3, LIKE)
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
