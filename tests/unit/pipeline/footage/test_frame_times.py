"""When frames were taken: by a capture's log, a recording's rate, or a video's time stamps; never by a guess."""

import json
from fractions import Fraction

import numpy as np
import pytest
from support.numbered_frames import record
from support.video_files import MJPEG, encode, moving_planes

from pipeline.acquisition import capture_folder
from pipeline.footage.frame_times import LOG, frame_times
from pipeline.footage.opening import open_source
from pipeline.output.range_image import write_png
from tikernels.raw.pixel_format import PixelFormat

#: 2026-11-25 10:00:00.25 UTC.
START = 1795600800.25


def write_log(folder, times, **first):
    """Write a capture's log, with what other programs' eyes find beside the frames."""
    frames = [{"event": "frame", "frame": number, "time": time} for number, time in enumerate(times)]
    frames[0].update(first)
    events = [{"event": "start", "time": START - 1}, *frames, {"event": "end", "time": START + 9}]
    (folder / LOG).write_text("".join(json.dumps(event) + "\n" for event in events))


@pytest.mark.parametrize("suffix", ["mkv", "zarr"])
def test_a_recording_goes_by_its_rate(tmp_path, suffix):
    """To the last digit: Matroska's own stamps are whole ms, 0.3 ms beside them."""
    path = tmp_path / f"a.{suffix}"
    rate_hz = Fraction(60000, 1001)
    record(path, rate_hz=rate_hz)
    times = frame_times(open_source(path))
    assert times.since is None
    np.testing.assert_allclose(times.seconds, np.arange(9) / float(rate_hz), rtol=1e-12)
    assert times.of(3) == pytest.approx(0.05005)


@pytest.mark.parametrize("suffix", ["mkv", "zarr"])
def test_a_captures_log_has_the_time_of_day(tmp_path, suffix):
    path = tmp_path / f"recording.{suffix}"
    record(path)
    n_frames = len(open_source(path))
    exposed = START + np.arange(n_frames) * 0.02 + np.arange(n_frames) // 4 * 3  # bursts of four
    write_log(tmp_path, exposed)
    times = frame_times(open_source(path))
    assert times.since == "2026-11-25T10:00:00Z"
    np.testing.assert_allclose(times.seconds, exposed - 1795600800, rtol=0, atol=1e-6)
    assert times.of(1) == pytest.approx(START + 0.02, abs=1e-6)


@pytest.mark.parametrize(
    "first",
    [
        {"time": "noon"},
        {"time": None},
        {"time": float("nan")},
        {"time": -5.0},
        {"time": START + 1e6},
        {"frame": 10**6},
        {"frame": "0"},
        {"event": "burst"},
    ],
)
def test_a_log_that_does_not_tell_every_frames_time_is_left_alone(tmp_path, first):
    path = tmp_path / "recording.zarr"
    record(path)
    write_log(tmp_path, START + np.arange(len(open_source(path))), **first)
    assert frame_times(open_source(path)).since is None


def test_a_log_that_is_none(tmp_path):
    path = tmp_path / "recording.zarr"
    record(path)
    for content in (b"mine", b"{}\n", b"[" * 2**18, b"\xff\x00"):
        (tmp_path / LOG).write_bytes(content)
        assert frame_times(open_source(path)).since is None


def test_a_video_goes_by_its_stamps(tmp_path):
    """One that is no recording, in whose folder a log may lie that is another's."""
    stamps = [0, 1, 2, 5, 6]
    planes = moving_planes(5, PixelFormat("yuv", subsampling=(2, 2)))
    path = encode(tmp_path / "film.mp4", planes, *MJPEG, stamps=stamps)
    write_log(tmp_path, START + np.arange(5))
    times = frame_times(open_source(path))
    assert times.since is None
    np.testing.assert_allclose(times.seconds, np.array(stamps) / 30, atol=1e-9)


def test_pictures_have_no_times(tmp_path):
    write_png(tmp_path / "a.png", np.zeros((48, 64, 3), np.uint8))
    assert frame_times(open_source(tmp_path)) is None


def test_the_log_is_a_captures():
    assert LOG == capture_folder.LOG
