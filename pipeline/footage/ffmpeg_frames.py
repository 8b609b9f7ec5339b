"""What FFmpeg says: of its frames' pixels and colours, in `PixelFormat`'s words, and of damage while it decodes."""

import logging
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from pipeline.errors import FootageError
from pipeline.footage.source import GREY, StoredAs
from pipeline.models import ImageArray
from tikernels.raw.pixel_format import BAYER_PATTERNS, Bayer, Matrix, PixelFormat, Siting

# How messages begin that FFmpeg calls errors, in streams that decode well.
_HARMLESS = ("mmco:", "co located POCs")
# Messages that nobody catches are not printed.
_SILENT = logging.NullHandler()
# ITU-T H.273: matrix coefficients, and transfer characteristics.
_MATRICES: dict[int, Matrix] = {1: "bt709", 5: "bt601", 6: "bt601", 9: "bt2020"}
_UNKNOWN_MATRIX = 2
_TRANSFERS = {1: "bt709", 6: "bt709", 14: "bt709", 15: "bt709", 8: "linear", 13: "srgb"}
_OTHER_TRANSFERS = {4: "gamma 2.2", 5: "gamma 2.8", 16: "PQ", 18: "HLG", 17: "SMPTE 428", 9: "logarithmic"}
_FULL_RANGE, _UNKNOWN_RANGE = 2, 0
# Codecs whose chroma sits in the middle of its pixels (JFIF, MPEG-1); all others' sits left, as H.264's does.
_CENTRED = ("mjpeg", "mjpegb", "mpeg1video", "webp")
# Rows from which on players take BT.709 where a frame says nothing of its matrix; with fewer, BT.601.
_HD_ROWS = 720

_SUBSAMPLING = {"420": (2, 2), "422": (2, 1), "440": (1, 2), "444": (1, 1)}
_PLANAR_YUV = re.compile(r"yuvj?(420|422|440|444)p(\d*)(?:le)?")
_TWO_PLANES = {"nv12": "420", "nv16": "422", "nv24": "444"}
_TWO_DEEP_PLANES = re.compile(r"p([024])(10|12|16)le")
_PACKED_YUV = {"yuyv422": (0, 1, 3), "uyvy422": (1, 0, 2), "yvyu422": (0, 3, 1)}  # where Y, Cb and Cr begin
_PACKED_RGB = re.compile(r"([0argb]{3,4})(24|48le|64le|)")
_PLANAR_RGB = re.compile(r"gbrp(\d*)(?:le)?")
_GREY = re.compile(r"gray(\d*)(?:le)?")
_BAYER = re.compile(r"bayer_([rgb]{4})(8|16le)")


@contextmanager
def caught_messages() -> Iterator[list[str]]:
    """Catch the errors that FFmpeg reports in this thread; the list is filled when the block ends."""
    import av  # slow to import, and only needed here

    logging.getLogger("libav").addHandler(_SILENT)
    av.logging.set_level(av.logging.ERROR)
    av.logging.set_skip_repeated(False)
    caught: list[str] = []
    with av.logging.Capture() as messages:
        yield caught
    caught.extend(text.strip() for _, _, text in messages if not text.startswith(_HARMLESS))


@dataclass(frozen=True)
class _Names:
    """What a pixel format's name says: how it is stored, and for each of our planes where it is in FFmpeg's."""

    format: PixelFormat
    places: tuple[tuple[int, int, int], ...]  # plane, first value, and from one value (or pixel of RGB) to the next


def transfer_of(frame: Any) -> tuple[str | None, str | None]:
    """Return how a frame says that its light is encoded, or what else it says that is not undone."""
    number = int(frame.color_trc)
    return _TRANSFERS.get(number), _OTHER_TRANSFERS.get(number)


