"""FFmpeg's reports: on its frames' pixels and colours, in `PixelFormat`'s words, and on damage while it decodes."""

import logging
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, cast

import numpy as np

from pipeline.errors import FootageError
from pipeline.footage.footage import GREY, StoredAs
from pipeline.footage.picture_tags import H273_MATRICES, H273_OTHERS, H273_TRANSFERS
from pipeline.footage.tiff_file import PALETTE
from pipeline.models import ImageArray
from tikernels.raw.pixel_format import FLOAT_BITS, Bayer, PixelFormat, Siting

# How messages begin that FFmpeg calls errors, in streams that decode well.
_HARMLESS = ("mmco:", "co located POCs")
# Messages that nobody catches are not printed.
_SILENT = logging.NullHandler()
# Of ITU-T H.273.
_UNKNOWN_MATRIX = 2
_LIMITED_RANGE, _FULL_RANGE = 1, 2
# Codecs whose chroma sits in the middle of its pixels (JFIF, MPEG-1); all others' sits left, as H.264's does.
_CENTRED = ("mjpeg", "mjpegb", "mpeg1video", "webp")
# Rows from which on players take BT.709 where a frame does not specify its matrix; with fewer, BT.601.
_HD_ROWS = 720

_SUBSAMPLING = {"420": (2, 2), "422": (2, 1), "440": (1, 2), "444": (1, 1), "411": (4, 1), "410": (4, 4)}
_PLANAR_YUV = re.compile(r"yuv[ja]?(4\d\d)p(9|1\d|)(msb)?")
# Subsampling, bits, and whether Cb is the first of each pair.
_TWO_PLANES = {
    "nv12": ("420", 8, True),
    "nv21": ("420", 8, False),
    "nv16": ("422", 8, True),
    "nv20": ("422", 10, True),
    "nv24": ("444", 8, True),
    "nv42": ("444", 8, False),
}
_TWO_DEEP_PLANES = re.compile(r"p([024])(1\d)")
# The order of luma, Cb, Cr and what is no colour, and bits, which are the upper ones.
_PACKED_YUV = {
    "yuyv422": ("yuyv", 8),
    "uyvy422": ("uyvy", 8),
    "yvyu422": ("yvyu", 8),
    "y210": ("yuyv", 10),
    "y212": ("yuyv", 12),
    "y216": ("yuyv", 16),
    "vyu444": ("vyu", 8),
    "vuya": ("vuya", 8),
    "vuyx": ("vuyx", 8),
    "ayuv": ("ayuv", 8),
    "uyva": ("uyva", 8),
    "ayuv64": ("ayuv", 16),
    "xv36": ("uyvx", 12),
    "xv48": ("uyvx", 16),
}
_PACKED_RGB = re.compile(r"([0argb]{3,4})(f32|24|48|64|)")
_PLANAR_RGB = re.compile(r"gbra?p(f32|9|1\d|)(msb)?")
_GREY = re.compile(r"(gray|ya)(9|1\d|)")
_BAYER = re.compile(r"bayer_([rgb]{4})(8|16)")
# Of a display matrix (ISO/IEC 14496-12, 6.2.2) the signs that turn x and y; and Exif's number of that turn.
_TURNS = {
    (1, 0, 0, 1): 1,
    (-1, 0, 0, 1): 2,
    (-1, 0, 0, -1): 3,
    (1, 0, 0, -1): 4,
    (0, 1, 1, 0): 5,
    (0, 1, -1, 0): 6,
    (0, -1, -1, 0): 7,
    (0, -1, 1, 0): 8,
}


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
    """Contents of a pixel format's name: how it is stored, and for each of our planes where it is in FFmpeg's."""

    format: PixelFormat
    places: tuple[tuple[int, int, int], ...]  # plane, first value, and from one value (or pixel of RGB) to the next


def transfer_of(frame: Any) -> tuple[str | None, str | None]:
    """Return how a frame's light is encoded, or the encoding it states that is not undone."""
    number = int(frame.color_trc)
    return H273_TRANSFERS.get(number), H273_OTHERS.get(number)


