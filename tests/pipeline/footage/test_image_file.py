"""Pictures as they are stored, and what is said of files that are none."""

import struct
import zlib

import cv2
import numpy as np
import pytest

from pipeline.errors import FootageError
from pipeline.footage.image_file import read_image


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
