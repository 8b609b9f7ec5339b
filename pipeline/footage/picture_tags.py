"""Tags of a picture's file: its size, how the camera was held, and how light is encoded.

Decoders take memory for all of a picture before anything else of it is known, so its head is read here.

References
----------
CIPA DC-008 (Exif 2.32), 4.6.2; ICC.1:2022, 10.6 and 10.18; ISO/IEC 15948 (PNG), 11.2.2 and 11.3; ISO/IEC 10918-1
(JPEG), B.1.1 and B.2.2; CIPA DC-007 (MPF), 5; RFC 9649 (WebP), 2; Microsoft, BITMAPV5HEADER; ITU-T H.273 for the
numbers in a PNG's cICP. TIFF has a file of its own.
"""

import re
import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from pipeline.footage.tiff_file import (
    CMYK,
    PALETTE,
    TIFF_MARKS,
    Tag,
    is_cut_off,
    read_directory,
    transfer_curve,
    unfit_page,
)
from tikernels.raw.linearization import TRANSFERS, linear_values
from tikernels.raw.pixel_format import Matrix

#: How files begin.
PNG, JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"
# Begin of a frame in JPEG, baseline to lossless; C4, C8 and CC are tables and the like.
_JPEG_FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
# Of these, what is not read: frames of several resolutions, and arithmetic coding.
_HIERARCHICAL, _ARITHMETIC = range(0xC5, 0xC8), range(0xC9, 0xD0)
# Pixels of a chroma sample of JPEG, across and down, that FFmpeg knows.
_SUBSAMPLING = ((1, 1), (2, 1), (1, 2), (2, 2), (4, 1))
# Markers of JPEG: one that stands alone, begin and end of a picture, and applications' data.
_ALONE, _BEGIN, _END, _APP1, _APP2 = 0x01, 0xD8, 0xD9, 0xE1, 0xE2
# In coded data FF is followed by 0, or by the number of a restart.
_MARKER = re.compile(rb"\xff+[\x01-\xcf\xd8-\xfe]")
# Of XMP, as an attribute or as an element.
_XMP_ORIENTATION = re.compile(rb"tiff:Orientation\s*(?:=\s*[\"']|>)\s*([1-8])\b")
_BLANK = rb"(?:\s|#[^\r\n]*[\r\n])+"
# Kind, width, height and, but for black and white, the highest level.
_PNM = re.compile(rb"P(?:[14]|([2356]))" + 2 * (_BLANK + rb"(\d{1,9})") + rb"(?(1)" + _BLANK + rb"(\d{1,9}))\s")
_SRGB = 1  # of the colour space
# Layouts of BMP: as they are, and by masks, of which one order is read.
_PLAIN, _MASKS, _BMP_ORDER = 0, (3, 6), (0xFF0000, 0xFF00, 0xFF)
_GREY_ALPHA = "it is grey with transparency, but the phase is in the colours: save a Bayer mosaic without transparency"
#: Note on a picture that is.
TRANSPARENT = "it is transparent in parts, which is not used: its colours are taken as they are stored"
_ANIMATION = "it is an animation: save its frames as PNG files in a folder"
# Profiles of displays and cameras have up to about 100 kB.
_MOST_PROFILE = 2**22
# A gamma of 2.2 is within 0.009 of sRGB's curve, in linear light; what is further off is another curve.
_ALIKE = 0.015
#: ITU-T H.273's numbers of transfers, of those that are not undone, and of matrices.
H273_TRANSFERS = {1: "bt709", 6: "bt709", 14: "bt709", 15: "bt709", 8: "linear", 13: "srgb"}
H273_OTHERS = {4: "gamma 2.2", 5: "gamma 2.8", 16: "PQ", 18: "HLG", 17: "SMPTE 428", 9: "logarithmic"}
H273_MATRICES: dict[int, Matrix] = {1: "bt709", 5: "bt601", 6: "bt601", 9: "bt2020"}
_UNSPECIFIED = 2
_ODD = (struct.error, zlib.error, ValueError, IndexError, KeyError, ZeroDivisionError)


@dataclass(frozen=True)
class PictureTags:
    """Orientation of a picture, and the encoding of its light."""

    orientation: int = 1
    """Of Exif, or else of XMP, 1 to 8: see `upright`."""
    transfer: str | None = None
    """"linear", "srgb" or "bt709"; None: unknown."""
    because: str = "nothing in the file says otherwise"
    """The evidence for the transfer."""
    notes: tuple[str, ...] = ()
    """Unused parts of the file, one sentence each; for the user."""


