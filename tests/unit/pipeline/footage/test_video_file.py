"""Frames from video files: exact planes, exact numbers, and damage told by number."""

import shutil
from fractions import Fraction

import av
import numpy as np
import pytest
from support.video_files import H264, MJPEG, encode, erase, moving_planes, packets

from pipeline.errors import FootageError
from pipeline.footage import video_file
from pipeline.footage.ffmpeg_frames import stored_planes
from pipeline.footage.footage import BadFrame, StoredAs, StoredFrame
from pipeline.footage.opening import open_footage
from pipeline.footage.picture_tags import upright
from pipeline.footage.video_file import VideoIndex
from pipeline.limits import MAX_PIXELS
from tikernels.raw.pixel_format import PixelFormat

YUV420 = PixelFormat("yuv", subsampling=(2, 2))
N_FRAMES = 40
# Containers and codecs that number their frames in different ways.
FILES = {
    "intra.avi": MJPEG,
    "intra.mov": MJPEG,
    "intra.mkv": MJPEG,
    "b-frames.mp4": ("libx264", "yuv420p", {"g": "12", "bf": "3"}),
    "b-frames.mkv": ("libx264", "yuv420p", {"g": "12", "bf": "3"}),
    "open-gop.mp4": ("libx264", "yuv420p", {"x264-params": "open-gop=1:keyint=12:min-keyint=12:scenecut=0:b-adapt=0"}),
    "raw.264": ("libx264", "yuv420p", {"g": "12", "bf": "3"}),
    "intra.264": ("libx264", "yuv420p", {"g": "1"}),
    "stream.ts": ("libx264", "yuv420p", {"g": "12", "bf": "3"}),
    "mpeg4.avi": ("mpeg4", "yuv420p", {"g": "12", "bf": "2", "qmin": "2", "qmax": "2"}),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Write every file once."""
    folder = tmp_path_factory.mktemp("videos")
    for name, (codec, pixels, options) in FILES.items():
        encode(folder / name, moving_planes(N_FRAMES, YUV420), codec, pixels, options)
    return folder


def decoded(path):
    """Return all frames' luma, by PyAV alone."""
    with av.open(str(path)) as container:
        return [frame.to_ndarray()[: frame.height].copy() for frame in container.decode(video=0)]


def numbers(frames):
    return [frame.number for frame in frames]


def bad(frames):
    return {frame.number: frame.reason for frame in frames if isinstance(frame, BadFrame)}


@pytest.mark.parametrize("name", FILES)
def test_frames_are_those_of_the_file(folder, name):
    source = open_footage(folder / name)
    expected = decoded(folder / name)
    frames = list(source.frames())
    assert len(source) == len(expected) == N_FRAMES
    assert numbers(frames) == list(range(N_FRAMES))
    assert not bad(frames)
    for frame, luma in zip(frames, expected, strict=True):
        np.testing.assert_array_equal(frame.planes[0], luma)
    assert source.size_px == (64, 48)
    assert source.format.layout == "yuv"
    source.close()


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("start, stop, step", [(7, None, 1), (12, 13, 1), (13, 20, 2), (0, None, 7), (39, None, 1)])
def test_any_frame_can_be_entered_at(folder, name, start, stop, step):
    source = open_footage(folder / name)
    expected = decoded(folder / name)
    frames = list(source.frames(start, stop, step))
    assert numbers(frames) == list(range(N_FRAMES))[start:stop:step]
    for frame in frames:
        np.testing.assert_array_equal(frame.planes[0], expected[frame.number])


def test_nothing_is_wanted(folder):
    assert list(open_footage(folder / "intra.avi").frames(5, 5)) == []


def test_two_readers_do_not_disturb_each_other(folder):
    source = open_footage(folder / "b-frames.mp4")
    for first, second in zip(source.frames(), source.frames(3), strict=False):
        assert second.number == first.number + 3


@pytest.mark.parametrize("name", ["late.mkv", "late.mp4"])
def test_a_variable_rate_does_not_change_the_numbers(tmp_path, name):
    stamps = np.cumsum(1 + np.arange(N_FRAMES) % 7).tolist()
    path = encode(tmp_path / name, moving_planes(N_FRAMES, YUV420), *H264, stamps=stamps)
    source = open_footage(path)
    expected = decoded(path)
    assert len(source) == N_FRAMES
    (frame,) = source.frames(23, 24)
    assert frame.number == 23
    np.testing.assert_array_equal(frame.planes[0], expected[23])


def test_a_trimmed_file_shows_only_its_part(tmp_path, folder):
    """What an edit list hides is decoded, because others need it, but has no number."""
    with av.open(str(folder / "b-frames.mp4")) as source, av.open(str(tmp_path / "cut.mp4"), "w") as target:
        stream = target.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.dts is not None:
                packet.pts -= 5 * 512  # five frames before zero: Matroska's and MP4's players skip them
                packet.dts -= 5 * 512
                packet.stream = stream
                target.mux(packet)
    expected = decoded(tmp_path / "cut.mp4")
    source = open_footage(tmp_path / "cut.mp4")
    frames = list(source.frames())
    assert len(expected) == len(source)
    assert "hides 5 of its frames from players" in source.notes[0]
    assert not bad(frames)
    for frame, luma in zip(frames, expected, strict=True):
        np.testing.assert_array_equal(frame.planes[0], luma)


@pytest.mark.parametrize("name", ["intra.avi", "intra.mkv"])
def test_one_damaged_frame_of_many(tmp_path, folder, name):
    path = shutil.copy(folder / name, tmp_path / name)
    erase(path, 17)
    frames = list(open_footage(path).frames())
    assert numbers(frames) == list(range(N_FRAMES))
    assert list(bad(frames)) == [17]
    assert "damaged" in bad(frames)[17]
    assert list(bad(list(open_footage(path).frames(10, 20, 7)))) == [17]


@pytest.mark.parametrize("name", ["intra.avi", "intra.mov", "intra.mkv"])
def test_a_frame_that_is_lost_moves_no_other(tmp_path, folder, name):
    """AVI has no time stamps: its reader numbers what it finds."""
    path = shutil.copy(folder / name, tmp_path / name)
    expected = decoded(path)
    begin, size = packets(path)[17]
    data = bytearray(path.read_bytes())
    head = 0 if name == "intra.mov" else 8  # bytes that say what comes and how long it is
    data[begin - head : begin + size] = bytes(size + head)
    path.write_bytes(data)
    frames = list(open_footage(path).frames())
    if name != "intra.mkv":  # it knows of its frames only what it can read
        assert numbers(frames) == list(range(N_FRAMES))
        assert list(bad(frames)) == [17]
    lost = N_FRAMES - len(frames)
    assert lost <= 1
    for frame in frames:
        if isinstance(frame, StoredFrame):
            behind = lost if frame.number >= 17 else 0
            np.testing.assert_array_equal(frame.planes[0], expected[frame.number + behind])


@pytest.mark.parametrize("name", ["b-frames.mp4", "b-frames.mkv"])
def test_what_is_predicted_from_a_damaged_frame_is_not_trusted(tmp_path, folder, name):
    """FFmpeg conceals damage, and what it makes up spreads until the next key frame."""
    codec, pixels, options = FILES[name]
    path = encode(tmp_path / name, moving_planes(N_FRAMES, YUV420, (320, 240)), codec, pixels, options)
    expected = decoded(path)
    erase(path, 17)
    frames = list(open_footage(path).frames())
    assert numbers(frames) == list(range(N_FRAMES))
    assert 2 <= len(bad(frames)) <= 12
    assert any("predicted from frame" in reason for reason in bad(frames).values())
    for frame in frames:
        if isinstance(frame, StoredFrame):
            np.testing.assert_array_equal(frame.planes[0], expected[frame.number])


@pytest.mark.parametrize("name", ["intra.avi", "intra.mkv", "b-frames.mkv", "stream.ts"])
def test_a_file_that_was_cut_off(tmp_path, folder, name):
    path = shutil.copy(folder / name, tmp_path / name)
    begin, size = packets(path)[30]
    path.write_bytes(path.read_bytes()[: begin + size // 2])
    source = open_footage(path)
    frames = list(source.frames())
    good = [frame.number for frame in frames if isinstance(frame, StoredFrame)]
    assert 20 <= len(good) <= 31
    assert good == list(range(len(good)))
    assert numbers(frames) == list(range(len(source)))
    if name != "stream.ts":  # which does not say how long it should be
        assert any("cut off" in note for note in source.notes)


def test_a_frame_of_another_size(tmp_path):
    """JPEGs of a stream may change their size from one to the next."""
    small, large = (moving_planes(3, YUV420, size_px) for size_px in ((64, 48), (96, 80)))
    parts = []
    for i, planes in enumerate((small, large)):
        path = encode(tmp_path / f"{i}.mjpeg", planes, *MJPEG)
        parts.append(path.read_bytes())
    (tmp_path / "both.mjpeg").write_bytes(parts[0] + parts[1] + parts[0])
    frames = list(open_footage(tmp_path / "both.mjpeg").frames())
    assert numbers(frames) == list(range(9))
    assert bad(frames) == dict.fromkeys((3, 4, 5), "it is 96x80 yuv, the first is 64x48 yuv")


@pytest.mark.parametrize(
    "pixels, codec, format",
    [
        ("yuv420p", "ffv1", PixelFormat("yuv", subsampling=(2, 2), matrix="bt601")),
        ("yuv422p", "ffv1", PixelFormat("yuv", subsampling=(2, 1), matrix="bt601")),
        ("yuv444p", "ffv1", PixelFormat("yuv", matrix="bt601")),
        ("yuv440p", "ffv1", PixelFormat("yuv", subsampling=(1, 2), matrix="bt601")),
        ("yuv420p10le", "ffv1", PixelFormat("yuv", 10, subsampling=(2, 2), matrix="bt601")),
        ("yuv422p16le", "ffv1", PixelFormat("yuv", 16, subsampling=(2, 1), matrix="bt601")),
        ("bgr0", "ffv1", PixelFormat("rgb", channels="bgr0")),
        ("gbrp16le", "ffv1", PixelFormat("rgb", 16, channels="gbr")),
        ("gbrp10le", "ffv1", PixelFormat("rgb", 10, channels="gbr")),
        ("rgb24", "png", PixelFormat("rgb")),
    ],
)
def test_lossless_planes_come_back_as_they_went_in(tmp_path, pixels, codec, format):
    """An odd width pads rows and rounds chroma up."""
    rng = np.random.default_rng(1)
    shapes = format.plane_shapes(21, 31)
    if format.channels == "gbr":
        shapes = ((21, 31),) * 3
    planes = [rng.integers(0, 2**format.bits, shape).astype(format.dtype) for shape in shapes]
    if format.channels == "bgr0":
        planes[0][..., 3] = 0
    path = encode(tmp_path / ("video.mov" if codec == "png" else "video.mkv"), [planes], codec, pixels)
    source = open_footage(path)
    (frame,) = source.frames()
    assert frame.format == source.format == format
    assert frame.number == 0
    for got, put in zip(frame.planes, planes, strict=True):
        np.testing.assert_array_equal(got[..., :3] if got.ndim == 3 else got, put[..., :3] if put.ndim == 3 else put)


def test_packed_chroma_is_taken_apart(tmp_path):
    packed = np.random.default_rng(2).integers(0, 256, (16, 64)).astype(np.uint8)
    with av.open(str(tmp_path / "camera.avi"), "w") as container:
        stream = container.add_stream("rawvideo", rate=30)
        stream.width, stream.height, stream.pix_fmt = 32, 16, "yuyv422"
        frame = av.VideoFrame(32, 16, "yuyv422")
        frame.planes[0].update(packed.tobytes())
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    (frame,) = open_footage(tmp_path / "camera.avi").frames()
    assert frame.format.subsampling == (2, 1)
    for plane, first, step in zip(frame.planes, (0, 1, 3), (2, 4, 4), strict=True):
        np.testing.assert_array_equal(plane, packed[:, first::step])


@pytest.mark.parametrize(
    "properties, rows, expected, assumed",
    [
        ({"colorspace": 1, "color_range": 1}, 48, ("bt709", False), None),
        ({"colorspace": 5, "color_range": 1}, 48, ("bt601", False), None),
        ({"colorspace": 6, "color_range": 2}, 48, ("bt601", True), None),
        ({"colorspace": 9, "color_range": 1}, 48, ("bt2020", False), None),
        ({}, 48, ("bt601", False), "matrix bt601, limited range"),
        ({}, 720, ("bt709", False), "matrix bt709, limited range"),
    ],
)
def test_matrix_and_range(tmp_path, properties, rows, expected, assumed):
    planes = moving_planes(1, YUV420, (64, rows))
    path = encode(tmp_path / "video.mp4", planes, *H264, **properties)
    source = open_footage(path)
    assert (source.format.matrix, source.format.full_range) == expected
    if assumed is None:
        assert source.notes == ()
    else:
        (note,) = source.notes
        assert assumed in note
    said = open_footage(path, matrix="bt2020", full_range=True)
    assert (said.format.matrix, said.format.full_range) == ("bt2020", True)
    assert bool(said.notes) == (bool(properties) and expected != ("bt2020", True))


def test_motion_jpeg_has_full_range_and_centred_chroma(folder):
    source = open_footage(folder / "intra.avi")
    assert (source.format.full_range, source.format.siting, source.format.matrix) == (True, "centre", "bt601")
    assert source.notes == ()
    assert open_footage(folder / "intra.avi", siting="left").format.siting == "left"
    assert open_footage(folder / "b-frames.mp4").format.siting == "left"


@pytest.mark.parametrize(
    "number, transfer, note", [(1, "bt709", None), (13, "srgb", None), (8, "linear", None), (16, None, "PQ")]
)
def test_transfer(tmp_path, number, transfer, note):
    properties = {"color_trc": number, "colorspace": 1, "color_range": 1}
    source = open_footage(encode(tmp_path / "video.mp4", moving_planes(1, YUV420), *H264, **properties))
    assert source.transfer == transfer
    assert source.notes == () if note is None else note in source.notes[0]


def test_grey_video_is_a_mosaic_only_if_somebody_says_so(tmp_path):
    planes = moving_planes(2, PixelFormat("bayer"))
    path = encode(tmp_path / "grey.mkv", planes, "ffv1", "gray")
    with pytest.raises(FootageError, match=r"grey\.mkv: it is grey, .*: if it is a Bayer mosaic, say which"):
        open_footage(path)
    source = open_footage(path, bayer="gbrg")
    assert source.format == PixelFormat("bayer", bayer="gbrg")
    with pytest.raises(FootageError, match="bits is 12, but its values have 8"):
        open_footage(path, bayer="gbrg", bits=12)
    with pytest.raises(FootageError, match="bayer is 'rgbg': choose"):
        open_footage(path, bayer="rgbg")


def test_bits_that_are_shifted_up_are_known():
    shifted = PixelFormat("yuv", 10, 6, subsampling=(2, 2))
    assert StoredAs(bits=10).applied_to(shifted) == shifted
    for bits in (8, 12):
        with pytest.raises(FootageError, match=f"bits is {bits}, but its values have 10"):
            StoredAs(bits=bits).applied_to(shifted)


def test_unsupported_pixels(tmp_path):
    path = encode(tmp_path / "few.nut", [[np.zeros((16, 32), np.uint16)]], "rawvideo", "rgb565le")
    with pytest.raises(FootageError, match=r"few\.nut: its pixel format rgb565le is not supported: convert it .*bgr0"):
        open_footage(path)


def test_alpha_is_left_out(tmp_path):
    (planes,) = moving_planes(1, YUV420)
    path = encode(tmp_path / "alpha.mkv", [[*planes, planes[0]]], "ffv1", "yuva420p")
    source = open_footage(path)
    (frame,) = source.frames()
    assert "its transparency is left out" in source.notes
    assert (frame.format.subsampling, len(frame.planes)) == ((2, 2), 3)
    for got, put in zip(frame.planes, planes, strict=True):
        np.testing.assert_array_equal(got, put)


@pytest.mark.parametrize("width", [32, 31])
def test_rows_stored_from_the_bottom_up(tmp_path, width):
    """As MATLAB's uncompressed AVIs are; a row takes a multiple of four bytes."""
    picture = np.random.default_rng(3).integers(0, 256, (16, width, 3)).astype(np.uint8)
    path = encode(tmp_path / "film.avi", [[picture]], "rawvideo", "bgr24")
    data = bytearray(path.read_bytes())
    height = data.index(b"strf") + 16  # negative in the head: from the top down
    assert int.from_bytes(data[height : height + 4], "little", signed=True) == -16
    data[height : height + 4] = (16).to_bytes(4, "little")
    path.write_bytes(data)
    (frame,) = open_footage(path).frames()
    np.testing.assert_array_equal(frame.planes[0], picture[::-1])


# By Exif's numbers of them: what a display matrix (ISO/IEC 14496-12, 6.2.2) makes of x and y.
MATRICES = {
    1: (1, 0, 0, 1),
    2: (-1, 0, 0, 1),
    3: (-1, 0, 0, -1),
    4: (1, 0, 0, -1),
    5: (0, 1, 1, 0),
    6: (0, 1, -1, 0),
    7: (0, -1, -1, 0),
    8: (0, -1, 1, 0),
}


@pytest.fixture(scope="module")
def held(tmp_path_factory):
    return encode(tmp_path_factory.mktemp("held") / "held.mov", moving_planes(2, YUV420), *H264)


def with_matrix(path, target, matrix):
    """Write a MOV again whose head turns its frames otherwise."""
    data = bytearray(path.read_bytes())
    begin = data.index(b"tkhd") + 44
    a, b, c, d = (round(65536 * value) for value in matrix)
    data[begin : begin + 36] = np.array([a, b, 0, c, d, 0, 0, 0, 1 << 30], ">i4").tobytes()
    target.write_bytes(data)
    return target


@pytest.mark.parametrize("orientation", MATRICES)
def test_frames_are_turned_as_the_camera_was_held(tmp_path, held, orientation):
    source = open_footage(with_matrix(held, tmp_path / "turned.mov", MATRICES[orientation]))
    assert source.size_px == ((64, 48) if orientation < 5 else (48, 64))
    for frame, luma in zip(source.frames(), decoded(held), strict=True):
        np.testing.assert_array_equal(frame.planes[0], upright(luma, orientation))
        assert frame.format == source.format
    assert orientation == 1 or "as its head says and as players show it" in source.notes[-1]


def test_an_odd_angle_is_not_followed_and_said(tmp_path, held):
    source = open_footage(with_matrix(held, tmp_path / "turned.mov", (0.9, 0.3, -0.3, 0.9)))
    assert source.size_px == (64, 48)
    assert "by an odd angle; here it stays as the camera stored it" in source.notes[-1]


def test_what_goes_wrong_with_a_frame_is_a_bad_frame(monkeypatch, folder):
    def fails(frame, *others):
        if frame.pts == 3:
            raise ValueError("strides is incompatible with shape")
        return stored_planes(frame, *others)

    source = open_footage(folder / "intra.mkv")
    monkeypatch.setattr(video_file, "stored_planes", fails)
    assert bad(source.frames()) == {3: "it cannot be read (ValueError: strides is incompatible with shape)"}


def test_a_crop_is_followed_to_the_pixel(tmp_path):
    """H.264 says how much of its blocks is not to be shown; FFmpeg rounds what is cut off on the left."""
    path = encode(tmp_path / "whole.264", moving_planes(2, YUV420), *H264)
    with av.open(str(path)) as source:
        cut = av.BitStreamFilterContext("h264_metadata=crop_left=6:crop_right=4:crop_top=2", source.streams.video[0])
        parts = [packet for whole in [*source.demux(video=0), None] for packet in cut.filter(whole)]
    (tmp_path / "part.264").write_bytes(b"".join(bytes(packet) for packet in parts))
    source = open_footage(tmp_path / "part.264")
    assert source.size_px == (54, 46)
    for frame, luma in zip(source.frames(), decoded(path), strict=True):
        np.testing.assert_array_equal(frame.planes[0], luma[2:, 6:-4])
        assert frame.planes[1].shape == (23, 27)


def test_other_videos_of_a_file_are_named(tmp_path):
    with av.open(str(tmp_path / "two.mkv"), "w") as target:
        streams = [target.add_stream("ffv1", rate=30) for _ in range(2)]
        for stream, width in zip(streams, (32, 48), strict=True):
            stream.width, stream.height, stream.pix_fmt = width, 16, "yuv420p"
        for stream in streams:
            target.mux([*stream.encode(av.VideoFrame(stream.width, 16, "yuv420p")), *stream.encode()])
    source = open_footage(tmp_path / "two.mkv")
    assert source.size_px == (32, 16)
    assert "it holds 2 videos, of which the first is read: the others are left out" in source.notes


@pytest.mark.parametrize(
    ("says", "note"),
    [
        (lambda stream: stream.metadata.update(stereo_mode="left_right"), "it is stereoscopic, with two views"),
        (
            lambda stream: setattr(stream.codec_context, "sample_aspect_ratio", Fraction(8, 9)),
            "for its pixels are not square",
        ),
    ],
)
def test_what_a_frame_shows_that_is_no_flat_picture_is_noted(tmp_path, says, note):
    with av.open(str(tmp_path / "film.mkv"), "w") as target:
        stream = target.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 32, 16, "yuv420p"
        says(stream)
        target.mux([*stream.encode(av.VideoFrame(32, 16, "yuv420p")), *stream.encode()])
    assert [said for said in open_footage(tmp_path / "film.mkv").notes if note in said]


def test_sound_alone(tmp_path):
    with av.open(str(tmp_path / "sound.mkv"), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), layout="mono")
        frame.sample_rate = 8000
        container.mux(stream.encode(frame))
    with pytest.raises(FootageError, match="holds no video"):
        open_footage(tmp_path / "sound.mkv")


@pytest.mark.parametrize(
    "content, message", [(b"", "is empty: copy it again"), (bytes(1000), "is not a video that can be read")]
)
def test_no_video_at_all(tmp_path, content, message):
    path = tmp_path / "nothing.mp4"
    path.write_bytes(content)
    with pytest.raises(FootageError, match=message) as caught:
        open_footage(path)
    assert "\n" not in str(caught.value)


def test_a_film_without_its_index(tmp_path, folder):
    """MP4 keeps it at the end: nothing can be found without it."""
    path = tmp_path / "cut.mp4"
    path.write_bytes((folder / "b-frames.mp4").read_bytes()[:-3000])
    with pytest.raises(FootageError, match="it may be cut off or damaged"):
        open_footage(path)


@pytest.mark.parametrize("name", ["two words.avi", "プロジェクタ.avi", "ä%03d.avi", "colon:name.avi"])
def test_any_name(tmp_path, folder, name):
    path = shutil.copy(folder / "intra.avi", tmp_path / name)
    source = open_footage(path)
    assert len(list(source.frames(0, 3))) == 3
    assert source.name == str(path)


def test_no_such_file(tmp_path):
    with pytest.raises(FootageError, match="there is no such file"):
        open_footage(tmp_path / "absent.mp4")


@pytest.mark.parametrize("codec", [MJPEG, H264])
def test_frames_larger_than_any_cameras_are_refused_before_one_is_decoded(tmp_path, monkeypatch, codec):
    path = encode(tmp_path / "film.mkv", moving_planes(3, YUV420), *codec)
    monkeypatch.setenv(MAX_PIXELS, "3071")
    with pytest.raises(FootageError, match=r"film\.mkv"):
        open_footage(path)
    monkeypatch.setenv(MAX_PIXELS, "3072")
    assert len(open_footage(path)) == 3


# As in the file: a key frame, a frame predicted from it, one between both in time; and the same again, in an open
# group, whose last frame lies before its key frame in time and is predicted from both sides of it.
NUMBERS = (0, 2, 1, 4, 6, 3, 5)
KEYS = (0, 3)


def index(numbers=NUMBERS, keys=KEYS, stamps=NUMBERS):
    return VideoIndex(stamps, stamps, "pts", numbers, keys)


@pytest.mark.parametrize(("number", "position"), [(0, 0), (1, 0), (2, 0), (3, 0), (4, 3), (5, 3), (6, 3)])
def test_decoding_begins_at_the_last_key_frame_shown_before(number, position):
    assert index().position_before(number) == position


@pytest.mark.parametrize(("position", "first"), [(0, 0), (1, 0), (2, 0), (3, 3), (4, 3), (6, 3), (5, 0)])
def test_a_frame_before_its_key_frame_in_time_needs_the_group_before(position, first):
    assert index().first_needed(position) == first


def test_every_frame_stands_alone():
    alone = index(range(7), range(7), range(7))
    assert alone.intra_only
    assert [alone.position_before(number) for number in range(7)] == list(range(7))
    assert not index().intra_only


def test_without_stamps_only_the_frames_before_tell_which_one_it_is():
    assert index(range(7), range(7), ()).position_before(5) == 0
    assert not index(range(7), range(7), ()).intra_only
