"""Which source footage is, and what is said of what is none."""

import numpy as np
import pytest
from support.numbered_frames import record

from pipeline.errors import FootageError
from pipeline.footage.image_folder import ImageFolder
from pipeline.footage.opening import open_source
from pipeline.footage.video_file import VideoFile
from pipeline.footage.zarr_recording import ZarrRecording
from pipeline.output.range_image import write_png
from tikernels.raw.pixel_format import PixelFormat


def test_each_kind_has_its_source(tmp_path):
    record(tmp_path / "a.mkv")
    record(tmp_path / "a.zarr")
    (tmp_path / "pictures").mkdir()
    write_png(tmp_path / "pictures" / "1.png", np.zeros((16, 16, 3), np.uint8))
    kinds = {"a.mkv": VideoFile, "a.zarr": ZarrRecording, "pictures": ImageFolder, "pictures/1.png": ImageFolder}
    for name, kind in kinds.items():
        source = open_source(tmp_path / name)
        assert isinstance(source, kind) and source.name == str(tmp_path / name)
        source.close()


def test_a_recording_without_its_suffix_is_known_by_its_contents(tmp_path):
    record(tmp_path / "a.zarr")
    (tmp_path / "a.zarr").rename(tmp_path / "take 2")
    assert isinstance(open_source(tmp_path / "take 2"), ZarrRecording)


def test_what_the_user_says_wins(tmp_path):
    record(tmp_path / "a.zarr", PixelFormat("bayer", 12, bayer="grbg"))
    source = open_source(tmp_path / "a.zarr", bayer="rggb", bits=14)
    assert source.format == PixelFormat("bayer", 14, bayer="rggb")


def test_each_mistake_names_the_file_once(tmp_path):
    (tmp_path / "text.mp4").write_text("hello")
    (tmp_path / "folder").mkdir()
    for name, message in (
        ("none.mkv", "there is no such file"),
        ("text.mp4", "is not a video that can be read"),
        ("folder", "holds no"),
    ):
        with pytest.raises(FootageError, match=message) as raised:
            open_source(tmp_path / name)
        assert str(raised.value).count(str(tmp_path / name)) == 1 and "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("begin", "kind"),
    [
        (b"\0\0\0\x1cftypavif\0\0\0\0", "AVIF"),
        (b"GIF89a\1\0\1\0\0\0\0", "GIF"),
    ],
)
def test_pictures_that_are_not_read_are_named(tmp_path, begin, kind):
    for name in ("a.heic", "a.png", "a"):
        (tmp_path / name).write_bytes(begin + bytes(100))
        with pytest.raises(FootageError, match=rf"{name}: it is a picture in {kind}: save it as PNG, TIFF or JPEG"):
            open_source(tmp_path / name)


def test_raw_files_of_cameras_are_named(tmp_path):
    for name in ("a.CR2", "b.dng"):
        (tmp_path / name).write_bytes(b"II*\0" + bytes(100))
        with pytest.raises(FootageError, match=rf"{name}: it is a camera's raw file: convert it to a TIFF of 16 bits"):
            open_source(tmp_path / name)
