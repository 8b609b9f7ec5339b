"""What a picture's file says besides its pixels: its size, how the camera was held, and how light is encoded.

Decoders take memory for all of a picture before anything else of it is known, so its head is read here.

References
----------
CIPA DC-008 (Exif 2.32), 4.6.2; ICC.1:2022, 10.6 and 10.18; ISO/IEC 15948 (PNG), 11.2.2 and 11.3; ISO/IEC 10918-1
(JPEG), B.2.2; Adobe, TIFF revision 6.0, 2; RFC 9649 (WebP), 2; ITU-T H.273 for the numbers in a PNG's cICP.
"""

import re
import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from tikernels.raw.linearization import TRANSFERS, linear_values

# Tags of Exif and TIFF.
_ORIENTATION, _EXIF, _COLOR_SPACE, _PROFILE, _COLORS = 274, 34665, 40961, 34675, 262
_WIDTH, _HEIGHT = 256, 257
_READ = (_ORIENTATION, _EXIF, _COLOR_SPACE, _PROFILE, _COLORS, _WIDTH, _HEIGHT)
_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")  # the last two have offsets of eight bytes
# Begin of a frame in JPEG, baseline to lossless; C4, C8 and CC are tables and the like.
_JPEG_FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
# Markers without a length: one that stands for itself, and restarts.
_JPEG_ALONE = {0x01, *range(0xD0, 0xD9)}
_PNM = re.compile(rb"P[1-6](?:\s|#[^\r\n]*[\r\n])+(\d{1,9})(?:\s|#[^\r\n]*[\r\n])+(\d{1,9})\s")
_SRGB = 1  # of the colour space
# Markers of JPEG: applications' data, and where the picture's own begin.
_APP1, _APP2, _SCAN = 0xE1, 0xE2, 0xDA
#: What is said of pictures whose colours are not those that the camera saw.
CMYK = "it is in CMYK, the colours of a printer: save it in RGB"
PALETTE = "it is stored with a palette, whose few colours hold no phase: save it with all its colours"
_TYPE_BYTES = {1: 1, 2: 1, 3: 2, 4: 4, 7: 1, 16: 8}  # of the types of values that are read here
# Profiles of displays and cameras have up to some 100 kB.
_MOST_PROFILE = 2**22
# A gamma of 2.2 is within 0.009 of sRGB's curve, in linear light; what is further off is another curve.
_ALIKE = 0.015
_H273 = {1: "bt709", 6: "bt709", 8: "linear", 13: "srgb"}
_ODD = (struct.error, zlib.error, ValueError, IndexError, KeyError)


@dataclass(frozen=True)
class PictureTags:
    """How a picture is to be turned, and how its light is encoded."""

    orientation: int = 1
    """Of Exif, 1 to 8: see `upright`. 1 for TIFF, whose decoder turns pictures itself."""
    transfer: str | None = None
    """"linear", "srgb" or "bt709"; None: nothing tells."""
    because: str = "nothing in the file says otherwise"
    """What tells the transfer."""


def picture_size(data: bytes) -> tuple[int, int] | None:
    """Return the width and height that the head of a PNG, JPEG, TIFF, BMP, WebP or PNM file says; None: it is none."""
    try:
        if data.startswith(b"\x89PNG\r\n\x1a\n"):
            return _pair(data, ">II", 16) if data[12:16] == b"IHDR" else None
        if data.startswith(b"\xff\xd8\xff"):
            return _jpeg_size(data)
        if data[:4] in _TIFF:
            found = sorted(_tiff_values(data))  # the largest one counts, if there are two
            sizes = {tag: int.from_bytes(value, "little") for tag, value in found if tag in (_WIDTH, _HEIGHT)}
            return (sizes[_WIDTH], sizes[_HEIGHT]) if len(sizes) == 2 else None
        if data.startswith(b"BM"):
            # The head of OS/2 has 12 bytes and shorter numbers; rows from top to bottom have a negative height.
            width, height = _pair(data, "<HH" if data[14:18] == b"\x0c\0\0\0" else "<ii", 18)
            return width, abs(height)
        if data.startswith(b"RIFF") and data[8:12] == b"WEBP":
            return _webp_size(data)
        numbers = _PNM.match(data[:4096])
        return None if numbers is None else (int(numbers[1]), int(numbers[2]))
    except struct.error:  # it ends before
        return None


