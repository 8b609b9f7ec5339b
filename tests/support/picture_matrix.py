"""Picture files of every format, as other programs write them, of one picture: what each holds, or is refused for."""

import io
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
import reference
from PIL import Image, ImageCms
from support.tiff_samples import packed_tiff, tiff

from tikernels.raw.linearization import linear_values
from tikernels.raw.pixel_format import PixelFormat

SIZE_PX = WIDTH, HEIGHT = 320, 240


@dataclass(frozen=True)
class Levels:
    """The picture that all files are made of, in the forms in which they hold it."""

    light: np.ndarray  # (H, W, 3), 0..1, linear
    eight: np.ndarray
    sixteen: np.ndarray
    twelve: np.ndarray
    floats: np.ndarray
    srgb: np.ndarray  # of 8 bits, encoded
    bt709: np.ndarray


def encoded(light, transfer):
    """Return the levels of 8 bits of light that is encoded."""
    grid = np.linspace(0, 1, 4096)
    return np.rint(255 * np.interp(light, linear_values(grid, transfer), grid)).astype(np.uint8)


def of_mosaic(image):
    """Return what a camera with a mosaic of R, G, G, B sees of levels."""
    row, column = np.indices(image.shape[:2])
    return np.take_along_axis(image, (row % 2 + column % 2)[..., None], axis=2)[..., 0]


