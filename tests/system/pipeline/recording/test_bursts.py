"""Recordings of bursts: each is there whole or not at all, whatever happens to the disk, the user or the program."""

import os
import random
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest
from support.numbered_frames import BURST, RGB8, add, frame_of, held

from pipeline.errors import OutputError
from pipeline.recording import recorder as recorder_module
from pipeline.recording.recorder import Recorder
from pipeline.recording.zarr_writer import finish_recording, unfinished
from tikernels.raw.pixel_format import PixelFormat

RGB12 = PixelFormat("rgb", 12)


def parts(path):
    """Return the names of all that is in a recording: what is behind its end would be one more."""
    return sorted(entry.name for entry in (path / "frames").iterdir())


@contextmanager
def file_size_limit(n_bytes):
    """Let no file grow beyond that: what a full disk does, with another number."""
    resource = pytest.importorskip("resource", reason="Windows has no such limits")
    before, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


@pytest.mark.parametrize("n_more", [0, 1, 3])
def test_an_error_keeps_what_was_committed(tmp_path, n_more):
    path = tmp_path / "a.zarr"
    with pytest.raises(KeyboardInterrupt), Recorder(path, RGB8) as recorder:
        for _ in range(2):
            add(recorder, BURST)
            recorder.commit()
            assert not path.exists()
        assert recorder.n_frames == 2 * BURST
        add(recorder, n_more)
        assert recorder.n_frames == 2 * BURST + n_more
        raise KeyboardInterrupt
    assert recorder.n_frames == 2 * BURST
    assert [left.name for left in tmp_path.iterdir()] == [path.name]
    assert held(path) == 2 * BURST
    with Recorder(tmp_path / "b.zarr", RGB8) as recorder:
        add(recorder, 2 * BURST)
    assert parts(path) == parts(tmp_path / "b.zarr")


def test_the_disk_is_full_in_mid_burst(tmp_path):
    path = tmp_path / "a.zarr"
    with pytest.raises(OutputError, match=r"to .*: files may not be as large .*; its first 5 frames are kept"):
        with Recorder(path, RGB8) as recorder:
            add(recorder, BURST)
            recorder.commit()
            with file_size_limit(frame_of(0).nbytes // 2):
                add(recorder, BURST)
                recorder.commit()
    assert [left.name for left in tmp_path.iterdir()] == [path.name]
    assert recorder.n_frames == held(path) == BURST
    with pytest.raises(OutputError, match="the recording has ended"):
        add(recorder, 1)
    with pytest.raises(OutputError, match="the recording has ended"):
        recorder.commit()
    recorder.close()


def test_a_disk_that_is_full_at_the_end(tmp_path):
    """A file system may have no room for a single byte more: what was committed needs none."""
    with file_size_limit(10), pytest.raises(OutputError, match="files may not be as large there"):
        Recorder(tmp_path / "a.zarr", RGB8).add(frame_of(0))
    assert list(tmp_path.iterdir()) == []
    recorder = Recorder(tmp_path / "a.zarr", RGB8)
    add(recorder, BURST)
    recorder.commit()
    with file_size_limit(10):
        recorder.stop()
    assert held(tmp_path / "a.zarr") == BURST


class TimeIsUp(KeyboardInterrupt):
    """What the user's Ctrl-C raises, at a moment that the test chooses."""


def test_ctrl_c_at_any_moment(tmp_path):
    if not hasattr(signal, "setitimer"):
        pytest.skip("Windows has no such timers")

    def press(signum, stack):
        if recording_now:
            raise TimeIsUp

    before = signal.signal(signal.SIGALRM, press)
    rng, kept, stopped = random.Random(3), [], 0
    committed, recording_now = 0, False
    try:
        begin = time.monotonic()
        with Recorder(tmp_path / "first.zarr", RGB8) as recorder:
            for _ in range(3):
                add(recorder, BURST)
                recorder.commit()
        takes_s = time.monotonic() - begin
        for k in range(40):
            path = tmp_path / f"{k}.zarr"
            recorder = Recorder(path, RGB8)
            committed, recording_now = 0, True
            begin = time.monotonic()
            try:
                with recorder:
                    signal.setitimer(signal.ITIMER_REAL, rng.uniform(1e-4, 1.2 * takes_s))
                    for _ in range(3):
                        add(recorder, BURST)
                        recorder.commit()
                        committed += BURST
                recording_now = False
                takes_s = time.monotonic() - begin  # the first one took longer: modules were imported
            except TimeIsUp:
                stopped += 1
            signal.setitimer(signal.ITIMER_REAL, 0)
            recorder.stop()  # between a block and the first line of __exit__ Python itself leaves a gap
            left = [name for name in os.listdir(tmp_path) if ".part" in name]
            assert left == []
            n_frames = held(path) if path.exists() else 0
            # Stopped in a commit, that one may be kept, or not.
            assert n_frames == recorder.n_frames
            assert n_frames in (committed, committed + BURST)
            kept.append(n_frames)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    assert stopped >= 10
    assert len(set(kept)) > 1


RECORD_FOR_EVER = """
import sys
sys.path[:0] = sys.argv[2:]
from support.numbered_frames import BURST, RGB8, add
from pipeline.recording.recorder import Recorder
recorder = Recorder(sys.argv[1], RGB8)
while True:
    add(recorder, BURST)
    recorder.commit()
    print(recorder.n_frames, flush=True)
"""


@pytest.mark.parametrize("seed", [1, 2])
def test_a_killed_program_leaves_what_it_had_committed(tmp_path, seed):
    """Under a temporary name; to finish it is to cut off the rest."""
    arguments = [sys.executable, "-c", RECORD_FOR_EVER, tmp_path / "a.zarr", *sys.path]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE) as process:
        process.stdout.readline()
        time.sleep(random.Random(seed).uniform(0.01, 0.2))
        process.kill()
        said = process.stdout.read().split()
    (left,) = unfinished(tmp_path)
    assert left.name == "a.part.zarr"
    path, n_frames = finish_recording(left)
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name] == ["a.zarr"]
    assert n_frames == held(path)
    assert n_frames % BURST == 0
    assert n_frames >= int(said[-1]) if said else BURST


