"""Pictures of phones."""

import io
import sys

import numpy as np
import pytest
from PIL import Image, ImageCms  # of matplotlib's own dependencies
from support.missing import import_but_fail_in_ci

from pipeline.errors import FootageError
from pipeline.footage.heic_picture import is_heic, read_heic
from pipeline.footage.image_file import read_image
from pipeline.footage.opening import open_source

pillow_heif = import_but_fail_in_ci("pillow_heif")

HEIGHT, WIDTH = 64, 96


def colors():
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return np.stack([2 * x, 3 * y, 255 - x - y], axis=-1).astype(np.uint8)


def stored(image, **options):
    file = io.BytesIO()
    pillow_heif.from_pillow(Image.fromarray(image)).save(file, quality=100, chroma=444, **options)
    return file.getvalue()


def test_colours_are_kept(tmp_path):
    data = stored(colors())
    assert is_heic(data[:12]) and not is_heic(b"\x89PNG\r\n\x1a\n1234")
    levels, tags = read_heic(data)
    assert levels.dtype == np.uint8
    assert np.abs(levels.astype(int) - colors()).max() <= 4
    assert (tags.orientation, tags.transfer) == (1, "srgb")
    for name in ("a.heic", "a.jpg", "a"):  # phones' programs rename them
        (tmp_path / name).write_bytes(data)
        np.testing.assert_array_equal(read_image(tmp_path / name), levels)
        (frame,) = open_source(tmp_path / name).frames()
        np.testing.assert_array_equal(frame.planes[0], levels)


def test_ten_bits_fill_sixteen():
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    image = np.stack([600 * x, 900 * y, 65535 - 300 * (x + y)], axis=-1).astype(np.uint16)
    file = io.BytesIO()
    pillow_heif.encode("RGB;16", (WIDTH, HEIGHT), image.tobytes(), file, quality=100, chroma=444)
    levels, _ = read_heic(file.getvalue())
    assert levels.dtype == np.uint16
    assert np.abs(levels.astype(int) - image).max() < 65535 / 100


def test_a_profile_tells_the_transfer():
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    file = io.BytesIO()
    picture = Image.fromarray(colors())
    picture.info["icc_profile"] = profile
    pillow_heif.from_pillow(picture).save(file, quality=90)
    assert read_heic(file.getvalue())[1].because == "its colour profile says so"


def test_what_is_none(monkeypatch):
    data = stored(colors())
    with pytest.raises(FootageError, match="it is damaged: copy it again"):
        read_heic(data[: len(data) // 2])
    grey = io.BytesIO()
    pillow_heif.from_pillow(Image.fromarray(colors()[..., 0])).save(grey)
    with pytest.raises(FootageError, match="it is grey"):
        read_heic(grey.getvalue())
    monkeypatch.setenv("COLORPHASE_MAX_PIXELS", "1000")
    with pytest.raises(FootageError, match="COLORPHASE_MAX_PIXELS"):
        read_heic(data)


def test_without_the_extra_it_says_what_to_install(tmp_path, monkeypatch):
    (tmp_path / "a.heic").write_bytes(stored(colors()))
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(FootageError, match=r"a\.heic: it is a picture in HEIC: pip install 'colorphase\[heic\]'"):
        open_source(tmp_path / "a.heic")
