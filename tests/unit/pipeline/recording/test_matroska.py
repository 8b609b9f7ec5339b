"""Recordings in Matroska: every frame keeps its number, whatever is lost."""

from fractions import Fraction

import av
import numpy as np
import pytest
from support.numbered_frames import RGB8, add, frame_of, record, retagged, rgb
from support.video_files import flip, packets

from pipeline.errors import FootageError
from pipeline.footage.opening import open_source
from pipeline.footage.source import BadFrame, StoredFrame
from pipeline.recording.recorder import Recorder


@pytest.mark.parametrize("rate_hz", [1, 7, 30, 240, 500, Fraction(24000, 1001)])
def test_any_rate(tmp_path, rate_hz):
    record(tmp_path / "a.mkv", n_frames=25, rate_hz=rate_hz)
    frames = list(open_source(tmp_path / "a.mkv").frames())
    assert [frame.number for frame in frames] == list(range(25))
    assert all(isinstance(frame, StoredFrame) for frame in frames)


def test_one_wrong_bit_is_found(tmp_path):
    """FFmpeg conceals it; the checksum of each frame tells."""
    record(tmp_path / "a.mkv")
    flip(tmp_path / "a.mkv", 5)
    frames = list(open_source(tmp_path / "a.mkv").frames())
    assert [frame.number for frame in frames if isinstance(frame, BadFrame)] == [5]
    assert "checksum" in frames[5].reason


def test_a_recording_that_was_cut_off_still_knows_its_numbers(tmp_path):
    record(tmp_path / "a.mkv")
    begin, size = packets(tmp_path / "a.mkv")[6]
    (tmp_path / "a.mkv").write_bytes((tmp_path / "a.mkv").read_bytes()[: begin + size // 2])
    source = open_source(tmp_path / "a.mkv")
    frames = list(source.frames())
    assert len(source) == 9
    assert [isinstance(frame, StoredFrame) for frame in frames] == 6 * [True] + 3 * [False]
    assert [frame.number for frame in source.frames(4, 7)] == [4, 5, 6]


def test_a_recording_with_a_hole_still_knows_its_numbers(tmp_path):
    """Where the container itself is damaged its reader skips frames without a word."""
    frames = record(tmp_path / "a.mkv", n_frames=12)
    found = packets(tmp_path / "a.mkv")
    data = bytearray((tmp_path / "a.mkv").read_bytes())
    data[found[4][0] - 8 : found[6][0] + 20] = bytes(found[6][0] + 20 - found[4][0] + 8)
    (tmp_path / "a.mkv").write_bytes(data)
    got = list(open_source(tmp_path / "a.mkv").frames())
    assert [frame.number for frame in got] == list(range(12))
    good = [frame for frame in got if isinstance(frame, StoredFrame)]
    assert len(good) < 12
    for frame in good:
        np.testing.assert_array_equal(rgb(frame.planes, frame.format), frames[frame.number])


def test_a_length_that_cannot_be(tmp_path):
    """How many frames there are is told by the length: of a wrong one no list is made."""
    record(tmp_path / "a.mkv")
    with pytest.raises(FootageError, match=r"says that it holds \d+ frames"):
        open_source(retagged(tmp_path / "a.mkv", tmp_path / "b.mkv", {}, last_ms=10**12))


def test_other_programs_read_it(tmp_path):
    """By FFmpeg, which finds the length, the list of frames and each frame's time."""
    with Recorder(tmp_path / "a.mkv", RGB8, rate_hz=200, transfer="srgb") as recorder:
        add(recorder, 50)
    with av.open(str(tmp_path / "a.mkv")) as container:
        (stream,) = container.streams
        assert container.duration == 250_000
        assert stream.average_rate == 200
        assert stream.codec_context.name == "ffv1"
        assert container.metadata["COLORPHASE_TRANSFER"] == "srgb"
        container.seek(145, stream=stream)
        assert [entry.timestamp for entry in stream.index_entries] == list(range(0, 250, 5))
        frame = next(container.decode(stream))
        assert frame.pts == 145
        np.testing.assert_array_equal(frame.to_ndarray(format="rgb24"), frame_of(29))
