"""A recording as a video: the same values, mosaic and times come back, and other programs read it."""

from fractions import Fraction

import av
import numpy as np
import pytest
from support.numbered_frames import RGB8, frame_of, record, rgb
from support.video_files import flip, packets

from pipeline.errors import FootageError, OutputError
from pipeline.footage.footage import BadFrame, StoredFrame
from pipeline.footage.opening import open_footage
from pipeline.models import SensorPart
from pipeline.recording.recorder import Recorder
from pipeline.recording.video_export import export_video
from tikernels.raw.pixel_format import FLOAT_BITS, PixelFormat

FORMATS = [PixelFormat("rgb", bits) for bits in range(8, 17)]
FORMATS += [PixelFormat("bayer", bits, bayer="grbg") for bits in range(8, 17)]


def exported(tmp_path, format=RGB8, **options):
    """Record frames, and return the recording and its video."""
    record(tmp_path / "a.zarr", format, **options)
    assert export_video(tmp_path / "a.zarr", tmp_path / "a.mkv") == len(open_footage(tmp_path / "a.zarr"))
    return open_footage(tmp_path / "a.zarr"), open_footage(tmp_path / "a.mkv")


@pytest.mark.parametrize("format", FORMATS, ids=lambda format: f"{format.layout}{format.bits}")
def test_there_and_back(tmp_path, format):
    recording, video = exported(tmp_path, format)
    assert (video.size_px, video.notes, len(video)) == (recording.size_px, (), len(recording))
    assert (video.format.layout, video.format.bits) == (format.layout, format.bits)
    if format.layout == "bayer":
        assert video.format == recording.format
    for kept, frame in zip(recording.frames(), video.frames(), strict=True):
        assert isinstance(frame, StoredFrame) and frame.number == kept.number
        np.testing.assert_array_equal(rgb(frame.planes, frame.format), kept.planes[0])
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["a.mkv", "a.zarr"]


@pytest.mark.parametrize("rate_hz", [1, 7, 240, 500, Fraction(60000, 1001), Fraction(24000, 1001)])
def test_times_are_the_recordings(tmp_path, rate_hz):
    recording, video = exported(tmp_path, n_frames=25, rate_hz=rate_hz)
    np.testing.assert_array_equal(video.times.seconds, recording.times.seconds)
    assert [frame.number for frame in video.frames(3, None, 5)] == [3, 8, 13, 18, 23]


@pytest.mark.parametrize("transfer", [None, "linear", "srgb", "bt709"])
def test_transfer(tmp_path, transfer):
    recording, video = exported(tmp_path, transfer=transfer)
    assert recording.transfer == video.transfer == transfer


@pytest.mark.parametrize("sensor", [None, SensorPart(sensor_px=(99, 80), offset_px=(4, 7), binning=(2, 1))])
def test_the_part_of_the_sensor(tmp_path, sensor):
    recording, video = exported(tmp_path, sensor=sensor)
    assert recording.sensor == video.sensor == sensor


def test_the_user_knows_better(tmp_path):
    exported(tmp_path, PixelFormat("bayer", 12, bayer="grbg"))
    assert open_footage(tmp_path / "a.mkv", bayer="rggb", bits=14).format == PixelFormat("bayer", 14, bayer="rggb")


def test_other_programs_read_it(tmp_path):
    """By FFmpeg, which finds the length, the list of frames, each frame's time, and the depth."""
    exported(tmp_path, n_frames=50, rate_hz=200, transfer="srgb")
    with av.open(str(tmp_path / "a.mkv")) as container:
        (stream,) = container.streams
        assert (container.duration, stream.average_rate, stream.codec_context.name) == (250_000, 200, "ffv1")
        container.seek(145, stream=stream)
        frame = next(container.decode(stream))
        assert frame.pts == 145
        np.testing.assert_array_equal(frame.to_ndarray(format="rgb24"), frame_of(29))
        assert stream.codec_context.pix_fmt == "bgr0"


def test_one_wrong_bit_is_found(tmp_path):
    """FFmpeg conceals it; the checksum of each slice says so."""
    exported(tmp_path)
    flip(tmp_path / "a.mkv", 5)
    frames = open_footage(tmp_path / "a.mkv").frames()
    bad = {frame.number: frame.reason for frame in frames if isinstance(frame, BadFrame)}
    assert bad.keys() == {5} and "damaged" in bad[5]


def test_a_video_that_was_cut_off_holds_its_first_frames(tmp_path):
    exported(tmp_path)
    begin, size = packets(tmp_path / "a.mkv")[6]
    (tmp_path / "a.mkv").write_bytes((tmp_path / "a.mkv").read_bytes()[: begin + size // 2])
    source = open_footage(tmp_path / "a.mkv")
    assert [frame.number for frame in source.frames() if isinstance(frame, StoredFrame)] == list(range(6))
    assert any("cut off" in note for note in source.notes)


def test_what_cannot_be_exported_leaves_nothing(tmp_path):
    record(tmp_path / "a.zarr")
    (tmp_path / "a.zarr" / "frames" / "c.4.0.0.0").unlink()
    with pytest.raises(FootageError, match=r"frame 4 of .*a\.zarr: it is missing"):
        export_video(tmp_path / "a.zarr", tmp_path / "a.mkv")
    with Recorder(tmp_path / "float.zarr", PixelFormat("rgb", FLOAT_BITS)) as recorder:
        recorder.add(np.zeros((22, 34, 3), np.float32))
    with pytest.raises(OutputError, match="holds floats, and FFV1 8 to 16 bits: keep it in Zarr"):
        export_video(tmp_path / "float.zarr", tmp_path / "a.mkv")
    with pytest.raises(FootageError, match="is not a recording of frames"):
        export_video(tmp_path / "none.zarr", tmp_path / "a.mkv")
    record(tmp_path / "b.zarr")
    with pytest.raises(OutputError, match="its folder is a file"):
        export_video(tmp_path / "b.zarr", tmp_path / "b.zarr" / "zarr.json" / "a.mkv")
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["a.zarr", "b.zarr", "float.zarr"]


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"COLORPHASE_RATE": "fast"}, "rate 'fast' is no fraction"),
        ({"COLORPHASE_RATE": "501"}, "rate_hz is 501"),
        ({"COLORPHASE_BITS": "many"}, "export it again"),
        ({"COLORPHASE_BITS": "9" * 5000}, "bits '9{40}' is no number of bits"),
        ({"COLORPHASE_BITS": None}, "export it again"),
        ({"COLORPHASE_BAYER": "rgbg"}, "bayer is 'rgbg': choose"),
    ],
)
def test_tags_that_are_wrong(tmp_path, changed, message):
    exported(tmp_path, PixelFormat("bayer", 12, bayer="grbg"))
    with av.open(str(tmp_path / "a.mkv")) as source, av.open(str(tmp_path / "b.mkv"), "w") as copy:
        tags = {**source.metadata, **changed}
        copy.metadata.update({name: value for name, value in tags.items() if value is not None})
        stream = copy.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.size:
                packet.stream = stream
                copy.mux(packet)
    with pytest.raises(FootageError, match=message):
        open_footage(tmp_path / "b.mkv")
