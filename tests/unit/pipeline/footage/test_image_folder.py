"""Frames from folders of pictures."""

import os

import cv2
import numpy as np
import pytest
from PIL import Image  # of matplotlib's own dependencies

from pipeline.errors import FootageError
from pipeline.footage.footage import BadFrame, StoredFrame
from pipeline.footage.image_file import read_image
from pipeline.footage.image_folder import natural_key
from pipeline.footage.opening import open_footage
from tikernels.raw.development import develop
from tikernels.raw.pixel_format import PixelFormat

pytestmark = pytest.mark.usefixtures("cpu")

RNG = np.random.default_rng(4)


def write(path, levels):
    path.write_bytes(cv2.imencode(path.suffix, levels)[1].tobytes())


def colors(dtype=np.uint8, size=(20, 30)):
    return RNG.integers(0, np.iinfo(dtype).max + 1, (*size, 3)).astype(dtype)


def test_people_sort_numbers_by_value():
    names = ["b1", "a10", "a9", "A1", "a01", "a9b2", "a9b11", "2", "10", "a"]
    assert sorted(names, key=natural_key) == ["2", "10", "a", "A1", "a01", "a9", "a9b2", "a9b11", "a10", "b1"]


@pytest.mark.parametrize(
    "suffix, dtype", [(".png", np.uint8), (".png", np.uint16), (".tif", np.uint16), (".bmp", np.uint8)]
)
def test_a_folder_in_its_natural_order(tmp_path, suffix, dtype):
    pictures = {number: colors(dtype) for number in (1, 2, 10, 11)}
    for number, picture in pictures.items():
        write(tmp_path / f"Bild {number} ä{suffix}", picture[..., ::-1])
    (tmp_path / ".hidden.png").write_bytes(b"")
    (tmp_path / "notes.txt").write_text("not a picture")
    source = open_footage(tmp_path)
    frames = list(source.frames())
    assert len(source) == len(frames) == 4
    assert source.size_px == (30, 20)
    for frame, picture in zip(frames, pictures.values(), strict=True):
        assert frame.format == PixelFormat("rgb", 8 * picture.itemsize)
        np.testing.assert_array_equal(frame.planes[0], picture)
    assert [frame.number for frame in source.frames(1, None, 2)] == [1, 3]


def test_a_single_picture(tmp_path):
    write(tmp_path / "one.png", colors())
    source = open_footage(tmp_path / "one.png")
    assert [frame.number for frame in source.frames()] == [0]
    assert source.name == str(tmp_path / "one.png")


def test_bad_pictures_have_their_numbers(tmp_path):
    for i in range(6):
        write(tmp_path / f"{i}.png", colors())
    (tmp_path / "0.png").write_bytes(b"")
    (tmp_path / "1.png").write_bytes((tmp_path / "2.png").read_bytes()[:-50])
    write(tmp_path / "3.png", colors(size=(21, 30)))
    (tmp_path / "4.png").unlink()
    (tmp_path / "4.png").mkdir()
    frames = list(open_footage(tmp_path).frames())
    reasons = {frame.number: frame.reason for frame in frames if isinstance(frame, BadFrame)}
    assert [frame.number for frame in frames] == list(range(6))
    assert list(reasons) == [0, 1, 3, 4]
    assert "is not a picture" in reasons[0]
    assert "is truncated" in reasons[1]
    assert "3.png: it is 30x21 rgb, the first is 30x20 rgb" in reasons[3]
    assert "it is a folder" in reasons[4]


def test_a_jpeg_gives_its_planes(tmp_path):
    """A slope of colour that chroma of half the size can show, to 3 grey levels."""
    y, x = np.mgrid[:64, :96]
    picture = np.stack([40 + 2 * y, 100 + x, 200 - y], axis=-1).astype(np.uint8)
    (tmp_path / "a.jpg").write_bytes(
        cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()
    )
    source = open_footage(tmp_path / "a.jpg")
    (frame,) = source.frames()
    expected = PixelFormat("yuv", subsampling=(2, 2), siting="centre", matrix="bt601", full_range=True)
    assert frame.format == expected
    assert source.notes == ()
    np.testing.assert_allclose(255 * np.array(develop(frame.planes, frame.format)), picture, atol=3)


def test_mixed_pictures_of_the_same_scene(tmp_path):
    """The frames of a folder may be PNG and JPEG; only what differs from the first in size or kind is refused."""
    write(tmp_path / "1.png", colors())
    write(tmp_path / "2.jpg", colors())
    first, second = open_footage(tmp_path).frames()
    assert isinstance(first, StoredFrame)
    assert isinstance(second, BadFrame)
    assert second.reason.startswith(
        "2.jpg: its light is srgb (a JPEG that says nothing else is sRGB), the first is lin"
    )


def test_an_orientation_that_changes_is_named(tmp_path):
    """Whether it changes the size or not."""
    for number, orientation in enumerate((1, 1, 3, 6)):
        tags = Image.Exif()
        tags[274] = orientation
        Image.fromarray(colors()).save(tmp_path / f"{number}.jpg", exif=tags)
    first, second, *turned = open_footage(tmp_path).frames()
    assert isinstance(first, StoredFrame) and isinstance(second, StoredFrame)
    for frame, orientation in zip(turned, (3, 6), strict=True):
        assert f"its Exif orientation is {orientation}, the first has 1" in frame.reason


def test_a_list_of_pictures_is_kept(tmp_path):
    for number in range(3):
        write(tmp_path / f"{number}.png", colors())
    assert len(open_footage(tmp_path, listed=("0.png", "1.png"))) == 2