def picture_size(data: bytes) -> tuple[int, int] | None:
    """Return the width and height in the head of a PNG, JPEG, TIFF, BMP, WebP or PNM file; None: it is none."""
    try:
        if data.startswith(PNG):
            return _pair(data, ">II", 16) if data[12:16] == b"IHDR" else None
        if data.startswith(JPEG):
            frame = _jpeg_frame(data)
            return None if frame is None else (frame.width, frame.height)
        if data[:4] in TIFF_MARKS:
            page = read_directory(data)
            size = page.first(Tag.WIDTH, 0), page.first(Tag.HEIGHT, 0)
            return size if all(size) else None
        if data.startswith(b"BM"):
            width, height = _bmp_size(data)
            return width, abs(height)
        if _is_webp(data):
            return _webp_size(data)
        numbers = _PNM.match(data[:4096])
        return None if numbers is None else (int(numbers[2]), int(numbers[3]))
    except (struct.error, ValueError):  # it ends before
        return None


def picture_end(data: bytes) -> int | None:
    """Return where a picture ends by its structure, as bytes of others may follow; None: it is truncated."""
    end: int | None = len(data)
    with suppress(*_ODD):  # what is wrong with it is found when it is decoded
        if data.startswith(PNG):
            end = next((end for kind, _, end in png_chunks(data) if kind == b"IEND"), None)
        elif data.startswith(JPEG):
            end = next((end for kind, _, end in _jpeg_segments(data) if kind == _END), None)
        elif data[:4] in TIFF_MARKS:
            end = None if is_cut_off(data, read_directory(data)) else len(data)
        elif data.startswith(b"BM") and _bmp_layout(data)[1] in (_PLAIN, *_MASKS):
            width, height = _bmp_size(data)
            end = struct.unpack_from("<I", data, 10)[0] + (width * _bmp_layout(data)[0] + 31) // 32 * 4 * abs(height)
        elif _is_webp(data):
            end = 8 + struct.unpack_from("<I", data, 4)[0]
        elif (numbers := _PNM.match(data[:4096])) and numbers[1] in (b"5", b"6"):
            samples = int(numbers[2]) * int(numbers[3]) * (3 if numbers[1] == b"6" else 1)
            end = numbers.end() + samples * (1 if int(numbers[4]) < 256 else 2)
    return end if end is not None and end <= len(data) else None


def plane_codec(data: bytes) -> str | None:
    """Return FFmpeg's name of the codec of a picture that is stored in planes of luma and chroma; None: it is not.

    Transparent WebP is not: FFmpeg gives its planes in a form that no kernel reads.
    """
    if data.startswith(JPEG):
        return "mjpeg"
    chunks = {kind for kind, _, _ in _webp_chunks(data)} if _is_webp(data) else set()
    return "webp" if b"VP8 " in chunks and b"ALPH" not in chunks else None


def stored_bits(data: bytes) -> int | None:
    """Return how many bits a picture's levels have, where the head of a PNM file states it; None: all of their type."""
    numbers = _PNM.match(data[:4096])
    return None if numbers is None or numbers[4] is None else int(numbers[4]).bit_length()


def read_tags(data: bytes) -> PictureTags:
    """Return the tags of a PNG, JPEG, TIFF or WebP file; what is damaged or unknown is ignored."""
    tags = PictureTags()
    if data.startswith(JPEG):
        tags = PictureTags(1, "srgb", "a JPEG that says nothing else is sRGB")
        parts = _jpeg_parts(data)
    elif data.startswith(PNG):
        parts = _png_parts(data)
    elif data[:4] in TIFF_MARKS:
        parts = _tiff_parts(data)
    elif data.startswith(b"BM"):
        parts = _bmp_parts(data)
    elif _is_webp(data):
        tags = PictureTags(1, "srgb", "a WebP picture that says nothing else is sRGB")
        parts = _webp_parts(data)
    else:
        return tags
    tags = replace(tags, orientation=0)
    of_xmp = 1
    # Damaged curves are nonsense, which is no news.
    with suppress(*_ODD), np.errstate(all="ignore"):
        for kind, content in parts:
            if kind == "xmp" and (found := _XMP_ORIENTATION.search(content)) is not None:
                of_xmp = int(found[1])
            with suppress(*_ODD):
                tags = _after(tags, kind, content)
    return replace(tags, orientation=tags.orientation or of_xmp)


