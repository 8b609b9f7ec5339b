"""Pages of TIFF files are frames; a page that OpenCV would read otherwise than it is stored is refused."""

import struct

import cv2
import numpy as np
import pytest
from support.tiff_samples import packed_tiff, tiff

from pipeline.errors import FootageError
from pipeline.footage.footage import BadFrame, StoredFrame
from pipeline.footage.image_file import read_image
from pipeline.footage.image_folder import is_footage
from pipeline.footage.opening import open_footage
from pipeline.footage.tiff_file import page_places, read_directory, unfit_page

HEIGHT, WIDTH = 24, 40
RNG = np.random.default_rng(2)
PAGES = RNG.integers(0, 65536, (3, HEIGHT, WIDTH, 3)).astype(np.uint16)
SMALL = (PAGES[0] >> 8).astype(np.uint8)


def written(folder, data, name="stack.tif"):
    (folder / name).write_bytes(data)
    return folder / name


@pytest.mark.parametrize(
    "options", [{}, {"byteorder": ">"}, {"bigtiff": True}, {"compression": "deflate"}, {"tile": (16, 16)}]
)
def test_each_page_is_a_frame(tmp_path, options):
    path = written(tmp_path, tiff(*PAGES, **options))
    assert is_footage(path)
    source = open_footage(path)
    assert len(source) == 3
    for number in (2, 0, 1):
        (frame,) = source.frames(number, number + 1)
        assert frame.number == number
        np.testing.assert_array_equal(frame.planes[0], PAGES[number])


@pytest.mark.parametrize(
    ("most", "level", "bits"),
    [(4095, 4095, 12), (16383, 16000, 14), (1023, 1000, 10), (16383, 16384, None), (9, 9, 12)],
)
def test_its_largest_level_names_how_many_bits_a_camera_may_have(tmp_path, most, level, bits):
    """Where no level is above it: it is no full scale, and so nothing is scaled by it."""
    picture = PAGES[0] >> 7
    picture[0, 0] = level
    path = written(tmp_path, tiff((picture, {"extratags": [(281, "H", 3, (most,) * 3, True)]})))
    source = open_footage(path)
    assert source.format.bits == 16
    ends = f"is above {2 ** (bits or 0) - 1}: if the camera gives {bits}, add --bits {bits}"
    assert source.notes == () if bits is None else source.notes[0].endswith(ends)


def test_smaller_versions_and_masks_are_no_frames(tmp_path):
    small = (PAGES[0, ::4, ::4], {"subfiletype": 1})
    mask = (PAGES[0, ..., 0] > 9, {"subfiletype": 4, "photometric": "minisblack"})
    for pages in ((PAGES[0], small), (small, PAGES[0]), (small, PAGES[0], mask)):
        path = written(tmp_path, tiff(*pages))
        assert not is_footage(path)
        (frame,) = open_footage(path).frames()
        np.testing.assert_array_equal(frame.planes[0], PAGES[0])
        np.testing.assert_array_equal(read_image(path), PAGES[0])


def test_where_one_picture_is_wanted_pages_are_named(tmp_path):
    path = written(tmp_path, tiff(*PAGES))
    with pytest.raises(FootageError, match=r"stack\.tif has 3 pages: save each as a file of its own"):
        read_image(path)
    written(tmp_path, tiff(PAGES[0]), "a.tif")
    single, stack = open_footage(tmp_path).frames()
    assert isinstance(single, StoredFrame)
    assert isinstance(stack, BadFrame) and "has 3 pages" in stack.reason


