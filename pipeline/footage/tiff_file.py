"""TIFF files: their directories, one per page, and what of a page OpenCV decodes as it is stored.

OpenCV decodes the first page. What it does not know of that page it reads as black or as other colours, without an
error: unknown compressions, interleaved reading of separate planes, colours multiplied by their transparency. So a
page's tags are compared with what it is known to decode.

References
----------
Adobe, TIFF revision 6.0, 2, 8 and 18, and its supplements; BigTIFF; Adobe, DNG 1.7, 4 for the tag of raw files.
"""

import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
import numpy.typing as npt

#: How such files begin; the last two have offsets of eight bytes.
TIFF_MARKS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")


class Tag(IntEnum):
    """Tags that are read of a directory."""

    KIND, OLD_KIND, WIDTH, HEIGHT, BITS, COMPRESSION, PHOTOMETRIC, DESCRIPTION = 254, 255, 256, 257, 258, 259, 262, 270
    STRIP_PLACES, ORIENTATION, SAMPLES, STRIP_SIZES, MOST, PLANAR, TRANSFER = 273, 274, 277, 279, 281, 284, 301
    TILE_PLACES, TILE_SIZES, EXTRA_SAMPLES, SAMPLE_FORMAT, XMP = 324, 325, 338, 339, 700
    PROFILE, EXIF, COLOR_SPACE, MP_IMAGES, DNG = 34675, 34665, 40961, 0xB001, 50706


_TAGS = frozenset(Tag)
# Of the types of values that are read here.
_TYPES = {1: "u1", 2: "u1", 3: "u2", 4: "u4", 7: "u1", 13: "u4", 16: "u8", 18: "u8"}
# Kinds of pages that are no frames: smaller versions, and masks.
_SMALLER_OR_MASK, _OLD_SMALLER = 1 | 4, 2
_DEFLATE = (8, 32946)
_COMPRESSIONS = (1, 5, 7, *_DEFLATE, 32773)  # none, LZW, JPEG, deflate, PackBits
_OTHERS = {
    **{6: "old JPEG", 34712: "JPEG 2000", 34887: "LERC", 34925: "LZMA", 34933: "PNG"},
    **{50000: "Zstandard", 50001: "WebP", 50002: "JPEG XL"},
}
_GREY, _RGB, _YCBCR = 1, 2, 6
_UNSIGNED, _FLOAT = 1, 3
#: Of a camera's raw file, whatever its name.
RAW = "it is a camera's raw file: convert it to a TIFF of 16 bits and linear light"
#: Of pictures whose colours are not those that a camera saw.
CMYK = "it is in CMYK, the colours of a printer: save it in RGB"
PALETTE = "it is stored with a palette, whose few colours hold no phase: save it with all its colours"
_COLORS = {
    0: "in it white is zero: invert it, and save it with black as zero",
    3: PALETTE,
    5: CMYK,
    _YCBCR: "its colours are stored as YCbCr, which is not read in TIFF: save it in RGB",
    8: "its colours are stored as CIELab: save it in RGB",
    32803: RAW,
    34892: RAW,
}


@dataclass(frozen=True)
class Directory:
    """Tags of a page, or of Exif."""

    values: Mapping[int, npt.NDArray[Any]]  # by tag
    places: Mapping[int, int]  # where each of these begins in the file
    following: int  # where the next page's directory begins; 0: there is none

    def first(self, tag: int, default: int) -> int:
        """Return a tag's first value."""
        values = self.values.get(tag)
        return default if values is None or not len(values) else int(values[0])


def read_directory(data: bytes, begin: int | None = None) -> Directory:
    """Return one directory of a TIFF file, by default the first one.

    Raises
    ------
    struct.error, ValueError
        It is damaged.
    """
    _, order, offset = _first_page_layout(data)
    count, entry_bytes = ("Q", 20) if offset == "Q" else ("H", 12)
    begin = first_page_place(data) if begin is None else begin
    _check_inside(data, begin)
    (n_entries,) = struct.unpack_from(order + count, data, begin)
    first = begin + struct.calcsize(count)
    end = first + n_entries * entry_bytes
    values, places = {}, {}
    for entry in range(first, min(end, len(data)), entry_bytes):
        tag, kind, n_values = struct.unpack_from(f"{order}HH{offset}", data, entry)
        if tag not in _TAGS or kind not in _TYPES:
            continue
        dtype = np.dtype(order + _TYPES[kind])
        at = entry + 4 + struct.calcsize(offset)
        if n_values * dtype.itemsize > struct.calcsize(offset):
            (at,) = struct.unpack_from(order + offset, data, at)
        _check_inside(data, at + n_values * dtype.itemsize)
        values[tag], places[tag] = np.frombuffer(data, dtype, n_values, at), at
    following = struct.unpack_from(order + offset, data, end)[0] if end + struct.calcsize(offset) <= len(data) else 0
    return Directory(values, places, following)


def _check_inside(data: bytes, place: int) -> None:
    if place > len(data):  # it may be larger than any place in memory
        raise ValueError("a place behind the end of the file")


def page_places(data: bytes) -> list[int]:
    """Return where the directory of each page begins; smaller versions of a page, and masks, are none.

    Raises
    ------
    struct.error, ValueError
        The file is damaged.
    """
    pages: list[int] = []
    seen = set()
    begin = first_page_place(data)
    while begin and begin not in seen:  # damage may lead in a circle
        seen.add(begin)
        page = read_directory(data, begin)
        smaller = page.first(Tag.KIND, 0) & _SMALLER_OR_MASK or page.first(Tag.OLD_KIND, 0) == _OLD_SMALLER
        if not smaller:
            pages.append(begin)
        begin = page.following
    return pages


