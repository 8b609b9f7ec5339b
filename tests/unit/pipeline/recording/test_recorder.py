"""Our own recordings: nothing is lost, and nothing half-written looks whole."""

import errno
import signal
from contextlib import contextmanager
from fractions import Fraction

import av
import numpy as np
import pytest
import zarr
from support.numbered_frames import RGB8, frames_of, record, retagged, rgb

from pipeline.errors import FootageError, OutputError
from pipeline.footage.opening import open_source
from pipeline.recording.recorder import Recorder
from tikernels import ShapeError
from tikernels.raw.pixel_format import PixelFormat

RGB12, RGB16 = PixelFormat("rgb", 12), PixelFormat("rgb", 16)
BAYER8, BAYER12 = PixelFormat("bayer", bayer="gbrg"), PixelFormat("bayer", 12, bayer="grbg")
FORMATS = [RGB8, RGB12, RGB16, BAYER8, BAYER12]


@pytest.mark.parametrize("suffix", [".mkv", ".zarr"])
@pytest.mark.parametrize("format", FORMATS, ids=str)
def test_there_and_back(tmp_path, format, suffix):
    path = tmp_path / f"Aufnahme 1 ä{suffix}"
    frames = record(path, format, transfer="srgb", rate_hz=Fraction(30000, 1001))
    assert [left.name for left in tmp_path.iterdir()] == [path.name]
    source = open_source(path)
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
    (frame,) = open_source(tmp_path / "black.zarr").frames()
    np.testing.assert_array_equal(frame.planes[0], black)


@pytest.mark.parametrize("suffix", [".mkv", ".zarr"])
def test_an_error_leaves_nothing(tmp_path, suffix):
    recorder = Recorder(tmp_path / f"a{suffix}", RGB8)
    with pytest.raises(KeyboardInterrupt), recorder:
        recorder.add(frames_of(RGB8)[0])
        assert not (tmp_path / f"a{suffix}").exists()
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", [".mkv", ".zarr"])
def test_a_full_disk_is_one_clear_error(tmp_path, monkeypatch, suffix):
    recorder = Recorder(tmp_path / f"a{suffix}", RGB8)
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


@pytest.mark.parametrize("suffix", [".mkv", ".zarr"])
@pytest.mark.parametrize("n_frames", [0, 3])
def test_a_disk_that_is_full_at_once_or_at_the_end(tmp_path, suffix, n_frames):
    recorder = Recorder(tmp_path / f"a{suffix}", RGB8)
    for frame in frames_of(RGB8, n_frames):
        recorder.add(frame)
    with no_room(), pytest.raises(OutputError, match=r"cannot record to .*: File too large"):
        if not n_frames:
            recorder.add(frames_of(RGB8)[0])
        recorder.close()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", [".mkv", ".zarr"])
def test_nothing_recorded(tmp_path, suffix):
    Recorder(tmp_path / f"a{suffix}", RGB8).close()
    assert list(tmp_path.iterdir()) == []


def test_what_a_recorder_refuses(tmp_path):
    with pytest.raises(OutputError, match=r"must end in \.mkv or \.zarr"):
        Recorder(tmp_path / "a.mp4", RGB8)
    (tmp_path / "a.mkv").write_bytes(b"")
    with pytest.raises(OutputError, match="it exists"):
        Recorder(tmp_path / "a.mkv", RGB8)
    with pytest.raises(ShapeError, match="develop other frames first"):
        Recorder(tmp_path / "b.mkv", PixelFormat("yuv"))
    with pytest.raises(ShapeError, match="rate_hz is 501"):
        Recorder(tmp_path / "b.mkv", RGB8, rate_hz=501)
    with pytest.raises(ShapeError, match="transfer is 'gamma'"):
        Recorder(tmp_path / "b.mkv", RGB8, transfer="gamma")
    with pytest.raises(OutputError, match="its folder does not exist"):
        Recorder(tmp_path / "absent" / "b.mkv", RGB8).add(frames_of(RGB8)[0])
    with Recorder(tmp_path / "b.mkv", RGB8) as recorder:
        for bad in (frames_of(RGB16)[0], frames_of(BAYER8)[0], frames_of(RGB8)[0][0, 0]):
            with pytest.raises(ShapeError, match="expected"):
                recorder.add(bad)
        recorder.add(frames_of(RGB8)[0])
        with pytest.raises(ShapeError, match=r"expected \(22, 34, 3\)"):
            recorder.add(frames_of(RGB8)[0][:-1])


@pytest.mark.parametrize("suffix", [".mkv", ".zarr"])
@pytest.mark.parametrize(
    "key, value, reason",
    [
        ("rate_hz", "0", "rate_hz is 0"),
        ("rate_hz", "1/0", "rate '1/0' is no fraction"),
        ("rate_hz", "1e999999999", "is no fraction"),
        ("transfer", "gamma", "transfer is 'gamma': choose linear, srgb, bt709"),
    ],
)
def test_what_no_recorder_writes(tmp_path, suffix, key, value, reason):
    path = tmp_path / f"a{suffix}"
    record(path, transfer="srgb")
    if suffix == ".zarr":
        group = zarr.open_group(path)
        group.attrs["colorphase_recording"] = {**group.attrs["colorphase_recording"], key: value}
    else:
        path = retagged(path, tmp_path / "b.mkv", {f"COLORPHASE_{key.upper().removesuffix('_HZ')}": value})
    with pytest.raises(FootageError, match=reason):
        open_source(path)


def test_a_recording_of_a_later_version(tmp_path):
    record(tmp_path / "a.zarr")
    group = zarr.open_group(tmp_path / "a.zarr")
    group.attrs["colorphase_recording"] = {**group.attrs["colorphase_recording"], "version": "2"}
    with pytest.raises(FootageError, match="version 2, this program reads 1: update it"):
        open_source(tmp_path / "a.zarr")
    with av.open(str(tmp_path / "later.mkv"), "w") as container:
        container.metadata["COLORPHASE_RECORDING"] = "2"
        stream = container.add_stream("ffv1", rate=30)
        stream.width, stream.height, stream.pix_fmt = 32, 16, "bgr0"
        container.mux(stream.encode(av.VideoFrame(32, 16, "bgr0")))
        container.mux(stream.encode())
    with pytest.raises(FootageError, match=r"later\.mkv: it is a recording of version 2"):
        open_source(tmp_path / "later.mkv")


def test_the_user_knows_better(tmp_path):
    record(tmp_path / "a.mkv", BAYER8)
    record(tmp_path / "a.zarr", BAYER8)
    for name in ("a.mkv", "a.zarr"):
        assert open_source(tmp_path / name, bayer="bggr").format.bayer == "bggr"