def yuv(image, across, down):
    """Return full-range BT.601 planes, chroma the mean of its pixels."""
    luma, red, blue = np.moveaxis(cv2.cvtColor(image, cv2.COLOR_RGB2YCrCb), -1, 0)

    def mean(plane):
        cells = plane.reshape(HEIGHT // down, down, WIDTH // across, across).astype(np.float64)
        return np.rint(cells.mean(axis=(1, 3))).astype(np.uint8)

    return luma, mean(blue), mean(red)


def levels_of(light):
    """Return a picture's levels."""
    return Levels(
        light,
        *(np.rint((2**bits - 1) * light).astype(np.uint8 if bits == 8 else np.uint16) for bits in (8, 16, 12)),
        light.astype(np.float32),
        encoded(light, "srgb"),
        encoded(light, "bt709"),
    )


def plain(name, bits=8, transfer="linear"):
    """Return what the decoder is given directly: RGB levels."""
    return lambda levels: ((getattr(levels, name),), PixelFormat("rgb", bits), transfer)


def planes(across, down):
    format = PixelFormat("yuv", 8, subsampling=(across, down), siting="centre", matrix="bt601", full_range=True)
    return lambda levels: (yuv(levels.srgb, across, down), format, "srgb")


def mosaic(name, bits):
    return lambda levels: ((of_mosaic(getattr(levels, name)),), PixelFormat("bayer", bits), "linear")


EIGHT, SIXTEEN, FLOATS, SRGB = plain("eight"), plain("sixteen", 16), plain("floats", 32), plain("srgb", 8, "srgb")


@dataclass(frozen=True)
class File:
    """A file, and what is to become of it."""

    make: Callable[[Levels], bytes]
    wanted: Callable[[Levels], tuple[Any, ...]] | str  # its planes, their format and transfer, or why it is refused
    says: dict[str, Any] = field(default_factory=dict)
    note: str | None = None
    n_frames: int = 1
    lossy: bool = False  # the decoder gets what PyAV takes out of it


def pil(image, kind, **options):
    file = io.BytesIO()
    (image if isinstance(image, Image.Image) else Image.fromarray(np.ascontiguousarray(image))).save(
        file, kind, **options
    )
    return file.getvalue()


def by_opencv(image, suffix, *options):
    return cv2.imencode(suffix, np.ascontiguousarray(image[..., [2, 1, 0, 3][: image.shape[2]]]), options)[1].tobytes()


def converted(kind, mode, **options):
    return lambda levels: pil(Image.fromarray(levels.eight).convert(mode), kind, **options)


def profile(gamma):
    if gamma is None:
        return ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    curve = b"curv\0\0\0\0\0\0\0\1" + round(256 * gamma).to_bytes(2, "big") + b"\0\0"
    head = bytes(128) + (1).to_bytes(4, "big") + b"rTRC" + (144).to_bytes(4, "big")
    return head + len(curve).to_bytes(4, "big") + curve


def with_alpha(image):
    ramp = np.linspace(0, np.iinfo(image.dtype).max, WIDTH).astype(image.dtype)
    return np.dstack([image, np.tile(ramp, (HEIGHT, 1))])


def png(image, *chunks):
    """Return a PNG with more chunks."""
    data = by_opencv(image, ".png")
    more = (struct.pack(">I", len(text)) + kind + text for kind, text in chunks)
    return data[:33] + b"".join(each + struct.pack(">I", zlib.crc32(each[4:])) for each in more) + data[33:]


def jpeg(image, **options):
    return pil(image, "JPEG", **{"quality": 100, "subsampling": "4:4:4", **options})


def jpeg_frame(data, place, value):
    """Return a JPEG whose frame's head says otherwise."""
    at = data.index(b"\xff\xc0") + place
    return data[:at] + bytes([value]) + data[at + 1 :]


def bmp(image, bits, layout=0, masks=(), *, down=False, most=None):
    """Return a BMP of rows of bytes."""
    rows = image if down else image[::-1]
    body = rows.tobytes() if most is None else rows.tobytes()[:most]
    head = struct.pack("<IiiHHI", 40, WIDTH, -HEIGHT if down else HEIGHT, 1, bits, layout) + bytes(20)
    masked = b"".join(struct.pack("<I", mask) for mask in masks)
    return b"BM" + struct.pack("<III", 0, 0, 54 + len(masked)) + head + masked + body


def five_bits(levels):
    red, green, blue = np.moveaxis(levels.eight.astype(np.uint16) >> 3, -1, 0)
    return (red << 11 | green << 6 | blue).astype("<u2")


def four_bytes(levels, order):
    return np.dstack([levels.eight[..., list(order)], levels.eight[..., 0] * 0])


def pnm(levels, most=255, kind=6, note=""):
    body = levels.astype(">u2" if most > 255 else np.uint8).tobytes()
    return f"P{kind}\n{note}{WIDTH} {HEIGHT}\n{most}\n".encode() + body


def heic(image, **options):
    import pillow_heif

    file = io.BytesIO()
    pillow_heif.from_pillow(Image.fromarray(image)).save(file, quality=-1, **options)
    return file.getvalue()


def of_bits(levels, bits):
    return np.rint((2**bits - 1) * levels.light).astype(np.uint16)


def packed(bits):
    return lambda levels: ((of_bits(levels, bits),), PixelFormat("rgb", bits), "linear")


MOTION, ZEROS = b"MotionPhoto_Data" + bytes(range(256)) * 40, bytes(20000)
CUT, DAMAGED = "is truncated: copy it again", "is damaged: copy it again"
GREY, RAW = "it is grey, but the phase is in the colours", "it is a camera's raw file"
ALPHA = "it is transparent in parts, which is not used"
TURNED = Image.Exif()
TURNED[274] = 6
SAVE_ALL = {"save_all": True, "append_images": [Image.new("RGB", SIZE_PX)] * 2}

FILES = {
    # PNG
    "rgb 8.png": File(lambda f: pil(f.eight, "PNG"), EIGHT),
    "rgb 16.png": File(lambda f: by_opencv(f.sixteen, ".png"), SIXTEEN),
    "uncompressed.png": File(lambda f: pil(f.eight, "PNG", compress_level=0), EIGHT),
    "alpha 8.png": File(lambda f: pil(with_alpha(f.eight), "PNG"), EIGHT, note=ALPHA),
    "alpha 16.png": File(lambda f: by_opencv(with_alpha(f.sixteen), ".png"), SIXTEEN, note=ALPHA),
    "one colour transparent.png": File(lambda f: png(f.sixteen, (b"tRNS", bytes(6))), SIXTEEN),
    "12 in 16.png": File(lambda f: by_opencv(f.twelve, ".png"), packed(12), {"bits": 12}),
    "significant bits.png": File(lambda f: png(f.sixteen, (b"sBIT", bytes([12, 12, 12]))), SIXTEEN),
    "gAMA.png": File(lambda f: png(f.srgb, (b"gAMA", struct.pack(">I", 45455))), SRGB),
    "sRGB.png": File(lambda f: png(f.srgb, (b"sRGB", b"\0")), SRGB),
    "cICP.png": File(lambda f: png(f.srgb, (b"cICP", bytes([1, 13, 0, 1]))), SRGB),
    "cICP bt709.png": File(
        lambda f: png(f.bt709, (b"cICP", bytes([1, 1, 0, 1]))),
        plain("bt709", 8, "bt709"),
    ),
    "profile.png": File(lambda f: pil(f.srgb, "PNG", icc_profile=profile(None)), SRGB),
    "linear profile.png": File(lambda f: pil(f.eight, "PNG", icc_profile=profile(1.0)), EIGHT),
    "other gamma.png": File(lambda f: png(f.eight, (b"gAMA", struct.pack(">I", 60000))), EIGHT, note="set transfer"),
    "PQ.png": File(lambda f: png(f.eight, (b"cICP", bytes([9, 16, 0, 1]))), EIGHT, note="(cICP): PQ, which is"),
    "tail.png": File(lambda f: pil(f.eight, "PNG") + MOTION, EIGHT),
    "zeros.png": File(lambda f: pil(f.eight, "PNG") + ZEROS, EIGHT),
    "mosaic.png": File(lambda f: pil(of_mosaic(f.sixteen), "PNG"), mosaic("sixteen", 16), {"bayer": "rggb"}),
    "cut.png": File(lambda f: pil(f.eight, "PNG")[:-500], CUT),
    "cut, zeros.png": File(lambda f: pil(f.eight, "PNG")[:-500] + ZEROS, CUT),
    "palette.png": File(converted("PNG", "P"), "it is stored with a palette"),
    "grey.png": File(converted("PNG", "L"), GREY),
    "grey and alpha.png": File(converted("PNG", "LA"), "it is grey with transparency"),
    "black and white.png": File(converted("PNG", "1"), GREY),
    "animation.png": File(lambda f: pil(f.eight, "PNG", **SAVE_ALL), "it is an animation"),
    # JPEG
    "4:4:4.jpg": File(lambda f: jpeg(f.srgb), planes(1, 1)),
    "4:2:2.jpg": File(lambda f: jpeg(f.srgb, subsampling="4:2:2"), planes(2, 1), lossy=True),
    "4:2:0.jpg": File(lambda f: jpeg(f.srgb, subsampling="4:2:0"), planes(2, 2), lossy=True),
    "4:4:0.jpg": File(
        lambda f: by_opencv(f.srgb, ".jpg", cv2.IMWRITE_JPEG_QUALITY, 100, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, 0x121111),
        planes(1, 2),
    ),
    "RGB (Adobe marker).jpg": File(lambda f: jpeg(f.srgb, keep_rgb=True), SRGB),
    "progressive.jpg": File(lambda f: jpeg(f.srgb, progressive=True), planes(1, 1)),
    "restarts.jpg": File(lambda f: jpeg(f.srgb, restart_marker_rows=1), planes(1, 1)),
    "sRGB profile.jpg": File(lambda f: jpeg(f.srgb, icc_profile=profile(None)), planes(1, 1)),
    "several pictures.jpg": File(
        lambda f: pil(f.srgb, "MPO", quality=100, subsampling="4:4:4", **SAVE_ALL),
        planes(1, 1),
        note="it holds 3 pictures, of which the first is read",
    ),
    "motion photo.jpg": File(lambda f: jpeg(f.srgb) + MOTION, planes(1, 1)),
    "padded buffer.jpg": File(lambda f: jpeg(f.srgb) + ZEROS, planes(1, 1)),
    "another one behind.jpg": File(lambda f: jpeg(f.srgb) + jpeg(f.srgb), planes(1, 1)),
    "cut.jpg": File(lambda f: jpeg(f.srgb)[:-500], CUT),
    "cut, zeros.jpg": File(lambda f: jpeg(f.srgb)[:-500] + ZEROS, CUT),
    "cut, another one.jpg": File(lambda f: jpeg(f.srgb)[:-500] + jpeg(f.srgb), CUT),
    "grey.jpg": File(converted("JPEG", "L"), GREY),
    "CMYK.jpg": File(converted("JPEG", "CMYK"), "it is in CMYK"),
    "arithmetic.jpg": File(lambda f: jpeg_frame(jpeg(f.srgb), 1, 0xC9), "a JPEG with arithmetic coding"),
    "12 bits.jpg": File(lambda f: jpeg_frame(jpeg(f.srgb), 4, 12), "a JPEG of 12 bits"),
    "chroma 3x1.jpg": File(lambda f: jpeg_frame(jpeg(f.srgb), 11, 0x31), "sampled in a way that is not read"),
    # TIFF
    **{
        f"{name} {order}.tif": File(
            lambda f, key=key, order=order: tiff(getattr(f, key), byteorder="<" if order == "little" else ">"), wanted
        )
        for name, key, wanted in (("8", "eight", EIGHT), ("16", "sixteen", SIXTEEN), ("float", "floats", FLOATS))
        for order in ("little", "big")
    },
    **{
        f"{method}.tif": File(lambda f, method=method: pil(f.eight, "TIFF", compression=method), EIGHT)
        for method in ("tiff_lzw", "tiff_adobe_deflate", "packbits")
    },
    "jpeg in it.tif": File(lambda f: pil(f.eight, "TIFF", compression="jpeg", quality=100), EIGHT),
    "lzw 16.tif": File(lambda f: by_opencv(f.sixteen, ".tif", cv2.IMWRITE_TIFF_COMPRESSION, 5), SIXTEEN),
    "deflate, predictor.tif": File(lambda f: tiff(f.sixteen, compression="deflate", predictor=True), SIXTEEN),
    "tiles 8.tif": File(lambda f: tiff(f.eight, tile=(64, 64)), EIGHT),
    "tiles 16.tif": File(lambda f: tiff(f.sixteen, tile=(64, 64), compression="deflate"), SIXTEEN),
    "strips.tif": File(lambda f: tiff(f.sixteen, rowsperstrip=7), SIXTEEN),
    "big.tif": File(lambda f: tiff(f.sixteen, bigtiff=True), SIXTEEN),
    "planes 8.tif": File(lambda f: tiff(np.moveaxis(f.eight, -1, 0), planarconfig="separate"), EIGHT),
    **{
        f"packed {bits}.tif": File(lambda f, bits=bits: packed_tiff(of_bits(f, bits), bits), packed(bits))
        for bits in (10, 12, 14)
    },
    **{
        f"{kind} {bits}.tif": File(
            lambda f, kind=kind, key=key: tiff(with_alpha(getattr(f, key)), extrasamples=[kind]), wanted, note=ALPHA
        )
        for kind in ("unassalpha", "assocalpha", "unspecified")
        for bits, key, wanted in ((8, "eight", EIGHT), (16, "sixteen", SIXTEEN))
    },
    "stack.tif": File(lambda f: tiff(f.sixteen, f.sixteen, f.sixteen), SIXTEEN, n_frames=3),
    "stack, deflate.tif": File(lambda f: tiff(f.eight, f.eight, compression="deflate"), EIGHT, n_frames=2),
    "small one before.tif": File(lambda f: tiff((f.eight[::4, ::4], {"subfiletype": 1}), f.eight), EIGHT),
    "small one behind.tif": File(lambda f: tiff(f.eight, (f.eight[::4, ::4], {"subfiletype": 1})), EIGHT),
    "profile.tif": File(lambda f: pil(f.srgb, "TIFF", icc_profile=profile(None)), SRGB),
    "transfer function.tif": File(
        lambda f: tiff(
            f.srgb,
            extratags=[
                (301, 3, 256, np.rint(65535 * linear_values(np.linspace(0, 1, 256), "srgb")).astype(int).tolist(), True)
            ],
        ),
        SRGB,
    ),
    "mosaic.tif": File(
        lambda f: tiff(of_mosaic(f.sixteen), photometric="minisblack"), mosaic("sixteen", 16), {"bayer": "rggb"}
    ),
    "tail.tif": File(lambda f: tiff(f.eight) + MOTION, EIGHT),
    "cut.tif": File(lambda f: tiff(f.eight)[:-5000], CUT),
    "deflate, cut, zeros.tif": File(lambda f: tiff(f.eight, compression="deflate")[:-5000] + bytes(5000), DAMAGED),
    "planes 16.tif": File(
        lambda f: tiff(np.moveaxis(f.sixteen, -1, 0), planarconfig="separate"), "stored one after another"
    ),
    **{
        f"{method}.tif": File(
            lambda f, method=method: pil(f.eight, "TIFF", compression=method), f"it is compressed by {name}"
        )
        for method, name in (("lzma", "LZMA"), ("zstd", "Zstandard"))
    },
    "YCbCr.tif": File(
        lambda f: tiff(
            cv2.cvtColor(f.srgb, cv2.COLOR_RGB2YCrCb)[..., [0, 2, 1]], photometric="ycbcr", subsampling=(1, 1)
        ),
        "stored as YCbCr",
    ),
    "Lab.tif": File(lambda f: tiff(f.eight, photometric="cielab"), "stored as CIELab"),
    "CMYK.tif": File(converted("TIFF", "CMYK"), "it is in CMYK"),
    "palette.tif": File(lambda f: pil(Image.fromarray(f.eight).quantize(64), "TIFF"), "stored with a palette"),
    "grey.tif": File(converted("TIFF", "L"), GREY),
    "three grey channels.tif": File(
        lambda f: tiff(f.sixteen, photometric="minisblack", planarconfig="contig"), "says that they are grey"
    ),
    "white is zero.tif": File(lambda f: tiff(f.eight[..., 0], photometric="miniswhite"), "white is zero"),
    "signed.tif": File(lambda f: tiff((f.sixteen >> 1).astype(np.int16)), "signed values of 16 bits"),
    "32 bits.tif": File(lambda f: tiff(f.sixteen.astype(np.uint32)), "values of 32 bits"),
    "half floats.tif": File(lambda f: tiff(f.floats.astype(np.float16)), "floating-point values of 16 bits"),
    "double floats.tif": File(lambda f: tiff(f.light), "floating-point values of 64 bits"),
    "five channels.tif": File(
        lambda f: tiff(np.dstack([f.eight, f.eight[..., :2]]), extrasamples=["unspecified"] * 2), "5 channels"
    ),
    "DNG.tif": File(lambda f: tiff(f.sixteen, extratags=[(50706, 1, 4, bytes([1, 4, 0, 0]), True)]), RAW),
    "CFA.tif": File(lambda f: tiff(of_mosaic(f.sixteen), photometric="cfa"), RAW),
    "raw.nef": File(lambda f: tiff(f.sixteen), RAW),
    # BMP
    "24.bmp": File(lambda f: pil(f.eight, "BMP"), EIGHT),
    "downwards.bmp": File(lambda f: bmp(f.eight[..., ::-1], 24, down=True), EIGHT),
    "32.bmp": File(lambda f: bmp(four_bytes(f, (2, 1, 0)), 32), EIGHT),
    "masks.bmp": File(lambda f: bmp(four_bytes(f, (2, 1, 0)), 32, 3, (0xFF0000, 0xFF00, 0xFF)), EIGHT),
    "tail.bmp": File(lambda f: pil(f.eight, "BMP") + MOTION, EIGHT),
    "cut.bmp": File(lambda f: pil(f.eight, "BMP")[:-5000], CUT),
    "red last.bmp": File(lambda f: bmp(four_bytes(f, (0, 1, 2)), 32, 3, (0xFF, 0xFF00, 0xFF0000)), "laid out in a way"),
    "five bits.bmp": File(lambda f: bmp(five_bits(f), 16, 3, (0xF800, 0x7C0, 0x1F)), "16 bits a pixel, too few"),
    "palette.bmp": File(converted("BMP", "P"), "stored with a palette"),
    # WebP
    "lossless.webp": File(lambda f: pil(f.srgb, "WEBP", lossless=True), SRGB),
    "alpha.webp": File(lambda f: pil(with_alpha(f.srgb), "WEBP", lossless=True, exact=True), SRGB, note=ALPHA),
    "tail.webp": File(lambda f: pil(f.srgb, "WEBP", lossless=True) + MOTION, SRGB),
    "cut.webp": File(lambda f: pil(f.srgb, "WEBP", lossless=True)[:-5000], CUT),
    "animation.webp": File(lambda f: pil(f.srgb, "WEBP", **SAVE_ALL), "it is an animation"),
    # PNM
    "8.ppm": File(lambda f: pnm(f.eight), EIGHT),
    "12.ppm": File(lambda f: pnm(f.twelve, 4095, note="# a camera\n"), packed(12)),
    "16.ppm": File(lambda f: pnm(f.sixteen, 65535), SIXTEEN),
    "mosaic.pgm": File(lambda f: pnm(of_mosaic(f.twelve), 4095, 5), mosaic("twelve", 12), {"bayer": "rggb"}),
    "tail.ppm": File(lambda f: pnm(f.eight) + MOTION, EIGHT),
    "cut.ppm": File(lambda f: pnm(f.eight)[:-5000], CUT),
    "odd scale.ppm": File(lambda f: pnm(f.eight // 3, 100), "its levels end at 100"),
    "text.ppm": File(lambda f: b"P3 2 1 255 1 2 3 4 5 6\n", "its levels are written as text"),
    # Others
    "lossless.heic": File(lambda f: heic(f.srgb, chroma=444, matrix_coefficients=0), SRGB),
    "a phone's.heic": File(lambda f: heic(f.srgb, chroma=420), planes(2, 2)),
    "gif.gif": File(converted("GIF", "P"), "it is a picture in GIF"),
    # What a camera that was turned to the left stores.
    "turned.jpg": File(lambda f: jpeg(np.rot90(f.srgb), exif=TURNED), planes(1, 1)),
    "turned.png": File(lambda f: pil(np.rot90(f.eight), "PNG", exif=TURNED), EIGHT),
    "turned.tif": File(lambda f: tiff(np.rot90(f.sixteen), extratags=[(274, 3, 1, 6, True)]), SIXTEEN),
    "turned.webp": File(lambda f: pil(np.rot90(f.srgb), "WEBP", lossless=True, exif=TURNED), SRGB),
}


def twin(planes, format):
    """Return what planes show, RGB in 0..1, by the float64 twins of the kernels."""
    if format.layout == "yuv":
        return reference.convert_chroma(planes, format)
    if format.layout == "bayer":
        return reference.demosaic(planes[0], format, "horizontal")
    return planes[0] / (1.0 if planes[0].dtype.kind == "f" else 2.0**format.bits - 1)
