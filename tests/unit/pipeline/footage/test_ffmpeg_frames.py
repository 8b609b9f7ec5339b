"""FFmpeg's pixel formats in our words, its planes as views, and what it says of damage."""

import av
import numpy as np
import pytest

from pipeline.errors import FootageError
from pipeline.footage.ffmpeg_frames import caught_messages, stored_planes, transfer_of
from pipeline.footage.source import StoredAs
from tikernels.raw.pixel_format import PixelFormat


def planes_of(pixels, says=None, codec="ffv1", size_px=(48, 32), **properties):
    frame = av.VideoFrame(*size_px, pixels)
    for number, plane in enumerate(frame.planes):
        memory = np.frombuffer(memoryview(plane), np.uint8)
        memory.flags.writeable and memory.fill(number + 1)
    for name, value in properties.items():
        setattr(frame, name, value)
    return stored_planes(frame, codec, says or StoredAs())


@pytest.mark.parametrize(
    ("pixels", "format"),
    [
        ("yuv420p", PixelFormat("yuv", subsampling=(2, 2), matrix="bt601")),
        ("yuv422p10le", PixelFormat("yuv", 10, subsampling=(2, 1), matrix="bt601")),
        ("nv12", PixelFormat("yuv", subsampling=(2, 2), interleaved=True, matrix="bt601")),
        ("p010le", PixelFormat("yuv", 10, 6, subsampling=(2, 2), interleaved=True, matrix="bt601")),
        ("bgr0", PixelFormat("rgb", channels="bgr0")),
        ("rgb48le", PixelFormat("rgb", 16)),
        ("gbrp12le", PixelFormat("rgb", 12, channels="gbr")),
        ("bayer_gbrg8", PixelFormat("bayer", bayer="gbrg")),
    ],
)
def test_what_a_name_says_of_its_pixels(pixels, format):
    planes, found, _ = planes_of(pixels)
    assert found == format
    shapes = format.plane_shapes(32, 48)
    assert [plane.shape[:2] for plane in planes] == [
        shape[:2] for shape in (shapes if len(planes) == len(shapes) else 3 * shapes)
    ]


def test_packed_chroma_is_taken_apart_without_a_copy():
    frame = av.VideoFrame(4, 2, "yuyv422")
    packed = np.tile(np.array([10, 128, 20, 130], np.uint8), (2, 2))
    row = frame.planes[0].line_size
    memory = np.zeros((2, row), np.uint8)
    memory[:, :8] = packed
    frame.planes[0].update(memory.tobytes())
    (luma, blue, red), _, _ = stored_planes(frame, "rawvideo", StoredAs())
    np.testing.assert_array_equal(luma, np.tile([10, 20], (2, 2)))
    np.testing.assert_array_equal(blue, np.full((2, 2), 128))
    np.testing.assert_array_equal(red, np.full((2, 2), 130))


def test_what_nobody_says_is_assumed_and_told():
    _, format, assumed = planes_of("yuv420p")
    assert assumed == ("matrix bt601", "limited range (16 to 235)") and not format.full_range
    _, format, assumed = planes_of("yuv420p", StoredAs(matrix="bt709", full_range=True))
    assert assumed == () and format.matrix == "bt709" and format.full_range
    assert planes_of("yuv420p", size_px=(48, 720))[2][0] == "matrix bt709"
    assert planes_of("yuvj420p", codec="mjpeg")[1].siting == "centre"


def test_grey_is_a_mosaic_only_if_somebody_says_which():
    with pytest.raises(FootageError, match="say which: --bayer rggb"):
        planes_of("gray")
    assert planes_of("gray", StoredAs(bayer="bggr"))[1] == PixelFormat("bayer", bayer="bggr")


def test_pixels_that_no_kernel_reads_come_with_a_command():
    with pytest.raises(FootageError, match=r"pixel format pal8 is not supported: convert it with ffmpeg -pix_fmt"):
        planes_of("pal8")


@pytest.mark.parametrize(("number", "expected"), [(13, ("srgb", None)), (16, (None, "PQ")), (2, (None, None))])
def test_a_transfer_is_undone_named_or_unknown(number, expected):
    frame = av.VideoFrame(16, 16, "yuv420p")
    frame.color_trc = number
    assert transfer_of(frame) == expected


def test_errors_are_caught_and_the_harmless_ones_left_out(capfd):
    with caught_messages() as said:
        av.logging.log(av.logging.ERROR, "ffv1", "  slice CRC mismatch\n")
        av.logging.log(av.logging.ERROR, "h264", "mmco: unref short failure")
        av.logging.log(av.logging.ERROR, "h264", "co located POCs unavailable")
        av.logging.log(av.logging.INFO, "h264", "all is well")
        assert said == []  # filled at the end
    assert said == ["slice CRC mismatch"]
    assert capfd.readouterr().err == ""


def test_the_same_message_twice_is_told_twice():
    with caught_messages() as said:
        for _ in range(2):
            av.logging.log(av.logging.ERROR, "ffv1", "slice CRC mismatch")
    assert said == 2 * ["slice CRC mismatch"]
