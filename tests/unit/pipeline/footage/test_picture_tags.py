"""What pictures as people bring them say of themselves, their size first."""

import io
import struct
import zlib

import cv2
import numpy as np
import pytest
from PIL import Image, ImageCms, PngImagePlugin  # of matplotlib's own dependencies

from pipeline.footage.image_file import read_image
from pipeline.footage.opening import open_footage
from pipeline.footage.picture_tags import CMYK, PictureTags, picture_size, read_tags, unfit_colors
from tikernels import runtime
from tikernels.raw.development import develop

ORIENTATION, COLOR_SPACE, EXIF = 274, 40961, 34665
HEIGHT, WIDTH = 48, 64


def picture(seed=1):
    """Return colours that change slowly, which JPEG keeps, and differ in every corner."""
    corners = np.random.default_rng(seed).integers(30, 220, (3, 4, 3)).astype(np.uint8)
    return cv2.resize(corners, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)


def saved(kind, **options):
    file = io.BytesIO()
    Image.fromarray(picture()).save(file, kind, **options)
    return file.getvalue()


def exif(orientation=1, color_space=None):
    tags = Image.Exif()
    tags[ORIENTATION] = orientation
    if color_space is not None:
        tags.get_ifd(EXIF)[COLOR_SPACE] = color_space
    return tags


def profile(name):
    return ImageCms.ImageCmsProfile(ImageCms.createProfile(name)).tobytes()


def stored(shown, orientation):
    """Return the levels that, turned as Exif says, are these."""
    turn = {
        2: "FLIP_LEFT_RIGHT",
        3: "ROTATE_180",
        4: "FLIP_TOP_BOTTOM",
        5: "TRANSPOSE",
        6: "ROTATE_90",
        7: "TRANSVERSE",
    }
    turn[8] = "ROTATE_270"
    return Image.fromarray(shown).transpose(getattr(Image.Transpose, turn[orientation])) if orientation > 1 else shown


def with_xmp(kind, orientation_there, **options):
    """Return a file whose XMP has an orientation, written as attribute or as element."""
    words = f'tiff:Orientation="{orientation_there}"'
    if orientation_there % 2:
        words = f"><tiff:Orientation>{orientation_there}</tiff:Orientation"
    xmp = f'<rdf:Description xmlns:tiff="http://ns.adobe.com/tiff/1.0/" {words}/>'
    if kind == "PNG":
        options["pnginfo"] = PngImagePlugin.PngInfo()
        options["pnginfo"].add_itxt("Software", "any")
        options["pnginfo"].add_itxt("XML:com.adobe.xmp", xmp)
    elif kind == "TIFF":
        options["tiffinfo"] = {700: xmp.encode()}
    else:
        options["xmp"] = xmp.encode()
    return saved(kind, **options)


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "TIFF", "WEBP"])
def test_xmp_says_how_the_camera_was_held_where_exif_does_not(kind):
    for orientation in (1, 3, 6):
        assert read_tags(with_xmp(kind, orientation)).orientation == orientation
    for nonsense in (0, 9):
        assert read_tags(with_xmp(kind, nonsense)).orientation == 1
    assert read_tags(saved(kind)).orientation == 1
    if kind != "TIFF":  # whose Exif orientation is its own
        assert read_tags(with_xmp(kind, 6, exif=exif(1))).orientation == 1
        assert read_tags(with_xmp(kind, 6, exif=exif(8))).orientation == 8


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "TIFF", "WEBP"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_pictures_are_turned_as_the_camera_was_held(tmp_path, cpu, kind, orientation):
    path = tmp_path / f"a.{kind.lower()}"
    shown = picture()
    lossless = {"WEBP": {"lossless": True}, "JPEG": {"quality": 98, "subsampling": "4:2:2"}}.get(kind, {})
    Image.fromarray(np.asarray(stored(shown, orientation))).save(path, kind, exif=exif(orientation), **lossless)
    assert read_tags(path.read_bytes()).orientation == orientation
    error = 12 if kind == "JPEG" else 0
    read = read_image(path)
    assert read.shape == shown.shape
    assert np.abs(read.astype(int) - shown).max() <= error
    source = open_footage(path)
    (frame,) = source.frames()
    assert source.size_px == (WIDTH, HEIGHT)
    developed = runtime.to_host(develop(frame.planes, frame.format))
    scale = 255 if developed.dtype == np.float32 else 1
    assert np.abs(scale * developed.astype(float) - shown).max() <= error


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("size", [(48, 64), (49, 65)])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_mosaics_are_turned_with_their_pattern(tmp_path, orientation, size, suffix):
    """Every pixel keeps its colour, also where sides are odd."""
    levels = {"r": 200, "g": 120, "b": 60}
    taken = np.tile(np.array([[levels[color] for color in row] for row in ("rg", "gb")], np.uint8), (25, 33))
    Image.fromarray(taken[: size[0], : size[1]]).save(tmp_path / f"a{suffix}", exif=exif(orientation))
    source = open_footage(tmp_path / f"a{suffix}", bayer="rggb")
    (frame,) = source.frames()
    mosaic = np.array([levels[color] for color in frame.format.bayer]).reshape(2, 2)
    height, width = frame.planes[0].shape
    np.testing.assert_array_equal(frame.planes[0], np.tile(mosaic, (33, 33))[:height, :width])