def read_tags(data: bytes) -> PictureTags:
    """Return what a PNG, JPEG, TIFF or WebP file says of itself; what is damaged or unknown says nothing."""
    tags = PictureTags()
    if data.startswith(b"\xff\xd8\xff"):
        tags = PictureTags(1, "srgb", "a JPEG that says nothing else is sRGB")
        parts = _jpeg_parts(data)
    elif data.startswith(b"\x89PNG\r\n\x1a\n"):
        parts = _png_parts(data)
    elif data[:4] in _TIFF:
        parts = iter([("tiff", data)])
    elif data.startswith(b"RIFF") and data[8:12] == b"WEBP":
        tags = PictureTags(1, "srgb", "a WebP picture that says nothing else is sRGB")
        parts = _webp_parts(data)
    else:
        return tags
    # Damaged curves are nonsense, which is no news.
    with suppress(*_ODD), np.errstate(all="ignore"):
        for kind, content in parts:
            tags = _after(tags, kind, content)
    return tags


def with_colors(tags: PictureTags, profile: bytes | None, transfer_code: int | None) -> PictureTags:
    """Return tags with what an ICC profile, or else a number of ITU-T H.273, says of the transfer."""
    with suppress(*_ODD), np.errstate(all="ignore"):
        if profile:
            return _with_profile(tags, profile)
        if transfer_code in _H273:
            return replace(tags, transfer=_H273[transfer_code], because="it is marked so")
    return tags


def upright(image: npt.NDArray[np.generic], orientation: int) -> npt.NDArray[np.generic]:
    """Return a view of an array, rows and columns first, as Exif's orientation says that it is to be seen."""
    if orientation in (5, 6, 7, 8):
        image = image.swapaxes(0, 1)
    down = -1 if orientation in (3, 4, 7, 8) else 1
    right = -1 if orientation in (2, 3, 6, 7) else 1
    return image[::down, ::right]


def unfit_colors(data: bytes) -> str | None:
    """Say why a PNG, TIFF, BMP or WebP file does not hold the colours that a camera saw; None: it may."""
    reason = None
    with suppress(*_ODD):
        if data[12:16] == b"IHDR" and data[25] == 3:
            reason = PALETTE
        elif data.startswith(b"BM") and struct.unpack_from("<H", data, 28)[0] <= 8:
            reason = PALETTE
        elif data[:4] in _TIFF:
            stored = dict(_tiff_values(data)).get(_COLORS, b"")
            reason = {3: PALETTE, 5: CMYK}.get(int.from_bytes(stored, "little"))
        elif data[:4] == b"RIFF" and data[12:16] == b"VP8X" and data[20] & 2:
            reason = "it is an animation: save its frames as PNG files in a folder"
    return reason


def _after(tags: PictureTags, kind: str, content: bytes) -> PictureTags:
    """Return the tags with what one part of the file says."""
    if kind in ("exif", "tiff"):
        found = dict(_tiff_values(content))
        orientation = int.from_bytes(found.get(_ORIENTATION, b"\1"), "little")
        if kind == "exif" and 1 <= orientation <= 8:
            tags = replace(tags, orientation=orientation)
        if _PROFILE in found:
            return _after(tags, "profile", found[_PROFILE])
        if int.from_bytes(found.get(_COLOR_SPACE, b""), "little") == _SRGB:
            return replace(tags, transfer="srgb", because="its Exif data say sRGB")
    elif kind == "profile":
        return _with_profile(tags, content)
    elif kind == "srgb":
        return replace(tags, transfer="srgb", because="it is marked as sRGB")
    elif kind == "cicp" and content[1] in _H273:
        return replace(tags, transfer=_H273[content[1]], because="it is marked so (cICP)")
    elif kind == "gamma":
        gamma = struct.unpack(">I", content)[0] / 1e5
        return _with_curve(tags, np.linspace(0, 1, 256) ** (1 / gamma), f"it is marked with a gamma of {gamma:.3g}")
    return tags


def _with_curve(tags: PictureTags, light: npt.NDArray[np.float64], because: str) -> PictureTags:
    """Take the transfer whose curve, linear light of 256 levels, is that of the file."""
    levels = np.linspace(0, 1, 256)
    off = {name: float(np.abs(light - linear_values(levels, name)).max()) for name in TRANSFERS}
    nearest = min(off, key=lambda name: off[name])
    if not off[nearest] <= _ALIKE:
        return replace(tags, because=f"{because}, which is another curve than {', '.join(TRANSFERS)}: set transfer")
    return replace(tags, transfer=nearest, because=because)


def _with_profile(tags: PictureTags, profile: bytes) -> PictureTags:
    """Take the curve of red, or grey, of an ICC profile."""
    count = struct.unpack_from(">I", profile, 128)[0]
    entries = {}
    for entry in range(min(count, 100)):
        name, begin, size = struct.unpack_from(">4sII", profile, 132 + 12 * entry)
        entries[name] = profile[begin : begin + size]
    curve = entries.get(b"rTRC", entries.get(b"kTRC"))
    return tags if curve is None else _with_curve(tags, _icc_curve(curve), "its colour profile says so")


