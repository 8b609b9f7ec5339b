"""Pictures as they are stored, and what is said of files that are none."""

import os
import struct
import zlib

import cv2
import numpy as np
import pytest

from pipeline.errors import FootageError
from pipeline.footage.image_file import read_image
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
        b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + head + struct.pack(">I", zlib.crc32(head)) + b"IEND\xaeB`\x82"
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