def test_what_is_not_used_is_noted(tmp_path):
    write(tmp_path / "a.png", np.dstack([colors(), np.eye(20, 30, dtype=np.uint8)]))
    assert open_footage(tmp_path / "a.png").notes == (
        "it is transparent in parts, which is not used: its colours are taken as they are stored",
    )
    write(tmp_path / "a.png", colors(np.uint16) >> 4)
    (note,) = open_footage(tmp_path / "a.png").notes
    assert note.endswith("if the camera gives 12, add --bits 12")
    assert open_footage(tmp_path / "a.png", bits=12).notes == ()


def test_pictures_of_other_levels_do_not_mix(tmp_path):
    """One store holds grey levels on one scale."""
    for name, picture in (("1.png", colors()), ("2.png", colors(np.uint16)), ("3.png", colors())):
        write(tmp_path / name, picture)
    first, second, third = open_footage(tmp_path).frames()
    assert second == BadFrame(1, "2.png: it is of 16 bits, the first is of 8 bits")
    assert isinstance(first, StoredFrame) and isinstance(third, StoredFrame)


def test_jpegs_of_other_subsampling_do_not_mix(tmp_path):
    """A region of interest may begin at an odd pixel of one, and not of the other."""
    for name, sampling in (("1.jpg", "444"), ("2.jpg", "420")):
        factor = getattr(cv2, f"IMWRITE_JPEG_SAMPLING_FACTOR_{sampling}")
        coded = cv2.imencode(".jpg", colors(), [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, factor])[1]
        (tmp_path / name).write_bytes(coded.tobytes())
    _, second = open_footage(tmp_path).frames()
    assert second == BadFrame(1, "2.jpg: it is subsampled by 2x2, the first is subsampled by 1x1")


def test_a_grey_picture_of_floats_is_bad(tmp_path):
    write(tmp_path / "1.png", RNG.integers(0, 4096, (20, 30)).astype(np.uint16))
    write(tmp_path / "2.tif", np.eye(20, 30, dtype=np.float32))
    _, second = open_footage(tmp_path, bayer="rggb").frames()
    assert isinstance(second, BadFrame)
    assert second.reason.endswith("2.tif: bayer pixels of 32 bits: only RGB may be floats")


@pytest.mark.parametrize("keep, reason", [(0.6, "is truncated"), (0.99, "is truncated")])
def test_a_jpeg_that_was_cut_off(tmp_path, keep, reason):
    for i in range(2):
        write(tmp_path / f"{i}.jpg", colors())
    data = (tmp_path / "1.jpg").read_bytes()
    (tmp_path / "1.jpg").write_bytes(data[: int(keep * len(data))])
    _, frame = open_footage(tmp_path).frames()
    assert isinstance(frame, BadFrame)
    assert reason in frame.reason


def test_a_jpeg_that_is_damaged_inside(tmp_path):
    for i in range(2):
        write(tmp_path / f"{i}.jpg", colors(size=(64, 96)))
    data = bytearray((tmp_path / "1.jpg").read_bytes())
    data[-200:-20] = 90 * b"\xff\x00"  # ones only: no code of a JPEG begins so
    (tmp_path / "1.jpg").write_bytes(data)
    _, frame = open_footage(tmp_path).frames()
    assert isinstance(frame, BadFrame)
    assert "1.jpg: it is damaged" in frame.reason


def test_grey_pictures_are_mosaics_only_if_somebody_says_so(tmp_path):
    levels = RNG.integers(0, 4096, (20, 30)).astype(np.uint16)
    write(tmp_path / "raw.png", levels)
    with pytest.raises(FootageError, match=r"raw\.png: it is grey, .*: if it is a Bayer mosaic, say which"):
        open_footage(tmp_path)
    source = open_footage(tmp_path, bayer="bggr", bits=12)
    assert source.format == PixelFormat("bayer", 12, bayer="bggr")
    (frame,) = source.frames()
    np.testing.assert_array_equal(frame.planes[0], levels)


def test_transparency_is_left_away(tmp_path):
    picture = RNG.integers(0, 256, (20, 30, 4)).astype(np.uint8)
    write(tmp_path / "layers.png", picture)
    (frame,) = open_footage(tmp_path).frames()
    np.testing.assert_array_equal(frame.planes[0], picture[..., 2::-1])


def test_a_folder_without_pictures(tmp_path):
    (tmp_path / "notes.txt").write_text("nothing")
    with pytest.raises(FootageError, match="holds no pictures: give a folder of PNG"):
        open_footage(tmp_path)


def test_a_folder_of_which_nothing_can_be_read(tmp_path):
    for i in range(3):
        (tmp_path / f"{i}.png").write_bytes(b"rubbish")
    with pytest.raises(
        FootageError, match=r"cannot read .*: none of its 3 pictures can be read; the first: .*0\.png is not a picture"
    ):
        open_footage(tmp_path)


def test_many_tiny_files_are_not_asked_one_by_one(tmp_path, monkeypatch):
    """100,000 files: the list of names is enough, and only the frames that are wanted are read."""
    write(tmp_path / "0.png", colors())
    for i in range(1, 100):
        os.link(tmp_path / "0.png", tmp_path / f"{i}.png")
    names = os.listdir(tmp_path)
    monkeypatch.setattr(os, "listdir", lambda folder: [f"{i}.png" for i in reversed(range(100_000))])
    source = open_footage(tmp_path)
    assert len(names) == 100
    assert len(source) == 100_000
    assert [frame.number for frame in source.frames(97, 100)] == [97, 98, 99]
    assert isinstance(next(source.frames(100)), BadFrame)


def test_read_picture_reads_what_it_did(tmp_path):
    picture = colors(np.uint16)
    write(tmp_path / "a.png", picture[..., ::-1])
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), picture)
    write(tmp_path / "grey.png", picture[..., 0])
    with pytest.raises(FootageError, match="is grey"):
        read_image(tmp_path / "grey.png")