def _icc_curve(curve: bytes) -> npt.NDArray[np.float64]:
    """Return the linear light of 256 levels by an ICC curve, a table or a formula."""
    levels = np.linspace(0, 1, 256)
    if curve[:4] == b"curv":
        count = struct.unpack_from(">I", curve, 8)[0]
        if count == 0:
            return levels
        values = np.frombuffer(curve, ">u2", count, 12).astype(np.float64)
        if count == 1:
            return np.asarray(levels ** float(values[0] / 256))
        return np.interp(levels, np.linspace(0, 1, count), values / 65535)
    if curve[:4] != b"para":
        raise ValueError("a curve of an unknown kind")
    kind = struct.unpack_from(">H", curve, 8)[0]
    given = struct.unpack_from(f">{(1, 3, 4, 5, 7)[kind]}i", curve, 12)
    numbers = [value / 65536 for value in given] + [0.0] * 7
    gamma, a, b, c, d, e, f = numbers[:7]
    if kind == 0:
        return np.asarray(levels**gamma)
    bent = np.asarray(np.maximum(a * levels + b, 0.0) ** gamma)
    if kind < 3:  # above -b/a, a constant below
        return np.asarray(np.where(levels >= -b / a, bent, 0.0) + (c if kind == 2 else 0.0))
    return np.asarray(np.where(levels >= d, bent + e, c * levels + f))


def _tiff_values(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield tags of a TIFF file's first directory, and of the Exif directory that it names; numbers little-endian."""
    order = "<" if data[:2] == b"II" else ">"
    large = data[2:4] in (b"+\0", b"\0+")
    offset, count, entry_bytes = ("Q", "Q", 20) if large else ("I", "H", 12)
    offset_bytes = struct.calcsize(offset)
    begins = [struct.unpack_from(order + offset, data, 8 if large else 4)[0]]
    for begin in begins:
        (n_entries,) = struct.unpack_from(order + count, data, begin)
        begin += struct.calcsize(order + count)
        for entry in range(begin, min(begin + n_entries * entry_bytes, len(data)), entry_bytes):
            tag, kind = struct.unpack_from(order + "HH", data, entry)
            if tag not in _READ or kind not in _TYPE_BYTES:
                continue
            size = struct.unpack_from(order + offset, data, entry + 4)[0] * _TYPE_BYTES[kind]
            at = entry + 4 + offset_bytes
            if size > offset_bytes or tag == _EXIF:
                (at,) = struct.unpack_from(order + offset, data, at)
            if tag == _EXIF:
                if len(begins) == 1:
                    begins.append(at)
                continue
            value = data[at : at + min(size, _MOST_PROFILE)]
            yield tag, value if order == "<" or tag == _PROFILE else value[::-1]


def _jpeg_parts(data: bytes) -> Iterator[tuple[str, bytes]]:
    profile = b""
    for kind, begin, end in _jpeg_segments(data):
        content = data[begin:end]
        if kind == _APP1 and content.startswith(b"Exif\0\0"):
            yield "exif", content[6:]
        elif kind == _APP2 and content.startswith(b"ICC_PROFILE\0"):
            profile += content[14:]  # of several parts, in their order
        elif kind == _SCAN:
            break
    if profile:
        yield "profile", profile


def _png_parts(data: bytes) -> Iterator[tuple[str, bytes]]:
    """Yield what a PNG's chunks say, in the order in which later ones overrule earlier ones."""
    found: dict[bytes, bytes] = {}
    begin = 8
    while begin + 12 <= len(data):
        size, kind = struct.unpack_from(">I4s", data, begin)
        found.setdefault(kind, data[begin + 8 : begin + 8 + size])
        begin += 12 + size
    names = {b"eXIf": "exif", b"gAMA": "gamma", b"sRGB": "srgb", b"iCCP": "profile", b"cICP": "cicp"}
    for kind, name in names.items():
        if kind in found:
            content = found[kind]
            if kind == b"iCCP":
                content = zlib.decompressobj().decompress(content[content.index(b"\0") + 2 :], _MOST_PROFILE)
            yield name, content


def _webp_parts(data: bytes) -> Iterator[tuple[str, bytes]]:
    begin = 12
    while begin + 8 <= len(data):
        kind, size = struct.unpack_from("<4sI", data, begin)
        if kind == b"EXIF":
            content = data[begin + 8 : begin + 8 + size]
            yield "exif", content.removeprefix(b"Exif\0\0")
        elif kind == b"ICCP":
            yield "profile", data[begin + 8 : begin + 8 + size]
        begin += 8 + size + size % 2


def _pair(data: bytes, layout: str, begin: int) -> tuple[int, int]:
    first, second = struct.unpack_from(layout, data, begin)
    return first, second


def _jpeg_segments(data: bytes) -> Iterator[tuple[int, int, int]]:
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
    for kind, begin, _ in _jpeg_segments(data):
        if kind in _JPEG_FRAMES:
            height, width = _pair(data, ">HH", begin + 1)
            return width, height
    return None


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