def with_colors(tags: PictureTags, profile: bytes | None, transfer_code: int | None) -> PictureTags:
    """Return tags with the transfer of an ICC profile, or else of a number of ITU-T H.273."""
    with suppress(*_ODD), np.errstate(all="ignore"):
        if profile:
            return _with_profile(tags, profile)
        if transfer_code is not None:
            return _with_code(tags, transfer_code, "it is marked so")
    return tags


def is_transparent(levels: npt.NDArray[np.generic]) -> bool:
    """Return whether levels (H, W, 3 or 4) have a fourth channel that is not the same everywhere."""
    return levels.shape[2] == 4 and bool((levels[..., 3] != levels[0, 0, 3]).any())


def several(count: int) -> str:
    """Return the note on a file of several pictures."""
    return f"it holds {count} pictures, of which the first is read"


def upright(image: npt.NDArray[np.generic], orientation: int) -> npt.NDArray[np.generic]:
    """Return a view of an array, rows and columns first, turned by Exif's orientation."""
    if orientation in (5, 6, 7, 8):
        image = image.swapaxes(0, 1)
    down = -1 if orientation in (3, 4, 7, 8) else 1
    right = -1 if orientation in (2, 3, 6, 7) else 1
    return image[::down, ::right]


def other_orientation(here: int, first: int) -> str | None:
    """Say that a picture of one camera is turned otherwise than its first; None: alike."""
    if here == first:
        return None
    return (
        f"its Exif orientation is {here}, the first has {first}: cameras guess it where they look down; give all the "
        "same one, or remove it from all"
    )


def unfit_colors(data: bytes) -> str | None:
    """Say why a file does not hold the colours that a camera saw, or not in a form that is read; None: it may."""
    reason = None
    with suppress(*_ODD):
        if data.startswith(PNG):
            chunks = {kind: data[begin:end] for kind, begin, end in png_chunks(data) if kind in (b"IHDR", b"acTL")}
            reason = {3: PALETTE, 4: _GREY_ALPHA}.get(chunks[b"IHDR"][9])
            if struct.unpack_from(">I", chunks.get(b"acTL", bytes(4)))[0] > 1:
                reason = _ANIMATION
        elif data.startswith(JPEG) and (frame := _jpeg_frame(data)) is not None:
            reason = _unfit_jpeg(frame)
        elif data.startswith(b"BM"):
            reason = _unfit_bmp(data)
        elif data[:4] in TIFF_MARKS:
            reason = unfit_page(read_directory(data))
        elif data[:4] == b"RIFF" and data[12:16] == b"VP8X" and data[20] & 2:
            reason = _ANIMATION
        elif (numbers := _PNM.match(data[:4096])) is not None and numbers[1] is not None:
            reason = _unfit_pnm(int(numbers[1]), int(numbers[4]))
    return reason


def _unfit_pnm(kind: int, most: int) -> str | None:
    if kind in (2, 3):
        return "its levels are written as text: save it in the binary form of PNM"
    if most < 255 or most & (most + 1):
        return f"its levels end at {most}: save it with levels up to 255 or 65535"
    return None


def _unfit_jpeg(frame: "_JpegFrame") -> str | None:
    if frame.channels == 4:
        return CMYK
    if frame.kind in _ARITHMETIC or frame.kind in _HIERARCHICAL:
        kind = "with arithmetic coding" if frame.kind in _ARITHMETIC else "of several resolutions (hierarchical)"
        return f"it is a JPEG {kind}, which is not read: save it as PNG, or as a common JPEG"
    if frame.bits != 8:
        return f"it is a JPEG of {frame.bits} bits, which is not read: save it as a PNG or TIFF of 16 bits"
    if frame.channels == 3:
        (across, down), *chroma = frame.samples
        if chroma[0] != chroma[1] or (across / chroma[0][0], down / chroma[0][1]) not in _SUBSAMPLING:
            return "its colours are sampled in a way that is not read: save it as PNG, or with chroma 4:2:0 or 4:4:4"
    return None


