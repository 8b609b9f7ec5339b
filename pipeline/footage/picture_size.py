"""How large a picture is by the head of its file: decoders take memory for all of it before anything else is known.

References
----------
ISO/IEC 15948 (PNG), 11.2.2; ISO/IEC 10918-1 (JPEG), B.2.2; Adobe, TIFF revision 6.0, 2; RFC 9649 (WebP), 2.
"""

import re
import struct
from collections.abc import Iterator

# Begin of a frame in JPEG, baseline to lossless; C4, C8 and CC are tables and the like.
_JPEG_FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
# Markers without a length: one that stands for itself, and restarts.
_JPEG_ALONE = {0x01, *range(0xD0, 0xD9)}
_TIFF_WIDTH, _TIFF_HEIGHT = 256, 257
# Types of whole numbers in TIFF that a size is written in, and their layouts.
_TIFF_TYPES = {3: "H", 4: "I", 16: "Q"}
_PNM = re.compile(rb"P[1-6](?:\s|#[^\r\n]*[\r\n])+(\d{1,9})(?:\s|#[^\r\n]*[\r\n])+(\d{1,9})\s")


def picture_size(data: bytes) -> tuple[int, int] | None:
    """Return the width and height that the head of a PNG, JPEG, TIFF, BMP, WebP or PNM file says; None: it is none."""
    try:
        if data.startswith(b"\x89PNG\r\n\x1a\n"):
            return _pair(data, ">II", 16) if data[12:16] == b"IHDR" else None
        if data.startswith(b"\xff\xd8\xff"):
            return _jpeg_size(data)
        if data[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
            return _tiff_size(data)
        if data.startswith(b"BM"):
            # The head of OS/2 has 12 bytes and shorter numbers; rows from top to bottom have a negative height.
            width, height = _pair(data, "<HH" if data[14:18] == b"\x0c\0\0\0" else "<ii", 18)
            return width, abs(height)
        if data.startswith(b"RIFF") and data[8:12] == b"WEBP":
            return _webp_size(data)
        found = _PNM.match(data[:4096])
        return None if found is None else (int(found[1]), int(found[2]))
    except struct.error:  # it ends before
        return None


def _pair(data: bytes, layout: str, begin: int) -> tuple[int, int]:
    first, second = struct.unpack_from(layout, data, begin)
    return first, second


def jpeg_segments(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield the second byte of each marker in a JPEG's head, and where its segment's content begins and ends.

    Raises
    ------
    struct.error
        The file ends before.
    """
    begin = 2
    while begin + 4 <= len(data) and data[begin] == 0xFF:
        kind = data[begin + 1]
        if kind == 0xFF or kind in _JPEG_ALONE:
            begin += 1 if kind == 0xFF else 2
            continue
        end = begin + 2 + struct.unpack_from(">H", data, begin + 2)[0]
        yield kind, begin + 4, end
        begin = end


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    for kind, begin, _ in jpeg_segments(data):
        if kind in _JPEG_FRAMES:
            height, width = _pair(data, ">HH", begin + 1)
            return width, height
    return None


def _tiff_size(data: bytes) -> tuple[int, int] | None:
    """Look in the first directory; numbers of the large kind have eight bytes where the usual one's have four."""
    order = "<" if data[:2] == b"II" else ">"
    large = data[2:4] in (b"+\0", b"\0+")
    begin: int = struct.unpack_from(order + ("Q" if large else "I"), data, 8 if large else 4)[0]
    count, entry_bytes, value_at = ("Q", 20, 12) if large else ("H", 12, 8)
    n_entries: int = struct.unpack_from(order + count, data, begin)[0]
    begin += struct.calcsize(order + count)
    found: dict[int, int] = {}
    for entry in range(begin, min(begin + n_entries * entry_bytes, len(data)), entry_bytes):
        tag, kind = _pair(data, order + "HH", entry)
        if tag in (_TIFF_WIDTH, _TIFF_HEIGHT) and kind in _TIFF_TYPES:
            found[tag] = max(
                found.get(tag, 0), struct.unpack_from(order + _TIFF_TYPES[kind], data, entry + value_at)[0]
            )
    return (found[_TIFF_WIDTH], found[_TIFF_HEIGHT]) if len(found) == 2 else None


def _webp_size(data: bytes) -> tuple[int, int] | None:
    kind = data[12:16]
    if kind == b"VP8X":
        low = struct.unpack_from("<HBHB", data, 24)
        return 1 + low[0] + (low[1] << 16), 1 + low[2] + (low[3] << 16)
    if kind == b"VP8L":
        bits = struct.unpack_from("<I", data, 21)[0]
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    if kind == b"VP8 ":
        width, height = _pair(data, "<HH", 26)
        return width & 0x3FFF, height & 0x3FFF
    return None