def test_a_stack_that_was_cut_off(tmp_path):
    """By the values of its last page, or before that page's directory."""
    data = tiff(*PAGES)
    last = open_footage(written(tmp_path, data[: -PAGES[2].nbytes // 2])).frames(2)
    assert "page 3 of" in next(last).reason
    with pytest.raises(FootageError, match=r"stack\.tif is truncated or damaged: copy it again"):
        open_footage(written(tmp_path, data[: page_places(data)[2] + 10]))


def test_pages_in_a_circle():
    data = bytearray(tiff(*PAGES[:2]))
    first, second = page_places(bytes(data))
    (n_entries,) = struct.unpack_from("<H", data, second)
    struct.pack_into("<I", data, second + 2 + 12 * n_entries, first)
    assert page_places(bytes(data)) == [first, second]


@pytest.mark.parametrize("place", [8, 10**6, 2**63 + 5])
def test_a_directory_behind_the_end(tmp_path, place):
    data = bytearray(tiff(SMALL, bigtiff=True))
    struct.pack_into("<Q", data, 8, place if place > 8 else len(data) - 4)
    with pytest.raises(FootageError, match="is truncated or damaged: copy it again"):
        open_footage(written(tmp_path, data))


def test_pages_that_imagej_does_not_list(tmp_path):
    """As in its files of more than 4 GB."""
    words = "ImageJ=1.54f\nimages=300\nslices=300\n"
    for name, description in (("a.tif", words), ("b.tif", "images=300")):
        written(tmp_path, tiff((SMALL, {"description": description})), name)
    with pytest.raises(FootageError, match=r"a\.tif is a stack by ImageJ, 299 of whose pages are not listed"):
        open_footage(tmp_path / "a.tif")
    assert len(open_footage(tmp_path / "b.tif")) == 1


@pytest.mark.parametrize("levels", [SMALL, PAGES[0]])
@pytest.mark.parametrize("alpha", ["unassalpha", "assocalpha", "unspecified"])
def test_colours_are_not_multiplied_by_their_transparency(tmp_path, levels, alpha):
    ramp = np.linspace(0, np.iinfo(levels.dtype).max, WIDTH).astype(levels.dtype)
    four = np.dstack([levels, np.tile(ramp, (HEIGHT, 1))])
    source = open_footage(written(tmp_path, tiff((four, {"extrasamples": [alpha]}))))
    (frame,) = source.frames()
    np.testing.assert_array_equal(frame.planes[0], levels)
    assert "it is transparent in parts" in source.notes[0]


@pytest.mark.parametrize("bits", [10, 12, 14])
def test_bits_that_are_packed(tmp_path, bits):
    levels = PAGES[0] >> (16 - bits)
    (frame,) = open_footage(written(tmp_path, packed_tiff(levels, bits))).frames()
    assert (frame.format.bits, frame.format.shift) == (bits, 16 - bits)
    np.testing.assert_array_equal(frame.planes[0] >> (16 - bits), levels)


def marked(**values):
    """Return why a page is refused whose tags are these; all it lacks is as usual."""
    tags = {"bits": 258, "compression": 259, "colors": 262, "samples": 277, "planar": 284, "dng": 50706} | {
        "format": 339
    }
    usual = {"bits": 8, "compression": 1, "colors": 2, "samples": 3, "planar": 1, "format": 1}
    entries = sorted((tags[name], 3, 1, value) for name, value in (usual | values).items())
    data = b"II*\0" + struct.pack("<IH", 8, len(entries)) + b"".join(struct.pack("<HHII", *each) for each in entries)
    return unfit_page(read_directory(data))


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({}, None),
        ({"colors": 1, "samples": 1, "bits": 12}, None),
        ({"bits": 32, "format": 3}, None),
        ({"colors": 0, "samples": 1}, "white is zero: invert it"),
        ({"colors": 3}, "stored with a palette"),
        ({"colors": 5, "samples": 4}, "it is in CMYK"),
        ({"colors": 6}, "stored as YCbCr"),
        ({"colors": 8}, "stored as CIELab"),
        ({"colors": 32803, "samples": 1}, "a camera's raw file"),
        ({"dng": 1}, "a camera's raw file"),
        ({"colors": 32845}, "3 channels, and says that they are of kind 32845"),
        ({"colors": 1}, "3 channels, and says that they are grey: save three, as RGB"),
        ({"samples": 5}, "5 channels, and says that they are RGB"),
        ({"compression": 50000}, "it is compressed by Zstandard, which is not read: save it with LZW"),
        ({"compression": 6}, "compressed by old JPEG"),
        ({"compression": 99}, "compressed by method 99"),
        ({"bits": 16, "format": 3}, "floating-point values of 16 bits"),
        ({"bits": 16, "format": 2}, "signed values of 16 bits"),
        ({"bits": 32}, "it holds values of 32 bits: save it with 8 or 16 bits"),
        ({"bits": 64, "format": 3}, "floating-point values of 64 bits"),
        ({"planar": 2}, None),
        ({"planar": 2, "bits": 16}, "stored one after another (planar configuration 2)"),
        ({"planar": 2, "bits": 16, "samples": 1, "colors": 1}, None),
    ],
)
def test_what_a_page_says_is_compared_with_what_is_decoded(values, reason):
    found = marked(**values)
    assert found is None if reason is None else reason in found


def test_planes_of_eight_bits_are_read(tmp_path):
    planes = np.moveaxis(SMALL, -1, 0)
    (frame,) = open_footage(written(tmp_path, tiff((planes, {"planarconfig": "separate"})))).frames()
    np.testing.assert_array_equal(frame.planes[0], SMALL)


@pytest.mark.parametrize("levels", [SMALL, PAGES[0]])
def test_damage_of_deflated_strips_is_told(tmp_path, levels):
    """Of 8 bits OpenCV makes black of it."""
    data = bytearray(tiff(levels, compression="deflate", rowsperstrip=8))
    data[-60:-20] = bytes(40)
    with pytest.raises(FootageError, match="is damaged: copy it again"):
        read_image(written(tmp_path, data))
    whole = tiff(levels, compression="deflate")
    with pytest.raises(FootageError, match="is damaged: copy it again"):
        read_image(written(tmp_path, whole[:-300] + bytes(300)))


def test_strips_behind_the_end_are_told(tmp_path):
    with pytest.raises(FootageError, match="is truncated: copy it again"):
        read_image(written(tmp_path, tiff(SMALL)[:-100]))


def test_a_tiff_of_opencv_is_read(tmp_path):
    written(tmp_path, cv2.imencode(".tif", PAGES[0][..., ::-1])[1].tobytes())
    np.testing.assert_array_equal(read_image(tmp_path / "stack.tif"), PAGES[0])