def test_frames_may_be_used_again(tmp_path):
    """And come out in order, though several threads write them."""
    with Recorder(tmp_path / "a.zarr", RGB8) as recorder:
        buffer = np.empty_like(frame_of(0))
        for number in range(100):
            buffer[...] = frame_of(number)
            recorder.add(buffer)
    assert held(tmp_path / "a.zarr") == 100


def test_nothing_is_kept_in_memory(tmp_path):
    """However slow the disk, no more frames are in hand than there are buffers for."""
    recorder = Recorder(tmp_path / "a.zarr", RGB8)
    add(recorder, 1)
    recorder.commit()
    may_go, write = threading.Event(), recorder._threads._writer.write

    def slowly(number, frame):
        may_go.wait(20)
        return write(number, frame)

    recorder._threads._writer.write = slowly
    adding = threading.Thread(target=add, args=(recorder, 100))
    adding.start()
    time.sleep(0.3)
    assert adding.is_alive()
    assert recorder.n_frames <= 1 + recorder_module._MOST_IN_HAND
    may_go.set()
    adding.join()
    recorder.close()
    assert held(tmp_path / "a.zarr") == 101


def test_a_disk_that_never_answers(tmp_path, monkeypatch):
    """The program goes on, and what was committed can be read where it is."""
    monkeypatch.setattr(recorder_module, "_PATIENCE_S", 0.1)
    monkeypatch.setattr(recorder_module, "_END_S", 0.1)
    recorder = Recorder(tmp_path / "a.zarr", RGB8)
    add(recorder, BURST)
    recorder.commit()
    may_go = threading.Event()
    monkeypatch.setattr(recorder._threads._writer, "write", lambda number, frame: may_go.wait(20))
    with pytest.raises(OutputError, match=r"cannot finish .*a\.\w+, see .*\.part\.\w+: the disk does not answer"):
        add(recorder, 2 * recorder_module._MOST_IN_HAND)
    (left,) = unfinished(tmp_path)
    assert held(left) == BURST
    recorder.close()
    may_go.set()
    while recorder._threads._running:
        time.sleep(0.01)


def test_what_it_says_of_itself(tmp_path):
    recorder = Recorder(tmp_path / "a.zarr", RGB8)
    assert (recorder.n_frames, recorder.n_bytes) == (0, 0)
    recorder.commit()
    with recorder:
        add(recorder, 7)
    assert recorder.n_frames == 7
    path = tmp_path / "a.zarr"
    assert recorder.n_bytes == sum(part.stat().st_size for part in (path / "frames").glob("c.*"))
    recorder.close()
    recorder.stop()
    assert held(tmp_path / "a.zarr") == 7