def stored_planes(
    frame: Any, codec: str, says: StoredAs
) -> tuple[tuple[ImageArray, ...], PixelFormat, tuple[str, ...]]:
    """Return views of a frame's planes, how they are stored, and what of that is assumed or overruled, for the user.

    Raises
    ------
    FootageError
        No kernel reads this pixel format or matrix, or it is grey and its mosaic is not specified.
    """
    name = frame.format.name
    names = _names(name)
    if frame.format.has_palette:
        raise FootageError(PALETTE)
    if _is_grey(frame.format) and says.bayer is None:
        raise FootageError(GREY)
    if names is None:
        raise FootageError(f"its pixel format {name} is not supported: {_advice(frame.format)}")
    format = names.format
    notes: tuple[str, ...] = ()
    if format.layout == "yuv":
        format, notes = _with_colors(format, frame, codec, says)
    if any(part.is_alpha for part in frame.format.components):
        notes += ("its transparency is left out",)
    format = says.applied_to(format)
    shapes = format.plane_shapes(frame.height, frame.width)
    if len(names.places) != len(shapes):  # RGB in three planes
        shapes = (shapes[0][:2],) * 3
    stored_type = np.dtype(format.dtype).newbyteorder(">" if name.endswith("be") else "=")
    size = stored_type.itemsize
    views = []
    for shape, (plane, first, step) in zip(shapes, names.places, strict=True):
        buffer = frame.planes[plane]
        strides = (buffer.line_size, step * size, size)[: len(shape)]
        # Where rows are stored from the bottom up the first one is the last in memory.
        top = buffer.buffer_ptr - np.frombuffer(buffer, np.uint8).ctypes.data
        view = np.ndarray(shape, stored_type, buffer, top + first * size, strides)
        views.append(view.astype(format.dtype, copy=False))
    return tuple(views), format, notes


def views_of(frame: Any) -> tuple[str, ...]:
    """Say where a frame shows something else than one flat picture of square pixels, for the user."""
    from av.sidedata.sidedata import Type

    notes = []
    if frame.interlaced_frame:
        notes.append("it is interlaced: the two fields of a frame show different moments")
    stereo = frame.side_data.get(Type.STEREO3D)
    if stereo is not None and np.frombuffer(stereo, np.int32)[0] != 0:  # 0: one view
        notes.append("it is stereoscopic, with two views in a frame or in turns: cut out one with --roi, or record one")
    if frame.side_data.get(Type.SPHERICAL) is not None:
        notes.append("it is marked as a spherical picture; here it is taken as a flat one")
    return tuple(notes)


def orientation_of(frame: Any) -> int | None:
    """Return how a frame's display matrix turns it, as Exif's number; None: by no right angle."""
    from av.sidedata.sidedata import Type

    matrix = frame.side_data.get(Type.DISPLAYMATRIX)
    if matrix is None:
        return 1
    turn = np.frombuffer(matrix, np.int32)[[0, 1, 3, 4]] / 2**16
    signs = np.rint(turn)
    return _TURNS.get(tuple(signs.astype(int).tolist())) if np.allclose(turn, signs, atol=0.01) else None


def _is_grey(format: Any) -> bool:
    return sum(not part.is_alpha for part in format.components) < 3