def test_a_jpeg_is_srgb_and_a_png_is_not():
    assert read_tags(saved("JPEG")) == PictureTags(1, "srgb", "a JPEG that says nothing else is sRGB")
    assert read_tags(saved("WEBP")).transfer == "srgb"
    for kind in ("PNG", "TIFF", "BMP", "PPM"):
        assert read_tags(saved(kind)).transfer is None


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "TIFF", "WEBP"])
def test_profiles(kind):
    tags = read_tags(saved(kind, icc_profile=profile("sRGB")))
    assert (tags.transfer, tags.because) == ("srgb", "its colour profile says so")
    damaged = read_tags(saved(kind, icc_profile=profile("sRGB")[:150]))
    assert damaged.transfer == ("srgb" if kind in ("JPEG", "WEBP") else None)


def curve(kind, *numbers, count=None):
    if kind == "curv":
        body = b"curv\0\0\0\0" + len(numbers).to_bytes(4, "big") + np.array(numbers, ">u2").tobytes()
    else:
        body = (
            b"para\0\0\0\0"
            + count.to_bytes(2, "big")
            + b"\0\0"
            + np.rint(65536 * np.array(numbers)).astype(">i4").tobytes()
        )
    head = bytes(128) + (1).to_bytes(4, "big")
    return head + b"rTRC" + (144).to_bytes(4, "big") + len(body).to_bytes(4, "big") + body


@pytest.mark.parametrize(
    ("trc", "transfer"),
    [
        (curve("curv"), "linear"),
        (curve("curv", 256), "linear"),
        (curve("curv", 563), "srgb"),  # AdobeRGB: a gamma of 2.2
        (curve("curv", 461), None),  # ProPhoto: 1.8
        (curve("curv", *np.rint(65535 * np.linspace(0, 1, 50))), "linear"),
        (curve("para", 2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045, count=3), "srgb"),
        (curve("para", 1 / 0.45, 1 / 1.099, 0.099 / 1.099, 1 / 4.5, 0.081, count=3), "bt709"),
        (curve("para", 1.0, count=0), "linear"),
    ],
)
def test_curves_of_profiles(trc, transfer):
    tags = read_tags(saved("PNG", icc_profile=trc))
    assert tags.transfer == transfer
    assert (transfer is None) == ("which is another curve" in tags.because)


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "TIFF", "WEBP", "BMP", "PPM"])
def test_true_colours_are_fit(kind):
    assert unfit_colors(saved(kind)) is None


def converted(kind, mode, **options):
    file = io.BytesIO()
    Image.fromarray(picture()).convert(mode).save(file, kind, **options)
    return file.getvalue()


