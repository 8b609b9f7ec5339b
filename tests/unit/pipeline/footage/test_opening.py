"""Any footage is opened by one function, and says when its frames were taken, or each mistake in one line."""

import json
from fractions import Fraction

import numpy as np
import pytest
from support.numbered_frames import record
from support.video_files import MJPEG, encode, moving_planes

from pipeline.errors import FootageError
from pipeline.footage.frame_times import LOG
from pipeline.footage.image_folder import ImageFolder
from pipeline.footage.opening import open_footage
from pipeline.footage.video_file import VideoFile
from pipeline.footage.zarr_recording import ZarrRecording
from pipeline.output.range_image import write_png
from pipeline.recording.video_export import export_video
from tikernels.raw.pixel_format import PixelFormat


def test_each_kind_has_its_source(tmp_path):
    record(tmp_path / "a.zarr")
    export_video(tmp_path / "a.zarr", tmp_path / "a.mkv")
    (tmp_path / "pictures").mkdir()
    write_png(tmp_path / "pictures" / "1.png", np.zeros((16, 16, 3), np.uint8))
    kinds = {"a.mkv": VideoFile, "a.zarr": ZarrRecording, "pictures": ImageFolder, "pictures/1.png": ImageFolder}
    for name, kind in kinds.items():
        source = open_footage(tmp_path / name)
        assert isinstance(source, kind) and source.name == str(tmp_path / name)
        source.close()


def test_a_recording_without_its_suffix_is_known_by_its_contents(tmp_path):
    record(tmp_path / "a.zarr")
    (tmp_path / "a.zarr").rename(tmp_path / "take 2")
    assert isinstance(open_footage(tmp_path / "take 2"), ZarrRecording)


def test_what_the_user_says_wins(tmp_path):
    record(tmp_path / "a.zarr", PixelFormat("bayer", 12, bayer="grbg"))
    source = open_footage(tmp_path / "a.zarr", bayer="rggb", bits=14)
    assert source.format == PixelFormat("bayer", 14, bayer="rggb")


def test_each_mistake_names_the_file_once(tmp_path):
    (tmp_path / "text.mp4").write_text("hello")
    (tmp_path / "folder").mkdir()
    for name, message in (
        ("none.mkv", "there is no such file"),
        ("text.mp4", "is not a video that can be read"),
        ("folder", "holds no"),
    ):
        with pytest.raises(FootageError, match=message) as raised:
            open_footage(tmp_path / name)
        assert str(raised.value).count(str(tmp_path / name)) == 1 and "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("begin", "kind"),
    [
        (b"\0\0\0\x1cftypavif\0\0\0\0", "AVIF"),
        (b"GIF89a\1\0\1\0\0\0\0", "GIF"),
    ],
)
def test_pictures_that_are_not_read_are_named(tmp_path, begin, kind):
    for name in ("a.heic", "a.png", "a"):
        (tmp_path / name).write_bytes(begin + bytes(100))
        with pytest.raises(FootageError, match=rf"{name}: it is a picture in {kind}: save it as PNG, TIFF or JPEG"):
            open_footage(tmp_path / name)


def test_raw_files_of_cameras_are_named(tmp_path):
    for name in ("a.CR2", "b.dng"):
        (tmp_path / name).write_bytes(b"II*\0" + bytes(100))
        with pytest.raises(FootageError, match=rf"{name}: it is a camera's raw file: convert it to a TIFF of 16 bits"):
            open_footage(tmp_path / name)


#: 2026-11-25 10:00:00.25 UTC.
START = 1795600800.25


def write_log(folder, times, **first):
    """Write a capture's log, with what other programs' eyes find beside the frames."""
    frames = [{"event": "frame", "frame": number, "time": time} for number, time in enumerate(times)]
    frames[0].update(first)
    events = [{"event": "start", "time": START - 1}, *frames, {"event": "end", "time": START + 9}]
    (folder / LOG).write_text("".join(json.dumps(event) + "\n" for event in events))


def recorded(path, **options):
    """Record frames, and export them if the name is that of a video."""
    record(path.with_suffix(".zarr"), **options)
    if path.suffix == ".mkv":
        export_video(path.with_suffix(".zarr"), path)


@pytest.mark.parametrize("suffix", ["mkv", "zarr"])
def test_a_recording_goes_by_its_rate(tmp_path, suffix):
    """To the last digit: Matroska's own stamps are whole ms, 0.3 ms beside them."""
    path = tmp_path / f"a.{suffix}"
    rate_hz = Fraction(60000, 1001)
    recorded(path, rate_hz=rate_hz)
    times = open_footage(path).times
    assert times.since is None
    np.testing.assert_allclose(times.seconds, np.arange(9) / float(rate_hz), rtol=1e-12)
    assert times.of(3) == pytest.approx(0.05005)


@pytest.mark.parametrize("suffix", ["mkv", "zarr"])
def test_a_captures_log_has_the_time_of_day(tmp_path, suffix):
    path = tmp_path / f"recording.{suffix}"
    recorded(path)
    n_frames = len(open_footage(path))
    exposed = START + np.arange(n_frames) * 0.02 + np.arange(n_frames) // 4 * 3  # bursts of four
    write_log(tmp_path, exposed)
    times = open_footage(path).times
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
    write_log(tmp_path, START + np.arange(len(open_footage(path))), **first)
    assert open_footage(path).times.since is None


def test_a_log_that_is_none(tmp_path):
    path = tmp_path / "recording.zarr"
    record(path)
    for content in (b"mine", b"{}\n", b"[" * 2**18, b"\xff\x00"):
        (tmp_path / LOG).write_bytes(content)
        assert open_footage(path).times.since is None


def test_a_video_goes_by_its_stamps(tmp_path):
    """One that is no recording, in whose folder a log may lie that is another's."""
    stamps = [0, 1, 2, 5, 6]
    planes = moving_planes(5, PixelFormat("yuv", subsampling=(2, 2)))
    path = encode(tmp_path / "film.mp4", planes, *MJPEG, stamps=stamps)
    write_log(tmp_path, START + np.arange(5))
    times = open_footage(path).times
    assert times.since is None
    np.testing.assert_allclose(times.seconds, np.array(stamps) / 30, atol=1e-9)


def test_pictures_have_no_times(tmp_path):
    write_png(tmp_path / "a.png", np.zeros((48, 64, 3), np.uint8))
    assert open_footage(tmp_path).times is None