def _advice(format: Any) -> str:
    """Say how to convert a frame so that no chroma is repeated: to the same subsampling."""
    deep = max(part.bits for part in format.components) > 8
    name = "gbrp16le" if deep else "bgr0"
    if _is_grey(format):
        name = "gray16le" if deep else "gray"
    elif not format.is_rgb and any(part.is_chroma for part in format.components):
        step = (4 // format.chroma_width(4), 4 // format.chroma_height(4))
        kept = next(name for name, subsampling in _SUBSAMPLING.items() if subsampling == step)
        name = f"yuv{kept}p{'16le' if deep else ''}"
    return f"convert it with ffmpeg -pix_fmt {name} -c:v ffv1"


def _with_colors(format: PixelFormat, frame: Any, codec: str, says: StoredAs) -> tuple[PixelFormat, tuple[str, ...]]:
    number = int(frame.colorspace)
    tagged = H273_MATRICES.get(number)
    if tagged is None and number != _UNKNOWN_MATRIX and says.matrix is None:
        raise FootageError(f"its colour matrix (number {number} of ITU-T H.273) is not supported: give the nearest")
    matrix = says.matrix or tagged or ("bt601" if frame.height < _HD_ROWS else "bt709")
    full_tagged = {_FULL_RANGE: True, _LIMITED_RANGE: False}.get(frame.color_range)
    if "yuvj" in frame.format.name:
        full_tagged = True
    full_range = bool(full_tagged) if says.full_range is None else says.full_range
    ranges = {False: "limited range (16 to 235)", True: "full range"}
    known = ((f"matrix {matrix}", tagged, says.matrix), (ranges[full_range], full_tagged, says.full_range))
    assumed = ", ".join(name for name, by_file, by_user in known if by_file is None and by_user is None)
    overruled = ", ".join(
        name for name, by_file, by_user in known if by_file is not None and by_user not in (None, by_file)
    )
    notes = []
    if assumed:
        notes.append(f"the file does not say it, so this is assumed: {assumed}")
    if overruled:
        notes.append(f"the file says otherwise, but this is taken, as you say: {overruled}")
    siting: Siting = "centre" if codec in _CENTRED else "left"
    return replace(format, matrix=matrix, full_range=full_range, siting=siting), tuple(notes)


@cache
def _names(name: str) -> _Names | None:
    whole = (0, 0, 1)
    name = name.removesuffix("le").removesuffix("be")
    if match := _PLANAR_YUV.fullmatch(name):
        bits = int(match[2] or 8)
        format = PixelFormat("yuv", bits, 16 - bits if match[3] else 0, subsampling=_SUBSAMPLING[match[1]])
        return _Names(format, (whole, (1, 0, 1), (2, 0, 1)))
    if name in _TWO_PLANES:
        kept, bits, blue_first = _TWO_PLANES[name]
        format = PixelFormat("yuv", bits, subsampling=_SUBSAMPLING[kept])
        return _Names(format, (whole, (1, int(not blue_first), 2), (1, int(blue_first), 2)))
    if match := _TWO_DEEP_PLANES.fullmatch(name):
        bits = int(match[2])
        subsampling = {"0": (2, 2), "2": (2, 1), "4": (1, 1)}[match[1]]
        return _Names(PixelFormat("yuv", bits, 16 - bits, subsampling=subsampling), (whole, (1, 0, 2), (1, 1, 2)))
    if name in _PACKED_YUV:
        order, bits = _PACKED_YUV[name]
        format = PixelFormat("yuv", bits, -bits % 8, subsampling=(order.count("y"), 1))
        return _Names(format, tuple((0, order.index(part), len(order) // order.count(part)) for part in "yuv"))
    if match := _PLANAR_RGB.fullmatch(name):
        bits = FLOAT_BITS if match[1] == "f32" else int(match[1] or 8)
        format = PixelFormat("rgb", bits, 16 - bits if match[2] else 0, channels="gbr")
        return _Names(format, (whole, (1, 0, 1), (2, 0, 1)))
    if match := _BAYER.fullmatch(name):
        return _Names(PixelFormat("bayer", int(match[2]), bayer=cast(Bayer, match[1])), (whole,))
    if match := _GREY.fullmatch(name):
        return _Names(PixelFormat("bayer", int(match[2] or 8)), ((0, 0, 2 if match[1] == "ya" else 1),))
    if (match := _PACKED_RGB.fullmatch(name)) and set("rgb") <= set(match[1]):
        bits = {"f32": FLOAT_BITS, "48": 16, "64": 16}.get(match[2], 8)
        format = PixelFormat("rgb", bits, channels=match[1].replace("a", "0"))
        return _Names(format, ((0, 0, len(match[1])),))
    return None