def test_other_colours_are_not():
    for kind in ("PNG", "TIFF", "BMP"):
        assert "stored with a palette" in unfit_colors(converted(kind, "P"))
    assert unfit_colors(converted("TIFF", "CMYK")) == unfit_colors(converted("JPEG", "CMYK")) == CMYK
    assert "it is grey with transparency" in unfit_colors(converted("PNG", "LA"))
    moving = converted("PNG", "RGB", save_all=True, append_images=[Image.new("RGB", (WIDTH, HEIGHT))])
    assert "it is an animation" in unfit_colors(moving)
    moving = converted("WEBP", "RGB", save_all=True, append_images=[Image.new("RGB", (WIDTH, HEIGHT))])
    assert "it is an animation" in unfit_colors(moving)
    for cut in range(0, 60):
        assert unfit_colors(moving[:cut]) in (None, unfit_colors(moving))


def bmp(bits, layout=0, masks=()):
    head = struct.pack("<IiiHHI", 40, WIDTH, HEIGHT, 1, bits, layout) + bytes(20)
    return (
        b"BM" + struct.pack("<III", 0, 0, 54) + head + b"".join(struct.pack("<I", mask) for mask in masks) + bytes(12)
    )


def test_layouts_of_bmp():
    assert unfit_colors(bmp(24)) is unfit_colors(bmp(32, 3, (0xFF0000, 0xFF00, 0xFF))) is None
    assert "16 bits a pixel, too few" in unfit_colors(bmp(16))
    for other in (bmp(32, 3, (0xFF, 0xFF00, 0xFF0000)), bmp(32, 3, (0x3FF00000, 0xFFC00, 0x3FF)), bmp(64), bmp(24, 4)):
        assert "laid out in a way that is not read" in unfit_colors(other)


@pytest.mark.parametrize(
    ("head", "reason"),
    [
        (b"P6 2 2 255\n", None),
        (b"P5 2 2 4095\n", None),
        (b"P6 2 2 65535\n", None),
        (b"P4 2 2\n", None),
        (b"P6 2 2 100\n", "its levels end at 100: save it with levels up to 255 or 65535"),
        (b"P6 2 2 1000\n", "its levels end at 1000"),
        (b"P3\n# note\n2 2\n255\n", "its levels are written as text"),
    ],
)
def test_levels_of_pnm(head, reason):
    found = unfit_colors(head + bytes(24))
    assert found is None if reason is None else reason in found


def test_a_jpeg_of_several_pictures_is_told():
    more = {"save_all": True, "append_images": 2 * [Image.new("RGB", (WIDTH, HEIGHT))]}
    assert read_tags(saved("MPO", **more)).notes == ("it holds 3 pictures, of which the first is read",)
    assert read_tags(saved("JPEG")).notes == ()


def with_chunk(kind, content):
    data = saved("PNG")
    chunk = struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
    return data[:33] + chunk + data[33:]


@pytest.mark.parametrize(
    ("kind", "content", "said"),
    [
        (b"gAMA", struct.pack(">I", 60000), "it is marked with a gamma of 0.6, which is another curve than"),
        (b"cICP", bytes([9, 16, 0, 1]), "it is marked so (cICP): PQ, which is another curve than"),
        (b"cICP", bytes([9, 18, 0, 1]), "it is marked so (cICP): HLG, which is another curve than"),
    ],
)
def test_other_curves_are_noted(kind, content, said):
    tags = read_tags(with_chunk(kind, content))
    assert tags.transfer is None and said in tags.because
    assert tags.notes == (tags.because,)


def test_a_bmp_says_srgb_and_a_tiff_its_curve():
    head = b"BM" + bytes(12) + struct.pack("<I", 108) + bytes(52) + b"BGRs" + bytes(60)
    assert read_tags(head).because == "it is marked as sRGB"
    curve = np.rint(65535 * np.linspace(0, 1, 256) ** 2.2).astype(int).tolist()
    marked = saved("TIFF", tiffinfo={301: tuple(curve)})
    assert read_tags(marked).because == "its transfer function says so"