def select_page(data: bytearray, begin: int) -> None:
    """Make the page whose directory begins there a file's first one."""
    at, order, offset = _first_page_layout(data)
    struct.pack_into(order + offset, data, at, begin)


def as_stored(data: bytes) -> bytes:
    """Return a file whose first page OpenCV neither turns nor multiplies by its transparency."""
    page = read_directory(data)
    said = {Tag.ORIENTATION: 1, Tag.EXTRA_SAMPLES: 0}
    changed = {tag: value for tag, value in said.items() if page.first(tag, value) != value}
    if not changed:
        return data
    copy = bytearray(data)
    for tag, value in changed.items():
        old = page.values[tag]
        np.frombuffer(copy, old.dtype, old.size, page.places[tag])[:] = value
    return bytes(copy)


def transfer_curve(page: Directory) -> npt.NDArray[np.float64] | None:
    """Return the linear light, 0..1, of a page's levels, in ascending order, if it states them."""
    table = page.values.get(Tag.TRANSFER)
    bits = page.first(Tag.BITS, 1)
    return None if table is None or len(table) < 2 ** min(bits, 16) else np.asarray(table[: 2**bits] / 65535)


def unfit_page(page: Directory) -> str | None:
    """Say why a page is not decoded as it is stored; None: it is."""
    compression, colors = page.first(Tag.COMPRESSION, 1), page.first(Tag.PHOTOMETRIC, _RGB)
    channels = page.first(Tag.SAMPLES, 1)
    bits, kinds = page.values.get(Tag.BITS, (1,)), page.values.get(Tag.SAMPLE_FORMAT, (_UNSIGNED,))
    stored = {(int(size), int(kind)) for size in bits for kind in kinds}
    reason = None
    if Tag.DNG in page.values:
        reason = RAW
    elif colors in _COLORS:
        reason = _COLORS[colors]
    elif compression not in _COMPRESSIONS:
        name = _OTHERS.get(compression, f"method {compression}")
        reason = f"it is compressed by {name}, which is not read: save it with LZW, deflate or no compression"
    elif (colors, channels) not in ((_GREY, 1), (_RGB, 3), (_RGB, 4)):
        reason = f"it has {channels} channels, and says that they are {_said(colors)}: save three, as RGB"
    elif stored - {(8, _UNSIGNED), (16, _UNSIGNED), (32, _FLOAT), *((n, _UNSIGNED) for n in (10, 12, 14))}:
        size, kind = min(stored)
        values = {2: "signed ", 3: "floating-point "}.get(kind, "")
        reason = f"it holds {values}values of {size} bits: save it with 8 or 16 bits, or as floats of 32 bits"
    elif page.first(Tag.PLANAR, 1) != 1 and channels > 1 and stored != {(8, _UNSIGNED)}:
        reason = "its colours are stored one after another (planar configuration 2): save it with them interleaved"
    return reason


def _said(colors: int) -> str:
    return {_GREY: "grey", _RGB: "RGB"}.get(colors, f"of kind {colors}")


def pages_elsewhere(page: Directory, n_pages: int) -> int:
    """Return how many pages ImageJ lists beyond those with a directory, as in its files of more than 4 GB."""
    words = page.values.get(Tag.DESCRIPTION, np.zeros(0, np.uint8)).tobytes().split()
    said = [word[7:] for word in words if word.startswith(b"images=") and word[7:].isdigit()]
    is_imagej = bool(words) and words[0].startswith(b"ImageJ=")
    return max(0, int(said[0][:9]) - n_pages) if is_imagej and said else 0


def is_cut_off(data: bytes, page: Directory) -> bool:
    """Return whether strips or tiles of a page reach beyond the file's end."""
    return any(end > len(data) for _, end in _strips(page))


def is_damaged(data: bytes, page: Directory) -> bool:
    """Return whether a page's values are not as they were written, where that can be checked: deflate has checksums."""
    is_deflated = page.first(Tag.COMPRESSION, 1) in _DEFLATE
    return is_deflated and not all(_is_deflated(data[begin:end]) for begin, end in _strips(page) if begin)


def _strips(page: Directory) -> list[tuple[int, int]]:
    """Return where each strip or tile begins and ends, as far as the page states it."""
    places, sizes = (Tag.STRIP_PLACES, Tag.TILE_PLACES), (Tag.STRIP_SIZES, Tag.TILE_SIZES)
    begins, lengths = ([int(value) for tag in tags for value in page.values.get(tag, ())] for tags in (places, sizes))
    return [(begin, begin + size) for begin, size in zip(begins, lengths, strict=False)]


def _is_deflated(strip: bytes) -> bool:
    """Return whether a strip is complete, and its checksum right."""
    reader = zlib.decompressobj()
    try:
        rest = strip
        while rest and not reader.eof:  # a little at a time, as it may claim to be larger than all memory
            reader.decompress(rest, 2**20)
            rest = reader.unconsumed_tail
    except zlib.error:
        return False
    return reader.eof


def _first_page_layout(data: bytes | bytearray) -> tuple[int, str, str]:
    """Return where a file states where its first directory begins, and in which order and type."""
    order = "<" if data[:2] == b"II" else ">"
    return (8, order, "Q") if data[2:4] in (b"+\0", b"\0+") else (4, order, "I")


def first_page_place(data: bytes) -> int:
    """Return where a file's first directory begins."""
    at, order, offset = _first_page_layout(data)
    begin: int = struct.unpack_from(order + offset, data, at)[0]
    return begin