def _unfit_bmp(data: bytes) -> str | None:
    bits, layout = _bmp_layout(data)
    if bits <= 8:
        return PALETTE
    if bits == 16:
        return "it has 16 bits a pixel, too few for a phase: save it with 8 bits a colour, as PNG"
    masks = struct.unpack_from("<III", data, 54) if layout in _MASKS else _BMP_ORDER
    if bits not in (24, 32) or layout not in (_PLAIN, *_MASKS) or masks != _BMP_ORDER:
        return "its colours are laid out in a way that is not read: save it as PNG"
    return None


def _after(tags: PictureTags, kind: str, content: bytes) -> PictureTags:
    """Return the tags with what one part of the file states."""
    if kind in ("exif", "tiff"):
        page = read_directory(content)
        orientation = page.first(Tag.ORIENTATION, 0)
        if 1 <= orientation <= 8:
            tags = replace(tags, orientation=orientation)
        if Tag.PROFILE in page.values:
            return _with_profile(tags, page.values[Tag.PROFILE].tobytes())
        if (curve := transfer_curve(page)) is not None:
            light = np.interp(np.linspace(0, 1, 256), np.linspace(0, 1, len(curve)), curve)
            return _with_curve(tags, light, "its transfer function says so")
        exif = page.first(Tag.EXIF, 0)
        if exif and read_directory(content, exif).first(Tag.COLOR_SPACE, 0) == _SRGB:
            return replace(tags, transfer="srgb", because="its Exif data say sRGB")
    elif kind == "profile":
        return _with_profile(tags, content)
    elif kind == "srgb":
        return replace(tags, transfer="srgb", because="it is marked as sRGB")
    elif kind == "cicp":
        return _with_code(tags, content[1], "it is marked so (cICP)")
    elif kind == "gamma":
        gamma = struct.unpack(">I", content)[0] / 1e5
        return _with_curve(tags, np.linspace(0, 1, 256) ** (1 / gamma), f"it is marked with a gamma of {gamma:.3g}")
    elif kind == "pictures" and (count := read_directory(content).first(Tag.MP_IMAGES, 1)) > 1:
        return replace(tags, notes=(*tags.notes, several(count)))
    return tags


def _with_code(tags: PictureTags, code: int, because: str) -> PictureTags:
    """Take the transfer of a number of ITU-T H.273; 2 is none."""
    if code in H273_TRANSFERS:
        return replace(tags, transfer=H273_TRANSFERS[code], because=because)
    return tags if code == _UNSPECIFIED else _with_other(tags, f"{because}: {H273_OTHERS.get(code, f'code {code}')}")


def _with_other(tags: PictureTags, because: str) -> PictureTags:
    """Return tags of a picture whose light is encoded by a curve that is not undone."""
    because = f"{because}, which is another curve than {', '.join(TRANSFERS)}: set transfer"
    return replace(tags, because=because, notes=(*tags.notes, because))


def _with_curve(tags: PictureTags, light: npt.NDArray[np.float64], because: str) -> PictureTags:
    """Take the transfer whose curve, linear light of 256 levels, is that of the file."""
    levels = np.linspace(0, 1, 256)
    off = {name: float(np.abs(light - linear_values(levels, name)).max()) for name in TRANSFERS}
    nearest = min(off, key=lambda name: off[name])
    if not off[nearest] <= _ALIKE:
        return _with_other(tags, because)
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


def _jpeg_parts(data: bytes) -> Iterator[tuple[str, bytes]]:
    profile = b""
    for kind, begin, end in _jpeg_segments(data):
        content = data[begin:end]
        if kind == _APP1 and content.startswith(b"Exif\0\0"):
            yield "exif", content[6:]
        elif kind == _APP1 and content.startswith(b"http://ns.adobe.com/xap/1.0/\0"):
            yield "xmp", content
        elif kind == _APP2 and content.startswith(b"ICC_PROFILE\0"):
            profile += content[14:]  # of several parts, in their order
        elif kind == _APP2 and content.startswith(b"MPF\0"):
            yield "pictures", content[4:]
        elif kind in _JPEG_FRAMES:
            break
    if profile:
        yield "profile", profile


def png_chunks(data: bytes) -> Iterator[tuple[bytes, int, int]]:
    """Yield the kind of each chunk of a PNG, where its content begins, and where the chunk ends."""
    end = len(PNG)
    while end + 12 <= len(data):
        size, kind = struct.unpack_from(">I4s", data, end)
        begin, end = end + 8, end + 12 + size
        yield kind, begin, end