def test_exif_says_srgb():
    assert read_tags(saved("PNG", exif=exif(color_space=1))).because == "its Exif data say sRGB"
    assert read_tags(saved("PNG", exif=exif(color_space=0xFFFF))).transfer is None


def test_nonsense_says_nothing():
    whole = saved("JPEG", exif=exif(6), icc_profile=profile("sRGB"))
    rng = np.random.default_rng(0)
    for _ in range(300):
        damaged = bytearray(whole)
        for place in rng.integers(2, min(len(whole), 900), 6):
            damaged[place] = rng.integers(256)
        assert 1 <= read_tags(bytes(damaged)).orientation <= 8
    assert read_tags(b"") == read_tags(b"nonsense") == PictureTags()


WIDE, HIGH = 300, 70


@pytest.mark.parametrize(
    ("suffix", "dtype"),
    [
        *((suffix, np.uint8) for suffix in (".png", ".jpg", ".tif", ".bmp", ".ppm", ".pgm", ".webp")),
        *((suffix, np.uint16) for suffix in (".png", ".tif", ".ppm")),
        (".tif", np.float32),
    ],
)
def test_heads_say_what_is_decoded(suffix, dtype):
    levels = np.random.default_rng(0).integers(0, 255, (HIGH, WIDE) if suffix == ".pgm" else (HIGH, WIDE, 3))
    data = cv2.imencode(suffix, levels.astype(dtype))[1].tobytes()
    assert picture_size(data) == (WIDE, HIGH)


@pytest.mark.parametrize("quality", [80, 101])
def test_webp_of_both_kinds(quality):
    image = np.random.default_rng(0).integers(0, 255, (HIGH, WIDE, 3), np.uint8)
    data = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, quality])[1].tobytes()
    assert picture_size(data) == (WIDE, HIGH)
    extended = b"RIFF\0\0\0\0WEBPVP8X" + struct.pack("<IBxxxHBHB", 10, 0, WIDE - 1, 0, HIGH - 1, 0)
    assert picture_size(extended) == (WIDE, HIGH)


def test_progressive_jpeg_and_what_stands_before_its_frame():
    image = np.random.default_rng(0).integers(0, 255, (HIGH, WIDE, 3), np.uint8)
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    filled = data[:2] + b"\xff\xfe\x00\x06note\xff\xff" + data[3:]  # a comment, and a byte that fills up
    assert picture_size(data) == picture_size(filled) == (WIDE, HIGH)


@pytest.mark.parametrize("order", ["<", ">"])
def test_tiff_of_both_byte_orders_and_sizes(order):
    mark = b"II" if order == "<" else b"MM"
    entries = struct.pack(order + "HHIHxxHHII", 256, 3, 1, WIDE, 257, 4, 1, HIGH)
    assert picture_size(mark + struct.pack(order + "HIH", 42, 8, 2) + entries) == (WIDE, HIGH)
    entries = struct.pack(order + "HHQQHHQQ", 256, 16, 1, WIDE, 257, 16, 1, HIGH)
    assert picture_size(mark + struct.pack(order + "HHHQQ", 43, 8, 0, 16, 2) + entries) == (WIDE, HIGH)


def test_bmp_of_os_2_and_from_top_to_bottom():
    head = b"BM" + bytes(12)
    assert picture_size(head + struct.pack("<IHH", 12, WIDE, HIGH)) == (WIDE, HIGH)
    assert picture_size(head + struct.pack("<Iii", 40, WIDE, -HIGH)) == (WIDE, HIGH)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".bmp", ".ppm", ".webp"])
def test_heads_that_are_cut_off(suffix):
    data = cv2.imencode(suffix, np.zeros((HIGH, WIDE, 3), np.uint8))[1].tobytes()
    for length in range(min(len(data), 200)):
        assert picture_size(data[:length]) in (None, (WIDE, HIGH))
    assert picture_size(b"no picture") is None
