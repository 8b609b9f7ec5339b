"""Pictures as phones store them."""

import io
import sys

import numpy as np
import pytest
from PIL import Image, ImageCms  # of matplotlib's own dependencies
from support.missing import import_but_fail_in_ci

from pipeline.errors import FootageError
from pipeline.footage.heic_file import is_heic, read_heic
from pipeline.footage.image_file import read_image
from pipeline.footage.opening import open_footage
from tikernels import runtime
from tikernels.raw.development import develop
from tikernels.raw.pixel_format import PixelFormat

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
    (levels,), format, tags = read_heic(data)
    assert format == PixelFormat("rgb") and levels.dtype == np.uint8
    assert np.abs(levels.astype(int) - colors()).max() <= 4
    assert (tags.orientation, tags.transfer) == (1, "srgb")
    for name in ("a.heic", "a.jpg", "a"):  # phones' programs rename them
        (tmp_path / name).write_bytes(data)
        np.testing.assert_array_equal(read_image(tmp_path / name), levels)
        (frame,) = open_footage(tmp_path / name).frames()
        np.testing.assert_array_equal(frame.planes[0], levels)


def test_ten_bits_fill_sixteen():
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    image = np.stack([600 * x, 900 * y, 65535 - 300 * (x + y)], axis=-1).astype(np.uint16)
    file = io.BytesIO()
    pillow_heif.encode("RGB;16", (WIDTH, HEIGHT), image.tobytes(), file, quality=100, chroma=444)
    (levels,), format, _ = read_heic(file.getvalue())
    assert format == PixelFormat("rgb", 16)
    assert levels.dtype == np.uint16
    assert np.abs(levels.astype(int) - image).max() < 65535 / 100


def test_a_profile_tells_the_transfer():
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    file = io.BytesIO()
    picture = Image.fromarray(colors())
    picture.info["icc_profile"] = profile
    pillow_heif.from_pillow(picture).save(file, quality=90)
    assert read_heic(file.getvalue())[2].because == "its colour profile says so"


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


@pytest.mark.parametrize(("chroma", "turns", "subsampling"), [(420, 0, (2, 2)), (420, 1, (2, 2)), (422, 0, (2, 1))])
def test_chroma_of_half_the_resolution_is_interpolated(tmp_path, cpu, chroma, turns, subsampling):
    """Libheif repeats its samples: 20 levels off where colours change quickly."""
    odd = 0 if turns else 1  # turned, pairs of an odd size begin elsewhere
    y, x = np.mgrid[: HEIGHT + odd, : WIDTH + odd][..., None] * (2 * np.pi / 12)
    colour = np.arange(3) * 2 * np.pi / 3
    image = np.rint(127 + 30 * (np.cos(x + colour) + np.cos(y - colour))).astype(np.uint8)
    file = io.BytesIO()
    heif = pillow_heif.from_pillow(Image.fromarray(np.ascontiguousarray(np.rot90(image, turns))))
    tags = Image.Exif()
    tags[274] = 6 if turns else 1
    heif[0].info["exif"] = tags.tobytes()
    heif.save(file, quality=100, chroma=chroma)
    (tmp_path / "a.heic").write_bytes(file.getvalue())
    (frame,) = open_footage(tmp_path / "a.heic").frames()
    assert frame.format.subsampling == subsampling
    shown = 255 * runtime.to_host(develop(frame.planes, frame.format))
    assert shown.shape == image.shape
    inside = (slice(12, -12), slice(12, -12))
    assert np.abs(shown - image)[inside].max() < 8
    with pytest.raises(FootageError, match="its colours have half the resolution: open_footage and develop"):
        read_image(tmp_path / "a.heic")


def test_chroma_that_is_not_in_pairs_is_refused(monkeypatch):
    data = stored(np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8))
    opened = pillow_heif.open_heif

    def said(*arguments, **options):
        picture = opened(*arguments, **options)
        picture.info["chroma"] = 420
        return picture

    monkeypatch.setattr(pillow_heif, "open_heif", said)
    with pytest.raises(FootageError, match="half the resolution, and cannot be separated again: save it as PNG"):
        read_heic(data)


def test_several_pictures_and_transparency_are_noted():
    file = io.BytesIO()
    heif = pillow_heif.from_pillow(Image.fromarray(np.dstack([colors(), colors()[..., 0]])))
    heif.add_from_pillow(Image.fromarray(colors()))
    heif.save(file, quality=100, chroma=444)
    several, transparent = read_heic(file.getvalue())[2].notes
    assert several == "it holds 2 pictures, of which the first is read"
    assert transparent.startswith("it is transparent in parts")


def test_without_the_extra_it_says_what_to_install(tmp_path, monkeypatch):
    (tmp_path / "a.heic").write_bytes(stored(colors()))
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(FootageError, match=r"a\.heic: it is a picture in HEIC: pip install 'colorphase\[heic\]'"):
        open_footage(tmp_path / "a.heic")
