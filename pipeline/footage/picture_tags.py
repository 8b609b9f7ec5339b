"""What a picture's file says besides its pixels: how the camera was held, and how light is encoded.

References
----------
CIPA DC-008 (Exif 2.32), 4.6.2; ICC.1:2022, 10.6 and 10.18; ISO/IEC 15948 (PNG), 11.3; Adobe, TIFF revision 6.0, 2;
RFC 9649 (WebP), 2; ITU-T H.273 for the numbers in a PNG's cICP.
"""

import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from pipeline.footage.picture_size import jpeg_segments
from tikernels.raw.linearization import TRANSFERS, linear_values

# Tags of Exif and TIFF.
_ORIENTATION, _EXIF, _COLOR_SPACE, _PROFILE, _COLORS = 274, 34665, 40961, 34675, 262
_SRGB = 1  # of the colour space
# Markers of JPEG: applications' data, and where the picture's own begin.
_APP1, _APP2, _SCAN = 0xE1, 0xE2, 0xDA
#: What is said of pictures whose colours are not those that the camera saw.
CMYK = "it is in CMYK, the colours of a printer: save it in RGB"
_PALETTE = "it is stored with a palette, whose few colours hold no phase: save it with all its colours"
_TYPE_BYTES = {1: 1, 2: 1, 3: 2, 4: 4, 7: 1}  # of the types of values that are read here
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


def read_tags(data: bytes) -> PictureTags:
    """Return what a PNG, JPEG, TIFF or WebP file says of itself; what is damaged or unknown says nothing."""
    tags = PictureTags()
    if data.startswith(b"\xff\xd8\xff"):
        tags = PictureTags(1, "srgb", "a JPEG that says nothing else is sRGB")
        parts = _jpeg_parts(data)
    elif data.startswith(b"\x89PNG\r\n\x1a\n"):
        parts = _png_parts(data)
    elif data[:4] in (b"II*\0", b"MM\0*"):
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
            reason = _PALETTE
        elif data.startswith(b"BM") and struct.unpack_from("<H", data, 28)[0] <= 8:
            reason = _PALETTE
        elif data[:4] in (b"II*\0", b"MM\0*"):
            stored = dict(_tiff_values(data)).get(_COLORS, b"")
            reason = {3: _PALETTE, 5: CMYK}.get(int.from_bytes(stored, "little"))
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
    begins = [struct.unpack_from(order + "I", data, 4)[0]]
    for begin in begins:
        (n_entries,) = struct.unpack_from(order + "H", data, begin)
        for entry in range(begin + 2, begin + 2 + 12 * n_entries, 12):
            tag, kind, count = struct.unpack_from(order + "HHI", data, entry)
            if tag not in (_ORIENTATION, _EXIF, _COLOR_SPACE, _PROFILE, _COLORS) or kind not in _TYPE_BYTES:
                continue
            size = count * _TYPE_BYTES[kind]
            at = entry + 8 if size <= 4 else struct.unpack_from(order + "I", data, entry + 8)[0]
            value = data[at : at + min(size, _MOST_PROFILE)]
            if tag == _EXIF:
                if len(begins) == 1:
                    begins.append(struct.unpack_from(order + "I", data, entry + 8)[0])
            elif tag == _PROFILE:
                yield tag, value
            else:
                yield tag, value if order == "<" else value[::-1]


def _jpeg_parts(data: bytes) -> Iterator[tuple[str, bytes]]:
    profile = b""
    for kind, begin, end in jpeg_segments(data):
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
