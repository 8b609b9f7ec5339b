"""Pictures are read as they are stored, or refused in one line."""

import os
import struct
import zlib

import cv2
import numpy as np
import pytest

from pipeline.errors import FootageError
from pipeline.footage.footage import StoredFrame
from pipeline.footage.image_file import PlaneDecoder, read_image
from pipeline.footage.opening import open_footage
from pipeline.limits import MAX_PIXELS


@pytest.mark.parametrize(
    ("suffix", "dtype"),
    [(".png", np.uint8), (".png", np.uint16), (".tif", np.uint8), (".tif", np.uint16), (".bmp", np.uint8)],
)
def test_pictures_are_read_as_they_are(tmp_path, suffix, dtype):
    image = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, (20, 30, 3)).astype(dtype)
    path = tmp_path / f"Bild ä{suffix}"
    path.write_bytes(cv2.imencode(suffix, image[..., ::-1])[1].tobytes())
    np.testing.assert_array_equal(read_image(path), image)


def test_pictures_that_are_none(tmp_path):
    image = np.random.default_rng(0).integers(0, 255, (64, 64, 3)).astype(np.uint8)
    data = {suffix: cv2.imencode(suffix, image)[1].tobytes() for suffix in (".png", ".jpg", ".tif", ".bmp")}
    bad = {
        "grey.png": (cv2.imencode(".png", image[..., 0])[1].tobytes(), "grey"),
        "alpha.png": (cv2.imencode(".png", np.dstack([image, image[..., 0]]))[1].tobytes(), "transparency"),
        "empty.png": (b"", "not a picture"),
        "text.png": (b"hello", "not a picture"),
        **{f"cut{suffix}": (whole[: len(whole) // 2], "truncated|not a picture") for suffix, whole in data.items()},
    }
    for name, (content, message) in bad.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(FootageError, match=message) as raised:
            read_image(tmp_path / name)
        assert name in str(raised.value)
        assert "\n" not in str(raised.value)
    with pytest.raises(FootageError, match="folder"):
        read_image(tmp_path)
    with pytest.raises(FootageError, match="No such file"):
        read_image(tmp_path / "none.png")


def test_a_small_file_of_a_picture_larger_than_any_cameras(tmp_path, monkeypatch):
    """Decoding it would take all memory; larger cameras' pictures are read where the user says so."""
    head = b"IHDR" + struct.pack(">IIBBBBB", 16000, 16000, 8, 2, 0, 0, 0)
    image = np.random.default_rng(0).integers(0, 255, (40, 60, 3)).astype(np.uint8)
    (tmp_path / "bomb.png").write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + struct.pack(">I", 13)
        + head
        + struct.pack(">I", zlib.crc32(head))
        + bytes(4)
        + b"IEND\xaeB`\x82"
    )
    with pytest.raises(FootageError, match=r"bomb\.png has 16000x16000 px, .* set COLORPHASE_MAX_PIXELS to a larger"):
        read_image(tmp_path / "bomb.png")
    for suffix in (".png", ".jpg", ".tif", ".bmp", ".webp", ".ppm"):
        path = tmp_path / f"picture{suffix}"
        path.write_bytes(cv2.imencode(suffix, image)[1].tobytes())
        monkeypatch.setenv(MAX_PIXELS, "2000")
        with pytest.raises(FootageError, match="60x40 px, and 2000 pixels are read at most"):
            read_image(path)
        monkeypatch.setenv(MAX_PIXELS, "2400")
        assert read_image(path).shape == (40, 60, 3)


def test_what_is_no_file_or_too_long_is_not_read(tmp_path):
    with (tmp_path / "long.png").open("wb") as file:
        file.truncate(2**31)
    with pytest.raises(FootageError, match=r"long\.png is larger than a picture of 67108864 pixels"):
        read_image(tmp_path / "long.png")
    if hasattr(os, "mkfifo"):  # it would be waited for
        os.mkfifo(tmp_path / "pipe.png")
        with pytest.raises(FootageError, match=r"pipe\.png: it is no file"):
            read_image(tmp_path / "pipe.png")


def test_a_damaged_jpeg_is_told(tmp_path, capfd):
    """OpenCV reads it as grey, and prints what is wrong."""
    image = np.random.default_rng(0).integers(0, 255, (64, 64, 3)).astype(np.uint8)
    data = cv2.imencode(".jpg", image)[1].tobytes()
    (tmp_path / "wrong.jpg").write_bytes(data[:1500] + bytes(300) + data[1800:])
    with pytest.raises(FootageError, match=r"wrong\.jpg: it is damaged"):
        read_image(tmp_path / "wrong.jpg")
    assert capfd.readouterr().err == ""


def test_what_libpng_says_is_not_printed(tmp_path, capfd):
    """Neither of damage nor of a colour profile that it does not like."""
    image = np.random.default_rng(0).integers(0, 255, (64, 64, 3)).astype(np.uint8)
    data = cv2.imencode(".png", image[..., ::-1])[1].tobytes()
    profile = b"iCCPx\0\0" + zlib.compress(bytes(200))
    profile = struct.pack(">I", len(profile) - 4) + profile + struct.pack(">I", zlib.crc32(profile))
    (tmp_path / "profile.png").write_bytes(data[:33] + profile + data[33:] + b"and more")
    np.testing.assert_array_equal(read_image(tmp_path / "profile.png"), image)
    (tmp_path / "wrong.png").write_bytes(data[:2000] + bytes(50) + data[2050:])
    with pytest.raises(FootageError, match=r"wrong\.png is damaged: copy it again"):
        read_image(tmp_path / "wrong.png")
    assert capfd.readouterr().err == ""


DATA = cv2.imencode(".jpg", np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8))[1].tobytes()


def test_a_damaged_picture_is_told_and_the_next_one_is_whole():
    decoder = PlaneDecoder("mjpeg")
    first = decoder.decode(DATA).to_ndarray()
    with pytest.raises(FootageError, match=r"^it is damaged \("):
        decoder.decode(DATA[:1500] + bytes(300) + DATA[1800:])
    with pytest.raises(FootageError, match="does not say how large it is"):
        decoder.decode(DATA[:20])
    np.testing.assert_array_equal(decoder.decode(DATA).to_ndarray(), first)


def test_larger_pictures_than_cameras_take_are_refused(monkeypatch):
    monkeypatch.setenv(MAX_PIXELS, "3000")
    with pytest.raises(FootageError, match=r"^it has 64x48 px, and 3000 pixels are read at most: set COLORPHASE_MAX"):
        PlaneDecoder("mjpeg").decode(DATA)


TAIL, ZEROS = b"MotionPhoto_Data" * 300, bytes(5000)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".bmp", ".webp", ".ppm"])
def test_bytes_behind_a_picture_are_ignored(tmp_path, suffix):
    """As phones, padded buffers and copying programs leave them."""
    image = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
    data = cv2.imencode(suffix, image)[1].tobytes()
    (tmp_path / f"a{suffix}").write_bytes(data)
    expected = read_image(tmp_path / f"a{suffix}")
    for tail in (TAIL, ZEROS, data):
        (tmp_path / f"a{suffix}").write_bytes(data + tail)
        np.testing.assert_array_equal(read_image(tmp_path / f"a{suffix}"), expected)
        (frame,) = open_footage(tmp_path / f"a{suffix}").frames()
        assert isinstance(frame, StoredFrame)


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
@pytest.mark.parametrize("tail", [TAIL, ZEROS, "itself"])
def test_a_truncated_picture_is_told_whatever_is_behind_it(tmp_path, suffix, tail):
    image = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
    data = cv2.imencode(suffix, image)[1].tobytes()
    for length in (len(data) // 3, len(data) - 20, len(data) - 1):
        (tmp_path / f"a{suffix}").write_bytes(data[:length] + (data if tail == "itself" else tail))
        with pytest.raises(FootageError, match=r"is (truncated|damaged): copy it again"):
            read_image(tmp_path / f"a{suffix}")


def with_frame(**changes):
    """Return a JPEG whose frame's head says otherwise."""
    data, begin = bytearray(DATA), DATA.index(b"\xff\xc0")
    for name, value in changes.items():
        data[begin + {"kind": 1, "bits": 4, "luma": 11, "blue": 14}[name]] = value
    return bytes(data)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"kind": 0xC9}, "it is a JPEG with arithmetic coding, which is not read"),
        ({"kind": 0xC5}, r"it is a JPEG of several resolutions \(hierarchical\), which is not read"),
        ({"luma": 0x31}, "its colours are sampled in a way that is not read: save it as PNG"),
        ({"blue": 0x12}, "its colours are sampled in a way that is not read"),
        ({"bits": 12}, "it is a JPEG of 12 bits, which is not read: save it as a PNG or TIFF of 16 bits"),
    ],
)
def test_rare_kinds_of_jpeg_are_named(tmp_path, changes, reason):
    (tmp_path / "a.jpg").write_bytes(with_frame(**changes))
    with pytest.raises(FootageError, match=reason):
        read_image(tmp_path / "a.jpg")
    with pytest.raises(FootageError, match=reason):
        open_footage(tmp_path / "a.jpg")


def test_levels_that_end_early_are_scaled(tmp_path):
    """Of 12 bits in PNM: white is that of the type, as read_image says nothing else."""
    levels = np.random.default_rng(0).integers(0, 4096, (8, 16, 3)).astype(np.uint16)
    (tmp_path / "a.ppm").write_bytes(b"P6 # a camera\n16 8\n4095\n" + levels.astype(">u2").tobytes())
    np.testing.assert_array_equal(read_image(tmp_path / "a.ppm"), levels << 4)
    (frame,) = open_footage(tmp_path / "a.ppm").frames()
    assert frame.format.bits == 12
    np.testing.assert_array_equal(frame.planes[0], levels)