def stored_planes(
    frame: Any, codec: str, says: StoredAs
) -> tuple[tuple[ImageArray, ...], PixelFormat, tuple[str, ...]]:
    """Return views of a frame's planes, how they are stored, and what of that had to be assumed.

    Raises
    ------
    FootageError
        No kernel reads this pixel format or matrix, or it is grey and nobody says which mosaic it is.
    """
    name = frame.format.name
    names = _names(name)
    if names is None:
        kept = "bgr0" if max(part.bits for part in frame.format.components) <= 8 else "gbrp16le"
        advice = f"convert it with ffmpeg -pix_fmt {kept} -c:v ffv1"
        raise FootageError(f"its pixel format {name} is not supported: {advice}")
    if names.format.layout == "bayer" and not name.startswith("bayer") and says.bayer is None:
        raise FootageError(GREY)
    format = names.format
    assumed: tuple[str, ...] = ()
    if format.layout == "yuv":
        format, assumed = _with_colors(format, frame, codec, says)
    format = says.applied_to(format)
    shapes = format.plane_shapes(frame.height, frame.width)
    if len(names.places) != len(shapes):  # RGB in three planes
        shapes = (shapes[0][:2],) * 3
    size = np.dtype(format.dtype).itemsize
    views = []
    for shape, (plane, first, step) in zip(shapes, names.places, strict=True):
        buffer = frame.planes[plane]
        strides = (buffer.line_size, step * size, size)[: len(shape)]
        views.append(np.ndarray(shape, format.dtype, buffer, first * size, strides))
    return tuple(views), format, assumed


def _with_colors(format: PixelFormat, frame: Any, codec: str, says: StoredAs) -> tuple[PixelFormat, tuple[str, ...]]:
    matrix, number = says.matrix, int(frame.colorspace)
    assumed = []
    if matrix is None and number == _UNKNOWN_MATRIX:
        matrix = "bt601" if frame.height < _HD_ROWS else "bt709"
        assumed.append(f"matrix {matrix}")
    elif matrix is None:
        matrix = _MATRICES.get(number)
        if matrix is None:
            raise FootageError(f"its colour matrix (number {number} of ITU-T H.273) is not supported: give the nearest")
    full_range = says.full_range
    if full_range is None:
        full_range = frame.color_range == _FULL_RANGE or "yuvj" in frame.format.name
        if not full_range and frame.color_range == _UNKNOWN_RANGE:
            assumed.append("limited range (16 to 235)")
    siting: Siting = "centre" if codec in _CENTRED else "left"
    return replace(format, matrix=matrix, full_range=full_range, siting=siting), tuple(assumed)


def _bayer(pattern: str) -> Bayer:
    return next(known for known in BAYER_PATTERNS if known == pattern)


@cache
def _names(name: str) -> _Names | None:
    whole = (0, 0, 1)
    if match := _PLANAR_YUV.fullmatch(name):
        format = PixelFormat("yuv", int(match[2] or 8), subsampling=_SUBSAMPLING[match[1]])
        return _Names(format, (whole, (1, 0, 1), (2, 0, 1)))
    if name in _TWO_PLANES:
        format = PixelFormat("yuv", subsampling=_SUBSAMPLING[_TWO_PLANES[name]], interleaved=True)
        return _Names(format, (whole, (1, 0, 1)))
    if name == "nv21":
        return _Names(PixelFormat("yuv", subsampling=(2, 2)), (whole, (1, 1, 2), (1, 0, 2)))
    if match := _TWO_DEEP_PLANES.fullmatch(name):
        bits = int(match[2])
        subsampling = {"0": (2, 2), "2": (2, 1), "4": (1, 1)}[match[1]]
        format = PixelFormat("yuv", bits, 16 - bits, subsampling=subsampling, interleaved=True)
        return _Names(format, (whole, (1, 0, 1)))
    if name in _PACKED_YUV:
        luma, blue, red = _PACKED_YUV[name]
        return _Names(PixelFormat("yuv", subsampling=(2, 1)), ((0, luma, 2), (0, blue, 4), (0, red, 4)))
    if match := _PLANAR_RGB.fullmatch(name):
        return _Names(PixelFormat("rgb", int(match[1] or 8), channels="gbr"), (whole, (1, 0, 1), (2, 0, 1)))
    if match := _BAYER.fullmatch(name):
        return _Names(PixelFormat("bayer", 8 if match[2] == "8" else 16, bayer=_bayer(match[1])), (whole,))
    if match := _GREY.fullmatch(name):
        return _Names(PixelFormat("bayer", int(match[1] or 8)), (whole,))
    if (match := _PACKED_RGB.fullmatch(name)) and sorted(match[1].replace("a", "0").replace("0", "")) == [
        "b",
        "g",
        "r",
    ]:
        channels = match[1].replace("a", "0")
        return _Names(
            PixelFormat("rgb", 16 if match[2].endswith("le") else 8, channels=channels), ((0, 0, len(channels)),)
        )
    return None
