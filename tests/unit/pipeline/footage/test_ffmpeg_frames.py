"""FFmpeg's pixel formats in our words, its planes as views, and what it says of damage."""

import av
import numpy as np
import pytest

from pipeline.errors import FootageError
from pipeline.footage.ffmpeg_frames import caught_messages, stored_planes, transfer_of
from pipeline.footage.footage import StoredAs
from tikernels.raw.development import develop
from tikernels.raw.pixel_format import PixelFormat
from tikernels.runtime import to_host


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
        ("nv12", PixelFormat("yuv", subsampling=(2, 2), matrix="bt601")),
        ("p010le", PixelFormat("yuv", 10, 6, subsampling=(2, 2), matrix="bt601")),
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


# Layouts that FFmpeg may deliver, and the planes that hold the same values.
SAME = {
    "yuv420p": ("nv12", "nv21", "yuva420p"),
    "yuv422p": ("nv16", "yuyv422", "uyvy422", "yvyu422", "yuva422p"),
    "yuv444p": ("nv24", "nv42", "vuya", "vuyx", "ayuv", "uyva", "vyu444", "yuva444p"),
    "yuv420p10le": ("p010le", "p010be", "yuv420p10be", "yuva420p10le"),
    "yuv422p10le": ("p210le", "nv20le", "y210le", "yuva422p10be"),
    "yuv444p10le": ("p410le", "yuv444p10msble"),
    "yuv422p12le": ("y212le", "p212le"),
    "yuv444p12le": ("xv36le",),
    "yuv444p16le": ("ayuv64le", "xv48le", "p416le"),
    "gbrp": ("gbrap", "rgba", "bgra", "argb", "abgr", "rgb24", "bgr24", "0rgb", "bgr0"),
    "gbrp16le": ("rgb48be", "rgba64le", "bgra64be", "bgr48le", "gbrp16be"),
}


def converted(frame, pixels):
    return frame.reformat(format=pixels, threads=1)  # several now and then leave a row out


def random_frame(pixels, size=(20, 36)):
    values = np.random.default_rng(0).integers(0, 2**16, (*size, 3)).astype(np.uint16)
    return converted(av.VideoFrame.from_ndarray(values, "rgb48le"), pixels)


def rgb_of(frame):
    """Return what is read of a frame, RGB in 0..1."""
    planes, format, _ = stored_planes(frame, "rawvideo", StoredAs())
    rgb = to_host(develop(planes, format))
    return rgb / (1.0 if rgb.dtype == np.float32 else np.iinfo(rgb.dtype).max)


@pytest.mark.parametrize(("planar", "other"), [(planar, other) for planar, names in SAME.items() for other in names])
def test_every_layout_is_read_as_its_planes_are(cpu, planar, other):
    frame = random_frame(planar)
    np.testing.assert_array_equal(rgb_of(converted(frame, other)), rgb_of(frame))


def test_floats_are_read_as_they_are(cpu):
    frame = av.VideoFrame(16, 4, "gbrpf32le")
    values = np.random.default_rng(1).random((3, 4, 16)).astype(np.float32)
    for plane, part in zip(frame.planes, values, strict=True):
        plane.update(part.tobytes())
    np.testing.assert_array_equal(rgb_of(frame), np.moveaxis(values[[2, 0, 1]], 0, -1))


@pytest.mark.parametrize("pixels", ["yuv411p", "yuv410p", "yuv440p", "yuvj411p"])
def test_rare_subsampling_is_read(cpu, pixels):
    """A smooth slope of colour comes back to a few levels."""
    y, x = np.mgrid[:64, :96] / 96
    slope = np.rint(255 * np.stack([0.2 + 0.5 * y, 0.3 + 0.4 * x, 0.7 - 0.4 * y], axis=-1)).astype(np.uint8)
    frame = converted(av.VideoFrame.from_ndarray(slope, "rgb24"), pixels)
    np.testing.assert_allclose(255 * rgb_of(frame)[8:-8, 8:-8], slope[8:-8, 8:-8], atol=4)


@pytest.mark.parametrize(
    ("pixels", "advised"),
    [
        ("rgb565le", "bgr0"),
        ("x2rgb10le", "gbrp16le"),
        ("v30xle", "gbrp16le"),
        ("xv30le", "gbrp16le"),
    ],
)
def test_what_is_advised_keeps_the_colours(cpu, pixels, advised):
    """Every pixel format that is refused comes with a conversion, after which the frame is what it was."""
    if pixels == "rgb565le":  # which FFmpeg writes with half the chroma
        frame = av.VideoFrame(32, 20, pixels)
        packed = np.random.default_rng(0).integers(0, 2**16, (20, 32)).astype(np.uint16)
        frame.planes[0].update(packed.tobytes())
        expected = np.stack([(packed >> 11) / 31, (packed >> 5 & 63) / 63, (packed & 31) / 31], axis=-1)
    else:
        frame, expected = random_frame(pixels), rgb_of(random_frame("rgb48le"))
    with pytest.raises(FootageError, match=f"{pixels} is not supported: convert it with ffmpeg -pix_fmt {advised} -c"):
        rgb_of(frame)
    np.testing.assert_allclose(rgb_of(converted(frame, advised)), expected, atol=1 / 255)


def test_what_is_advised_keeps_the_subsampling():
    with pytest.raises(FootageError, match="uyyvyy411 is not supported: convert it with ffmpeg -pix_fmt yuv411p -c"):
        planes_of("uyyvyy411")


def test_what_nobody_says_is_assumed_and_told():
    _, format, (note,) = planes_of("yuv420p")
    assert note.endswith("so this is assumed: matrix bt601, limited range (16 to 235)") and not format.full_range
    _, format, notes = planes_of("yuv420p", StoredAs(matrix="bt709", full_range=True))
    assert notes == () and format.matrix == "bt709" and format.full_range
    assert ": matrix bt709," in planes_of("yuv420p", size_px=(48, 720))[2][0]
    assert planes_of("yuvj420p", codec="mjpeg")[1].siting == "centre"


def test_what_the_user_says_against_the_file_is_told():
    tags = {"colorspace": 1, "color_range": 1}
    _, format, notes = planes_of("yuv420p", StoredAs(matrix="bt601", full_range=True), **tags)
    assert (format.matrix, format.full_range) == ("bt601", True)
    assert notes == ("the file says otherwise, but this is taken, as you say: matrix bt601, full range",)
    assert planes_of("yuv420p", StoredAs(matrix="bt709", full_range=False), **tags)[2] == ()
    _, _, notes = planes_of("yuvj420p", StoredAs(matrix="bt601", full_range=False))
    assert notes == ("the file says otherwise, but this is taken, as you say: limited range (16 to 235)",)


def test_grey_is_a_mosaic_only_if_somebody_says_which():
    for pixels in ("gray", "gray10le", "ya8", "grayf32le", "monob"):
        with pytest.raises(FootageError, match="say which: --bayer rggb"):
            planes_of(pixels)
    assert planes_of("gray", StoredAs(bayer="bggr"))[1] == PixelFormat("bayer", bayer="bggr")


def test_a_palette_holds_no_phase():
    with pytest.raises(FootageError, match="stored with a palette, whose few colours hold no phase"):
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