def _png_parts(data: bytes) -> Iterator[tuple[str, bytes]]:
    """Yield what a PNG's chunks state, in the order in which later ones overrule earlier ones."""
    found: dict[bytes, bytes] = {}
    for kind, begin, end in png_chunks(data):
        found.setdefault(kind, data[begin : end - 4])
        if kind == b"iTXt" and data[begin:end].startswith(b"XML:com.adobe.xmp\0"):
            yield "xmp", data[begin:end]
    names = {b"eXIf": "exif", b"gAMA": "gamma", b"sRGB": "srgb", b"iCCP": "profile", b"cICP": "cicp"}
    for kind, name in names.items():
        if kind in found:
            content = found[kind]
            if kind == b"iCCP":
                content = zlib.decompressobj().decompress(content[content.index(b"\0") + 2 :], _MOST_PROFILE)
            yield name, content


def _webp_chunks(data: bytes) -> Iterator[tuple[bytes, int, int]]:
    """Yield the kind of each chunk of a WebP file, and where its content begins and ends."""
    begin = 12
    while begin + 8 <= len(data):
        kind, size = struct.unpack_from("<4sI", data, begin)
        yield kind, begin + 8, begin + 8 + size
        begin += 8 + size + size % 2


def _webp_parts(data: bytes) -> Iterator[tuple[str, bytes]]:
    for kind, begin, end in _webp_chunks(data):
        if kind == b"EXIF":
            yield "exif", data[begin:end].removeprefix(b"Exif\0\0")
        elif kind == b"XMP ":
            yield "xmp", data[begin:end]
        elif kind == b"ICCP":
            yield "profile", data[begin:end]


def _tiff_parts(data: bytes) -> Iterator[tuple[str, bytes]]:
    yield "tiff", data
    yield "xmp", read_directory(data).values.get(Tag.XMP, np.zeros(0, np.uint8)).tobytes()


def _bmp_parts(data: bytes) -> Iterator[tuple[str, bytes]]:
    (head_bytes,) = struct.unpack_from("<I", data, 14)
    kind = data[70:74] if head_bytes >= 108 else b""
    if kind == b"BGRs":
        yield "srgb", b""
    elif kind == b"DEBM" and head_bytes >= 124:
        begin, size = _pair(data, "<II", 126)
        yield "profile", data[14 + begin : 14 + begin + size]


def _pair(data: bytes, layout: str, begin: int) -> tuple[int, int]:
    first, second = struct.unpack_from(layout, data, begin)
    return first, second


def _bmp_size(data: bytes) -> tuple[int, int]:
    """Return a BMP's width and height, which is negative where rows go from top to bottom."""
    # The head of OS/2 has 12 bytes and shorter numbers.
    return _pair(data, "<HH" if data[14:18] == b"\x0c\0\0\0" else "<ii", 18)


def _bmp_layout(data: bytes) -> tuple[int, int]:
    """Return how many bits a BMP has a pixel, and the number of its layout."""
    if data[14:18] == b"\x0c\0\0\0":
        return struct.unpack_from("<H", data, 24)[0], _PLAIN
    return _pair(data, "<HI", 28)


def _is_webp(data: bytes) -> bool:
    return data.startswith(b"RIFF") and data[8:12] == b"WEBP"


def _jpeg_segments(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield the second byte of each marker in a JPEG, and where its segment's content begins and ends.

    The last one is the end of the picture, if it is there.

    Raises
    ------
    struct.error
        The file ends before.
    """
    end = 2
    while (found := _MARKER.search(data, end)) is not None:
        kind, end = data[found.end() - 1], found.end()
        if kind == _BEGIN:  # another picture's
            return
        if kind == _ALONE:
            continue
        begin = end
        if kind != _END:
            begin, end = end + 2, end + struct.unpack_from(">H", data, end)[0]
        yield kind, begin, end
        if kind == _END:
            return


@dataclass(frozen=True)
class _JpegFrame:
    kind: int
    bits: int
    height: int
    width: int
    channels: int
    samples: tuple[tuple[int, int], ...]  # of each channel, across and down


def _jpeg_frame(data: bytes) -> _JpegFrame | None:
    for kind, begin, end in _jpeg_segments(data):
        if kind in _JPEG_FRAMES:
            factors = data[begin + 7 : end : 3]
            samples = tuple((factor >> 4, factor & 15) for factor in factors)
            bits, height, width, channels = struct.unpack_from(">BHHB", data, begin)
            return _JpegFrame(kind, bits, height, width, channels, samples)
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
